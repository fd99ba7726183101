"""Training of GAVA: what a batch is, the loss, and the run behind `meshanim train gava`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from meshanim.audio import load_encoder
from meshanim.datasets.meshanim_format import MeshanimDataset
from meshanim.errors import OptionError
from meshanim.heads import load_head
from meshanim.models.gava import Gava, GavaConfig, GavaOutput
from meshanim.models.vertex_tokens import VertexTokens
from meshanim.training.losses import (
    LossWeights,
    eye_loss,
    pose_loss,
    reconstruction_loss,
    velocity_loss,
)
from meshanim.training.speech_motion import (
    MEL_RATE,
    Clip,
    FeatureCache,
    SpeechTracks,
    WindowSampler,
    load_clips,
)
from meshanim.training.trainer import TrainConfig, Trainer
from meshanim.training.warm_start import WarmStart, motion_components, warm_start

__all__ = ["GavaLearner", "GavaTask", "TrainGavaOptions", "train_gava"]


PAPER_WEIGHTS = LossWeights()


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
    ) -> GavaOutput:
        gava = self.gava
        styles = gava.style(style, emotion, intensity)
        return gava(window, mel if gava.config.pose else None, gava.embed(templates), styles, subject)


class GavaTask:
    """Batches of windows and the loss of Sec. III-E.

    The motion is compared in the zero pose, L_p compares the pose: with the paper's posed meshes an error of
    the neck would outweigh the lips.

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
    ):
        if frames < 2:
            raise OptionError("windows need at least two consecutive frames for the velocity loss")
        self.config, self.clips, self.templates, self.eyes = config, clips, templates, eyes
        self.frames, self.windows, self.weights = frames, windows, weights
        self.vertex_weights, self.style_dropout, self.seed = vertex_weights, style_dropout, seed
        self.speech_tracks = SpeechTracks([c.features for c in clips], config.feature_rate, config.window)
        self.mel_tracks = SpeechTracks([c.mels for c in clips], config.mel_rate, config.mel_frames)
        self.fps = torch.tensor([c.info.fps for c in clips], dtype=torch.float64)
        self.labels = torch.tensor([[c.style, c.emotion] for c in clips])
        self.intensities = torch.tensor([c.intensity for c in clips], dtype=torch.float32)
        self.sampler = WindowSampler([len(clip) for clip in clips], frames, windows, seed)

    def speech(self, number: int) -> tuple[dict[str, Tensor], list[tuple[int, int]]]:
        """The inputs of a batch but for the templates, and its windows as (clip, first frame)."""
        generator = torch.Generator().manual_seed(self.seed * 7_368_787 + number)
        picks = self.sampler.picks(number)
        count = len(picks)
        variants = torch.randint(self.speech_tracks.variants, (count,), generator=generator)
        unknown = torch.rand(count, generator=generator) < self.style_dropout
        clips, first = torch.tensor(picks).T
        offsets = torch.arange(self.frames)
        frames = (first[:, None] + offsets).flatten()
        clips, variants, unknown = (c.repeat_interleave(self.frames) for c in (clips, variants, unknown))
        times = (frames + 0.5) / self.fps[clips]
        batch = {
            "window": self.speech_tracks.windows(clips, variants, times),
            "mel": self.mel_tracks.windows(clips, variants, times),
            "style": torch.where(unknown, -1, self.labels[clips, 0]),
            "emotion": self.labels[clips, 1],
            "intensity": self.intensities[clips],
        }
        return batch, picks

    def batch(self, number: int) -> dict[str, Tensor]:
        """A batch with its truth: displacements (B, V, 3) and pose (B, 3)."""
        batch, picks = self.speech(number)
        subjects = sorted({self.clips[c].subject for c, _ in picks})
        moved, turned, rows = [], [], []
        for c, first in picks:
            clip, span = self.clips[c], slice(first, first + self.frames)
            vertices = torch.from_numpy(np.array(clip.vertices[span]))
            moved.append(vertices - self.templates[clip.subject])
            turned.append(torch.from_numpy(clip.pose[span]))
            rows += [subjects.index(clip.subject)] * self.frames
        return batch | {
            "templates": self.templates[subjects],
            "subject": torch.tensor(rows),
            "displacement": torch.cat(moved),
            "pose": torch.cat(turned),
        }

    def loss(self, model: nn.Module, batch: Mapping[str, Any]) -> tuple[Tensor, dict[str, Tensor]]:
        """L = L_r + 10 L_v + 0.001 L_p + 0.005 L_e (Eq. 3), and its terms."""
        inputs = {name: value for name, value in batch.items() if name not in ("displacement", "pose")}
        moved, turned = model(**inputs)
        true, weights = batch["displacement"], self.weights
        vertex_weights = None if self.vertex_weights is None else self.vertex_weights.to(true.device)
        terms = {
            "reconstruction": reconstruction_loss(moved, true, vertex_weights),
            "velocity": velocity_loss(
                moved.unflatten(0, (-1, self.frames)), true.unflatten(0, (-1, self.frames)), vertex_weights
            ),
        }
        loss = weights.reconstruction * terms["reconstruction"] + weights.velocity * terms["velocity"]
        if len(self.eyes):
            terms["eyes"] = eye_loss(moved, true, self.eyes.to(true.device))
            loss = loss + weights.eyes * terms["eyes"]
        if self.config.pose:
            terms["pose"] = pose_loss(turned, batch["pose"])
            loss = loss + weights.pose * terms["pose"]
        return loss, terms

    def save(self, model: nn.Module, directory: Path) -> None:
        gava = model.gava
        assert isinstance(gava, Gava)
        gava.save_pretrained(directory)


