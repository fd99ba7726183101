"""A start near the answer: principal components of the motion, read from speech, as initial weights.

VOCA initialises its decoder with principal components; here they become the scalar fields that the vertex
embedding gives, and the codes that speech modulates them with. Only the start: all weights go on learning.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from accelerate import PartialState
from jaxtyping import Float, Float32
from safetensors.torch import save_file
from torch import Tensor, nn

from meshanim.errors import OptionError
from meshanim.models.gava import Gava
from meshanim.models.gava_parts import GlobalDecoder, TransformerDecoder
from meshanim.training.gava_task import GavaTask, MixedTask
from meshanim.training.losses import MILLIMETRES
from meshanim.training.sampling import WindowSampler
from meshanim.training.speech_motion import Clip
from meshanim.training.trainer import TrainConfig, Trainer

__all__ = ["MotionComponents", "WarmStart", "motion_components", "warm_start"]

FRAMES = 4
"""Consecutive frames of the windows that the speech encoder learns from."""
FITTED = "fitted.safetensors"


@dataclass(frozen=True)
class WarmStart:
    """How the first weights are found.

    Parameters
    ----------
    steps : int
        Steps in which the speech encoder learns the components; 0 for a random start.
    batch_windows : int
        Windows a step, on each process.
    components : int
        Principal components, shared out among the topologies; at most a third of the network's rank.
    learning_rate : float
        Peak, cosine to zero, of both fits.
    field_steps : int
        Steps in which the vertex embedding learns the components' fields.
    """

    steps: int = 0
    batch_windows: int = 48
    components: int = 32
    learning_rate: float = 2e-3
    field_steps: int = 1500


@dataclass(frozen=True)
class MotionComponents:
    """Principal components of displacements, about zero.

    Parameters
    ----------
    modes : (K, V, 3)
        Orthonormal fields.
    scale : (K,)
        Root mean square of the coefficients, metres.
    amplitude : (V,)
        Root mean square displacement of each vertex, metres, and a floor.
    """

    modes: Float32[np.ndarray, "components vertices 3"]
    scale: Float32[np.ndarray, " components"]
    amplitude: Float32[np.ndarray, " vertices"]

    def coefficients(
        self, displacements: Float32[np.ndarray, "frames vertices 3"]
    ) -> Float[Tensor, "frames components"]:
        """In units of `scale`."""
        flat = displacements.reshape(len(displacements), -1)
        return torch.from_numpy(flat @ self.modes.reshape(len(self.modes), -1).T / self.scale)


def motion_components(
    clips: Sequence[Clip],
    templates: Float32[np.ndarray, "subjects vertices 3"],
    count: int,
    largest: int = 2000,
) -> MotionComponents:
    """Principal components of at most `largest` frames spread over all clips."""
    total = sum(map(len, clips))
    stride = max(1, -(-total // largest))
    frames = np.concatenate([np.asarray(clip.vertices[::stride]) - templates[clip.subject] for clip in clips])
    size = np.sqrt(np.square(frames).sum(-1).mean(0))
    flat = torch.from_numpy(frames.reshape(len(frames), -1))
    count = min(count, len(frames) - 1)
    torch.manual_seed(0)
    _, singular, modes = torch.svd_lowrank(flat, q=min(count + 8, min(flat.shape)), niter=4)
    scale = (singular[:count] / len(frames) ** 0.5).numpy()
    return MotionComponents(
        modes[:, :count].T.reshape(count, -1, 3).contiguous().numpy(),
        np.maximum(scale, 1e-6).astype(np.float32),
        np.maximum(size, max(0.05 * float(size.max()), 1e-5)).astype(np.float32),
    )


def warm_start(
    model: Gava,
    task: MixedTask,
    components: Sequence[MotionComponents],
    options: WarmStart,
    directory: Path,
    train: TrainConfig,
    cpu: bool = False,
    progress: bool = True,
) -> None:
    """Fit the speech encoder to the components' coefficients, the vertex embedding to their fields.

    The attention blocks start as identities. After it, the network gives the components' share of the motion.
    Every topology has components and codes of its own, which its vertices alone answer to. Both fits are runs
    of the trainer: interrupted ones go on where they were.

    Parameters
    ----------
    model : Gava
        Changed in place, and moved to the device of the run.
    task : MixedTask
        The data, by topology.
    components : sequence of MotionComponents
        One a topology.
    options : WarmStart
        Steps, components, learning rate.
    directory : Path
        Gets the folders of both fits.
    train : TrainConfig
        Of the run to come: seed, precision, workers, and how often to log and save.
    cpu : bool
        Stay on the CPU.
    progress : bool
        Whether to show bars.

    Raises
    ------
    OptionError
        If the network's rank has no room for the components.
    """
    config = model.config
    counts = [len(one.scale) for one in components]
    total = sum(counts)
    if isinstance(model.decoder, TransformerDecoder) and 3 * total > config.rank:
        raise OptionError(f"{total} components need a rank of at least {3 * total}, not {config.rank}")
    slots = [slice(sum(counts[:k]), sum(counts[: k + 1])) for k in range(len(counts))]
    device = PartialState(cpu=cpu).device
    model.to(device)
    fits = replace(
        train,
        steps=options.steps,
        learning_rate=options.learning_rate,
        warmup=0,
        schedule="cosine",
        weight_decay=1e-2,
        gradient_clip=1.0,
        accumulation=1,
        ema=0.0,
        keep=1,
    )
    torch.manual_seed(train.seed)
    readout = nn.Linear(2 * config.channels, total).to(device)
    fit = Trainer(
        _SpeechReader(model, readout),
        _SpeechFit(model, task, components, slots, options.batch_windows, train.seed),
        fits,
        directory / "speech",
        cpu=cpu,
    )
    fit.resume()
    fit.run(progress=progress)
    with torch.no_grad():
        if isinstance(model.decoder, GlobalDecoder):
            _start_global(model, readout, components[0])
            return
        _start_heads(model, readout, total)
    fit = Trainer(
        _FieldEmbedder(model),
        _FieldFit(model, task, components, slots),
        replace(fits, steps=options.field_steps, gradient_clip=0.0, workers=0),
        directory / "fields",
        cpu=cpu,
    )
    fit.resume()
    fit.run(progress=progress)


class _SpeechReader(nn.Module):
    """The parts of a network that turn speech into codes and a pose, with a linear layer to coefficients."""

    def __init__(self, model: Gava, readout: nn.Linear):
        super().__init__()
        self.speech, self.readout = model.speech, readout
        self.subject_styles, self.emotion_styles = model.subject_styles, model.emotion_styles
        turn = model.decoder.pose if config_pose(model) else None
        if turn is not None and model.pose_feature is not None:
            self.pose_feature, self.turn = model.pose_feature, turn
        self._whole = [model]  # in a list, so that its other parameters are not this module's

    def forward(
        self, window: Tensor, mel: Tensor, style: Tensor, emotion: Tensor, intensity: Tensor
    ) -> tuple[Tensor, Tensor | None]:
        (model,) = self._whole
        style = model.style(style, emotion, intensity)
        window = (window - model.feature_mean) / model.feature_scale
        coefficients = self.readout(self.speech(window, style))
        if not hasattr(self, "turn"):
            return coefficients, None
        # The LSTM costs more than all the rest: a quarter of the frames is enough for it.
        mel = (mel[::4] - model.mel_mean) / model.mel_scale
        turned = self.turn(self.pose_feature(mel, style[::4]))
        return coefficients, model.pose_mean + turned * model.pose_scale


class _SpeechFit:
    """Windows of speech with the coefficients of their motion."""

    def __init__(
        self,
        model: Gava,
        task: MixedTask,
        components: Sequence[MotionComponents],
        slots: Sequence[slice],
        windows: int,
        seed: int,
    ):
        self.tasks, self.turns, self.slots = task.tasks, task.turns, slots
        # The loss of a coefficient is what it contributes to the mean squared distance of the vertices.
        self.weights = [
            torch.from_numpy(one.scale * MILLIMETRES).square() / one.modes.shape[1] for one in components
        ]
        self.targets = [_coefficients(one, task) for one, task in zip(components, task.tasks, strict=True)]
        self.frames = FRAMES
        self.samplers = [
            WindowSampler([len(clip) for clip in one.clips], FRAMES, windows, seed) for one in task.tasks
        ]

    def batch(self, number: int, share: int = 0, shares: int = 1) -> dict[str, Any]:
        k, own = self.turns.of(number)
        spans = self.samplers[k].spans(own, share, shares)
        parts = [(span.clip, slice(span.first, span.first + span.frames)) for span in spans]
        clips = self.tasks[k].clips
        return self.tasks[k].speech(spans) | {
            "target": torch.cat([self.targets[k][clip][frames] for clip, frames in parts]),
            "pose": torch.cat([torch.from_numpy(clips[clip].pose[frames]) for clip, frames in parts]),
            "topology": k,
        }

    def loss(self, model: nn.Module, batch: Mapping[str, Any]) -> tuple[Tensor, dict[str, Tensor]]:
        inputs = {name: batch[name] for name in ("window", "mel", "style", "emotion", "intensity")}
        coefficients, pose = model(**inputs)
        k = batch["topology"]
        task, weight = self.tasks[k], self.weights[k].to(coefficients.device)
        error = coefficients[:, self.slots[k]] - batch["target"]
        moved = error.unflatten(0, (-1, self.frames)).diff(dim=1)
        loss = (error.square() * weight).sum(-1).mean()
        loss = loss + task.weights.velocity * (moved.square() * weight).sum(-1).mean()
        if pose is not None:
            missed = torch.linalg.vector_norm(pose - batch["pose"][::4], dim=-1).mean()
            loss = loss + float(task.posed) * missed
        return loss, {}

    def save(self, model: nn.Module, directory: Path) -> None:
        save_file({n: t.contiguous() for n, t in model.state_dict().items()}, directory / FITTED)


def _coefficients(components: MotionComponents, task: GavaTask) -> list[Float[Tensor, "frames components"]]:
    """The coefficients of every clip, 64 frames of motion in memory at a time."""
    templates = task.templates.numpy()
    return [
        torch.cat(
            [
                components.coefficients(np.asarray(clip.vertices[k : k + 64]) - templates[clip.subject])
                for k in range(0, len(clip), 64)
            ]
        )
        for clip in task.clips
    ]


def config_pose(model: Gava) -> bool:
    return model.config.pose and model.decoder.pose is not None


def _start_heads(model: Gava, readout: nn.Linear, count: int) -> None:
    """Code 3 k + a carries component k along axis a in token feature a; the rest keeps vertices apart."""
    fields = 3 * count
    assert isinstance(model.decoder, TransformerDecoder)
    model.decoder.start_as_identity()
    model.to_token[:fields, 3:] *= 0.2
    model.to_token[:, :3] = 0
    for axis in range(3):
        model.to_token[axis:fields:3, axis] = 1
    if model.codes is not None:
        nn.init.zeros_(model.codes.weight)
        nn.init.zeros_(model.codes.bias)
        model.codes.weight[:fields] = readout.weight.repeat_interleave(3, dim=0)
        # The network multiplies by 1 + code.
        model.codes.bias[:fields] = readout.bias.repeat_interleave(3) - 1
    if model.global_attribute is not None:
        model.global_attribute.weight *= 0.2
        model.global_attribute.weight[:3] = 0
        model.global_attribute.bias[:3] = 0
    if model.fuse is not None:
        nn.init.zeros_(model.fuse.weight)
        nn.init.zeros_(model.fuse.bias)
        width = model.config.width
        model.fuse.weight[:, :width] = torch.eye(width)
        model.fuse.weight[:, width:] = torch.eye(width)
    nn.init.zeros_(model.decoder.displacement.weight)
    model.decoder.displacement.weight[:, :3] = torch.eye(3)


def _start_global(model: Gava, readout: nn.Linear, components: MotionComponents) -> None:
    """The components as the last layer of the global network, as VOCA starts."""
    layer = model.decoder.displacement
    fields = torch.from_numpy(components.modes * components.scale[:, None, None])
    tokens = fields[:, model.surface.vertices.cpu()] / model.surface.amplitude.cpu()[:, None]
    width = layer.in_features
    used = min(width, len(fields))
    layer.weight[:, :used] = tokens[:used].flatten(1).T.to(layer.weight)


class _FieldEmbedder(nn.Module):
    """The vertex embedding of a network, subject by subject of any topology."""

    def __init__(self, model: Gava):
        super().__init__()
        self.embedding = model.embedding

    def forward(self, descriptors: Tensor, identity: Tensor) -> Tensor:
        return self.embedding(descriptors, identity)


class _FieldFit:
    """Subjects with the fields of their topology's components; those of other topologies are zero there."""

    def __init__(
        self, model: Gava, task: MixedTask, components: Sequence[MotionComponents], slots: Sequence[slice]
    ):
        self.turns = task.turns
        self.surfaces = [model.on(k).surface for k in range(model.n_topologies)]
        self.identities, self.targets, self.weights = [], [], []
        total = slots[-1].stop
        for surface, one, part, slot in zip(self.surfaces, task.tasks, components, slots, strict=True):
            self.identities.append(surface.identity(one.templates.to(surface.template)))
            fields = torch.from_numpy(part.modes * part.scale[:, None, None])
            own = fields[:, surface.vertices.cpu()] / surface.amplitude.cpu()[:, None]
            target = own.new_zeros(total, *own.shape[1:])
            target[slot] = own
            self.targets.append(target.permute(1, 0, 2).flatten(1).to(surface.amplitude))
            self.weights.append(surface.amplitude.square()[:, None] / surface.amplitude.square().mean())

    def batch(self, number: int, share: int = 0, shares: int = 1) -> dict[str, Any]:
        k, own = self.turns.of(number)
        # The same on all processes: one subject is all that one process would see.
        return {
            "descriptors": self.surfaces[k].descriptors,
            "identity": self.identities[k][own % len(self.identities[k])][None],
            "topology": k,
        }

    def loss(self, model: nn.Module, batch: Mapping[str, Any]) -> tuple[Tensor, dict[str, Tensor]]:
        target, weight = self.targets[batch["topology"]], self.weights[batch["topology"]]
        found = model(batch["descriptors"], batch["identity"])[0, :, : target.shape[1]]
        loss = ((found - target).square() * weight).sum(-1).mean()
        return loss, {"missed": loss / (target.square() * weight).sum(-1).mean()}

    def save(self, model: nn.Module, directory: Path) -> None:
        save_file({n: t.contiguous() for n, t in model.state_dict().items()}, directory / FITTED)
