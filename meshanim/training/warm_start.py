"""A start near the answer: principal components of the motion, read from speech, as initial weights.

VOCA initialises its decoder with principal components; here they become the scalar fields that the vertex
embedding gives, and the codes that speech modulates them with. Only the start: all weights go on learning.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn
from tqdm import tqdm

from meshanim.errors import OptionError
from meshanim.models.gava import Gava
from meshanim.models.gava_parts import GlobalDecoder, TransformerDecoder
from meshanim.training.losses import MILLIMETRES
from meshanim.training.speech_motion import Clip

if TYPE_CHECKING:
    from meshanim.training.gava import GavaTask

__all__ = ["MotionComponents", "WarmStart", "motion_components", "warm_start"]


@dataclass(frozen=True)
class WarmStart:
    """How the first weights are found.

    Parameters
    ----------
    steps : int
        Steps in which the speech encoder learns the components; 0 for a random start.
    batch_windows : int
        Windows a step.
    components : int
        Principal components; at most a third of the network's rank.
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
    task: "GavaTask",
    components: MotionComponents,
    options: WarmStart,
    device: torch.device,
    progress: bool = True,
) -> None:
    """Fit the speech encoder to the components' coefficients, the vertex embedding to their fields.

    The attention blocks start as identities. After it, the network gives the components' share of the motion.

    Raises
    ------
    OptionError
        If the network's rank has no room for the components.
    """
    config = model.config
    count = len(components.scale)
    if isinstance(model.decoder, TransformerDecoder) and 3 * count > config.rank:
        raise OptionError(f"{count} components need a rank of at least {3 * count}, not {config.rank}")
    readout = nn.Linear(2 * config.channels, count).to(device)
    _fit_speech(model, readout, task, components, options, device, progress)
    with torch.no_grad():
        if isinstance(model.decoder, GlobalDecoder):
            _start_global(model, readout, components)
            return
        _start_heads(model, readout, count)
    _fit_fields(model, task.templates.to(device), components, options, progress)


def _fit_speech(
    model: Gava,
    readout: nn.Linear,
    task: "GavaTask",
    components: MotionComponents,
    options: WarmStart,
    device: torch.device,
    progress: bool,
) -> None:
    templates = task.templates.numpy()
    targets = [
        torch.cat(
            [
                components.coefficients(np.asarray(clip.vertices[k : k + 64]) - templates[clip.subject])
                for k in range(0, len(clip), 64)
            ]
        )
        for clip in task.clips
    ]
    poses = [torch.from_numpy(clip.pose) for clip in task.clips]
    # The loss of a coefficient is what it contributes to the mean squared distance of the vertices.
    weight = torch.from_numpy(components.scale * MILLIMETRES).square() / components.modes.shape[1]
    weight = weight.to(device)
    windows, task.sampler.windows = task.sampler.windows, options.batch_windows
    parameters = [*model.speech.parameters(), *readout.parameters(), *model.subject_styles.parameters()]
    parameters += model.emotion_styles.parameters()
    turn = model.decoder.pose if config_pose(model) else None
    if turn is not None and model.pose_feature is not None:
        parameters += [*model.pose_feature.parameters(), *turn.parameters()]
    optimizer = torch.optim.AdamW(parameters, lr=options.learning_rate, weight_decay=1e-2)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, options.steps)
    bar = tqdm(range(options.steps), unit="step", desc="warm start: speech", disable=not progress)
    for number in bar:
        batch, picks = task.speech(number)
        batch = {name: value.to(device) for name, value in batch.items()}
        span = [(c, slice(first, first + task.frames)) for c, first in picks]
        target = torch.cat([targets[c][s] for c, s in span]).to(device)
        style = model.style(batch["style"], batch["emotion"], batch["intensity"])
        window = (batch["window"] - model.feature_mean) / model.feature_scale
        error = readout(model.speech(window, style)) - target
        moved = error.unflatten(0, (-1, task.frames)).diff(dim=1)
        loss = (error.square() * weight).sum(-1).mean()
        loss = loss + task.weights.velocity * (moved.square() * weight).sum(-1).mean()
        if turn is not None and model.pose_feature is not None:
            # The LSTM costs more than all the rest: a quarter of the frames is enough for it.
            mel = (batch["mel"][::4] - model.mel_mean) / model.mel_scale
            pose = model.pose_mean + turn(model.pose_feature(mel, style[::4])) * model.pose_scale
            true = torch.cat([poses[c][s] for c, s in span])[::4].to(device)
            loss = loss + torch.linalg.vector_norm(pose - true, dim=-1).mean()
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(parameters, 1.0)
        optimizer.step()
        schedule.step()
        if number % 50 == 0:
            bar.set_postfix(loss=f"{float(loss):.4g}")
    task.sampler.windows = windows


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


def _fit_fields(
    model: Gava,
    templates: Float[Tensor, "subjects vertices 3"],
    components: MotionComponents,
    options: WarmStart,
    progress: bool,
) -> None:
    surface = model.surface
    fields = torch.from_numpy(components.modes * components.scale[:, None, None])
    target = (fields[:, surface.vertices.cpu()] / surface.amplitude.cpu()[:, None]).to(surface.amplitude)
    target = target.permute(1, 0, 2).flatten(1)
    weight = surface.amplitude.square()[:, None] / surface.amplitude.square().mean()
    identities = surface.identity(templates)
    parameters = list(model.embedding.parameters())
    optimizer = torch.optim.AdamW(parameters, lr=options.learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, options.field_steps)
    bar = tqdm(range(options.field_steps), unit="step", desc="warm start: fields", disable=not progress)
    for number in bar:
        subject = identities[number % len(identities)][None]
        error = model.embedding(surface.descriptors, subject)[0, :, : target.shape[1]] - target
        loss = (error.square() * weight).sum(-1).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        if number % 50 == 0:
            bar.set_postfix(missed=f"{float(loss / (target.square() * weight).sum(-1).mean()):.4g}")