@dataclass(frozen=True)
class TrainGavaOptions:
    """Train GAVA on a data set in the project's format.

    Example: meshanim train gava --data corpus --output runs/gava --tokens 1200
    """

    data: Path
    """Folder of a data set (`meshanim data synthesize` makes one)."""
    output: Path = Path("runs/gava")
    """Gets checkpoints/, tensorboard/ and model/; an interrupted run with the same options is continued."""
    encoder: str = "visemes"
    """Speech encoder: visemes, mel, phones, wav2vec2:PATH, hubert:PATH."""
    features: Literal["LG", "L", "G"] = "LG"
    """Local and global features, or one of them."""
    fusion: Literal["sum", "concat"] = "sum"
    """How local and global features are joined."""
    decoder: Literal["gava", "sa", "mlp"] = "gava"
    """Mesh attention, all-pairs attention, or one global network."""
    width: int = 64
    """Features a token."""
    layers: int = 3
    """Attention blocks."""
    heads: int = 4
    """Attention heads."""
    rings: int = 1
    """Mesh edges that attention crosses in one block; 1 is the paper's."""
    tokens: int = 0
    """Attention on so many vertices, spread by what moves; 0 for one token a vertex."""
    rank: int = 128
    """Codes that modulate the vertex embeddings."""
    dropout: float = 0.0
    """Of the speech encoder's features."""
    pose: bool = True
    """Whether the head pose is learned."""
    batch_windows: int = 4
    """Windows a batch."""
    window_frames: int = 4
    """Consecutive frames a window; 4 x 4 is the paper's batch of 16 frames."""
    variants: int = 3
    """Degraded variants of each sound beside the clean one."""
    lip_weight: float = 1.0
    """Weight of lip vertices in the loss (1: the paper)."""
    warm: WarmStart = field(default_factory=WarmStart)
    """Before the run: principal components of the motion, read from speech (steps 0 for none)."""
    train: TrainConfig = field(default_factory=TrainConfig)
    """The schedule."""
    cache: Path | None = None
    """Where speech features are kept; OUTPUT/features if not given."""
    cpu: bool = False
    """Stay on the CPU."""


def train_gava(options: TrainGavaOptions, progress: bool = True) -> Path:
    """Train, and give the folder of the finished model.

    Raises
    ------
    FileFormatError, OptionError
        If the data set cannot be read or an option does not fit it.
    """
    torch.manual_seed(options.train.seed)
    dataset = MeshanimDataset(options.data)
    encoder = load_encoder(options.encoder)
    names = dataset.split("train")
    infos = [dataset.info(name) for name in names]
    styles = tuple(sorted({info.subject for info in infos}))
    emotions = ("neutral", *sorted({info.emotion for info in infos} - {"neutral"}))
    cache = FeatureCache(options.cache or options.output / "features", encoder, options.train.seed)
    clips = load_clips(dataset, names, cache, styles, emotions, options.variants, progress)
    templates = torch.from_numpy(np.stack([subject.template for subject in dataset.subjects.values()]))
    config = GavaConfig(
        feature_dim=encoder.dim,
        features=options.features,
        fusion=options.fusion,
        decoder=options.decoder,
        width=options.width,
        layers=options.layers,
        heads=options.heads,
        rings=options.rings,
        tokens=options.tokens or "vertices",
        rank=options.rank,
        dropout=options.dropout,
        pose=options.pose,
        subjects=styles,
        emotions=emotions,
        encoder=options.encoder,
        feature_rate=float(encoder.rate),
        mel_rate=MEL_RATE,
        fps=dataset.fps,
        head=dataset.head,
    )
    regions = load_head(dataset.head).regions if dataset.head else {}
    vertex_weights = torch.ones(dataset.mesh.n_vertices)
    vertex_weights[regions.get("lips", np.zeros(0, np.int64))] = options.lip_weight
    eyes = torch.from_numpy(np.union1d(regions.get("eyelids", []), regions.get("eyes", [])).astype(np.int64))
    components = motion_components(clips, templates.numpy(), options.warm.components)
    surface = VertexTokens.from_mesh(
        dataset.mesh, config.tokens, config.eigenfunctions, components.modes * components.scale[:, None, None]
    )
    surface.amplitude.copy_(torch.from_numpy(components.amplitude)[surface.vertices])
    model = Gava(config, surface)
    set_statistics(model, clips)
    task = GavaTask(
        config,
        clips,
        templates,
        eyes,
        frames=options.window_frames,
        windows=options.batch_windows,
        vertex_weights=vertex_weights if options.lip_weight != 1 else None,
        seed=options.train.seed,
    )
    trainer = Trainer(
        GavaLearner(model),
        task,
        options.train,
        options.output,
        cpu=options.cpu,
        find_unused=options.decoder == "mlp" or options.features != "LG",
    )
    if not trainer.resume() and options.warm.steps:
        device = trainer.accelerator.device
        warm_start(model.to(device), task, components, options.warm, device, progress)
        trainer.reset_average()
    trainer.run(progress=progress)
    return options.output / "model"


def set_statistics(model: Gava, clips: Sequence[Clip]) -> None:
    """Put means and deviations of the inputs and of the pose into the model's buffers."""
    features = torch.cat([f.float() for clip in clips for f in clip.features])
    mels = torch.cat([m.float() for clip in clips for m in clip.mels])
    poses = torch.cat([torch.from_numpy(clip.pose) for clip in clips])
    model.feature_mean.copy_(features.mean(0))
    # Rare classes keep a moderate scale: their few frames are not blown up.
    model.feature_scale.copy_(features.std(0).clamp_min(0.1 * features.std()))
    model.mel_mean.copy_(mels.mean(0))
    model.mel_scale.copy_(mels.std(0).clamp_min(1e-3))
    model.pose_mean.copy_(poses.mean(0))
    model.pose_scale.copy_(poses.std(0).clamp_min(1e-4))
