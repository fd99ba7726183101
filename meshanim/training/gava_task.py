"""What GAVA trains on: batches of windows or whole sequences, of one topology or of several in turn."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from meshanim.errors import OptionError
from meshanim.models.gava import Gava, GavaConfig, GavaOutput
from meshanim.training.losses import (
    LossWeights,
    eye_loss,
    pose_loss,
    reconstruction_loss,
    velocity_loss,
)
from meshanim.training.sampling import Sampler, SequenceSampler, Span, WindowSampler
from meshanim.training.speech_motion import Clip, SpeechTracks

__all__ = ["GavaLearner", "GavaTask", "MixedTask", "Turns"]

PAPER_WEIGHTS = LossWeights()
CYCLE = 1000
"""Batches after which the order of topologies begins anew."""


class GavaLearner(nn.Module):
    """A GAVA network with everything that its parameters touch in one forward call, as DDP needs it.

    Parameters
    ----------
    gava : Gava
        What learns.
    """

    def __init__(self, gava: Gava):
        super().__init__()
        self.gava = gava

    def forward(
        self,
        window: Float[Tensor, "batch window dim"],
        mel: Float[Tensor, "batch frames bands"],
        templates: Float[Tensor, "subjects vertices 3"],
        subject: Int[Tensor, " batch"],
        style: Int[Tensor, " batch"],
        emotion: Int[Tensor, " batch"],
        intensity: Float[Tensor, " batch"],
        topology: int = 0,
    ) -> GavaOutput:
        gava = self.gava.on(topology)
        styles = gava.style(style, emotion, intensity)
        return gava(window, mel if gava.config.pose else None, gava.embed(templates), styles, subject)


class GavaTask:
    """Batches of one topology and the loss of Sec. III-E.

    The motion is compared in the zero pose, L_p compares the pose: with the paper's posed meshes an error of
    the neck would outweigh the lips. With whole sequences every term is the mean over a sequence's frames,
    then over the sequences.

    Parameters
    ----------
    clips : sequence of Clip
        The training data.
    templates : (S, V, 3)
        Of all subjects, metres.
    eyes : (E,) int
        Vertices of the eye region for L_e; none where empty.
    frames, windows : int
        Consecutive frames a window, windows a batch: 16 frames a batch in the paper.
    weights : LossWeights
        Of the terms.
    vertex_weights : (V,), optional
        Of L_r and L_v; ones in the paper.
    style_dropout : float
        Share of windows that train the mean style, for subjects nobody has seen.
    seed : int
        Of order, variants and dropout.
    sequences : int
        Whole sequences a batch, of like length, instead of windows; 0 for windows.
    topology : int
        Of the network's, which one this is.
    posed : bool
        Whether the data has head poses to learn.
    """

    def __init__(
        self,
        config: GavaConfig,
        clips: Sequence[Clip],
        templates: Float[Tensor, "subjects vertices 3"],
        eyes: Int[Tensor, " eyes"],
        frames: int = 4,
        windows: int = 4,
        weights: LossWeights = PAPER_WEIGHTS,
        vertex_weights: Float[Tensor, " vertices"] | None = None,
        style_dropout: float = 0.15,
        seed: int = 0,
        sequences: int = 0,
        topology: int = 0,
        posed: bool = True,
    ):
        if frames < 2:
            raise OptionError("windows need at least two consecutive frames for the velocity loss")
        self.config, self.clips, self.templates, self.eyes = config, clips, templates, eyes
        self.weights, self.vertex_weights, self.style_dropout = weights, vertex_weights, style_dropout
        self.whole, self.topology, self.posed = sequences > 0, topology, posed
        self.speech_tracks = SpeechTracks([c.features for c in clips], config.feature_rate, config.window)
        self.mel_tracks = SpeechTracks([c.mels for c in clips], config.mel_rate, config.mel_frames)
        self.fps = torch.tensor([c.info.fps for c in clips], dtype=torch.float64)
        self.labels = torch.tensor([[c.style, c.emotion] for c in clips])
        self.intensities = torch.tensor([c.intensity for c in clips], dtype=torch.float32)
        lengths = [len(clip) for clip in clips]
        self.sampler: Sampler = (
            SequenceSampler(lengths, sequences, seed)
            if sequences
            else WindowSampler(lengths, frames, windows, seed)
        )

    def speech(self, spans: Sequence[Span]) -> dict[str, Tensor]:
        """The inputs of spans of frames, end to end, but for the templates."""
        counts = torch.tensor([span.frames for span in spans])

        def repeated(values: list) -> Tensor:
            return torch.tensor(values).repeat_interleave(counts)

        clips = repeated([span.clip for span in spans])
        variants = repeated([span.draw % self.speech_tracks.variants for span in spans])
        unknown = repeated([span.coin < self.style_dropout for span in spans])
        frames = torch.cat([torch.arange(span.first, span.first + span.frames) for span in spans])
        times = (frames + 0.5) / self.fps[clips]
        return {
            "window": self.speech_tracks.windows(clips, variants, times),
            "mel": self.mel_tracks.windows(clips, variants, times),
            "style": torch.where(unknown, -1, self.labels[clips, 0]),
            "emotion": self.labels[clips, 1],
            "intensity": self.intensities[clips],
        }

    def batch(self, number: int, share: int = 0, shares: int = 1) -> dict[str, Any]:
        """Frames of spans end to end, with their truth: displacements (B, V, 3) and pose (B, 3)."""
        spans = self.sampler.spans(number, share, shares)
        subjects = sorted({self.clips[span.clip].subject for span in spans})
        moved, turned, rows = [], [], []
        for span in spans:
            clip, frames = self.clips[span.clip], slice(span.first, span.first + span.frames)
            moved.append(torch.from_numpy(np.array(clip.vertices[frames])) - self.templates[clip.subject])
            turned.append(torch.from_numpy(clip.pose[frames]))
            rows += [subjects.index(clip.subject)] * span.frames
        return self.speech(spans) | {
            "templates": self.templates[subjects],
            "subject": torch.tensor(rows),
            "displacement": torch.cat(moved),
            "pose": torch.cat(turned),
            "frames": torch.tensor([span.frames for span in spans]),
            "topology": self.topology,
        }

    def loss(self, model: nn.Module, batch: Mapping[str, Any]) -> tuple[Tensor, dict[str, Tensor]]:
        """L = L_r + 10 L_v + 0.001 L_p + 0.005 L_e (Eq. 3), and its terms."""
        inputs = {k: value for k, value in batch.items() if k not in ("displacement", "pose", "frames")}
        output = model(**inputs)
        weights, device = self.weights, output.displacements.device
        vertex_weights = None if self.vertex_weights is None else self.vertex_weights.to(device)
        # Frames end to end cost nothing for what is not there; the losses see one row a span.
        frames = batch["frames"]
        mask = torch.arange(int(frames.max()), device=device) < frames[:, None]
        moved, true = (_rows(values, mask) for values in (output.displacements, batch["displacement"]))
        counted = mask if self.whole else None
        terms = {
            "reconstruction": reconstruction_loss(moved, true, vertex_weights, counted),
            "velocity": velocity_loss(moved, true, vertex_weights, counted),
        }
        loss = weights.reconstruction * terms["reconstruction"] + weights.velocity * terms["velocity"]
        if len(self.eyes):
            terms["eyes"] = eye_loss(moved, true, self.eyes.to(device), mask=counted, everywhere=True)
            loss = loss + weights.eyes * terms["eyes"]
        if self.config.pose:
            turned, turn = (_rows(values, mask) for values in (output.pose, batch["pose"]))
            terms["pose"] = pose_loss(turned, turn, counted)
            # Times zero, not left out: every parameter gets a gradient on every process.
            loss = loss + weights.pose * float(self.posed) * terms["pose"]
        return loss, terms

    def save(self, model: nn.Module, directory: Path) -> None:
        gava = model.gava
        assert isinstance(gava, Gava)
        gava.save_pretrained(directory)


def _rows(values: Float[Tensor, "total ..."], mask: Bool[Tensor, "spans frames"]) -> Tensor:
    """Frames end to end as a row a span, zero after its end."""
    if bool(mask.all()):
        return values.unflatten(0, mask.shape)
    return values.new_zeros(*mask.shape, *values.shape[1:]).masked_scatter(
        mask.reshape(*mask.shape, *(1 for _ in values.shape[1:])), values
    )


class Turns:
    """Whose turn a batch is, in a fixed cycle: each as often as its weight says, as evenly as can be.

    Parameters
    ----------
    weights : sequence of float
        Positive; each gets its share of `CYCLE` batches, and at least one.
    """

    def __init__(self, weights: Sequence[float]):
        total = sum(weights)
        counts = [max(1, round(CYCLE * weight / total)) for weight in weights]
        order = sorted(((j + 0.5) / count, k) for k, count in enumerate(counts) for j in range(count))
        self.counts, self.order = counts, [k for _, k in order]
        seen = [0] * len(counts)
        self.before = []
        for k in self.order:
            self.before.append(seen[k])
            seen[k] += 1

    def of(self, number: int) -> tuple[int, int]:
        """Whose turn batch `number` is, and how many turns they have had before it."""
        cycle, place = divmod(number, len(self.order))
        k = self.order[place]
        return k, cycle * self.counts[k] + self.before[place]


class MixedTask:
    """Several topologies: every batch is of one, the same one on all processes.

    Parameters
    ----------
    tasks : sequence of GavaTask
        One a topology.
    names : sequence of str
        Of the topologies, for the log.
    mixing : float
        Power of a topology's number of frames that its share of the batches is proportional to: 1 sees every
        frame as often, 0 every topology.
    """

    def __init__(self, tasks: Sequence[GavaTask], names: Sequence[str], mixing: float = 1.0):
        self.tasks, self.names = tasks, names
        self.turns = Turns([sum(map(len, task.clips)) ** mixing for task in tasks])

    def batch(self, number: int, share: int = 0, shares: int = 1) -> dict[str, Any]:
        """The next batch of the topology whose turn it is."""
        k, own = self.turns.of(number)
        return self.tasks[k].batch(own, share, shares)

    def loss(self, model: nn.Module, batch: Mapping[str, Any]) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss of the batch's topology; its terms under its name."""
        k = batch["topology"]
        loss, terms = self.tasks[k].loss(model, batch)
        return loss, {f"{self.names[k]}/{name}": value for name, value in terms.items()}

    def save(self, model: nn.Module, directory: Path) -> None:
        self.tasks[0].save(model, directory)
