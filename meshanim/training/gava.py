"""Training of GAVA: the run behind `meshanim train gava`."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch
from accelerate import PartialState
from torch import Tensor
from tyro.conf import UseAppendAction

from meshanim.audio import load_encoder
from meshanim.errors import OptionError
from meshanim.models.gava import Gava, GavaConfig
from meshanim.models.vertex_tokens import VertexTokens
from meshanim.training.array_rows import ArrayRows
from meshanim.training.gava_card import write_card
from meshanim.training.gava_data import TrainingSurface, load_surfaces
from meshanim.training.gava_task import GavaLearner, GavaTask, MixedTask
from meshanim.training.speech_motion import MEL_RATE
from meshanim.training.trainer import TrainConfig, Trainer, last_checkpoint
from meshanim.training.warm_start import WarmStart, motion_components, warm_start

__all__ = ["GavaLearner", "GavaTask", "TrainGavaOptions", "train_gava"]

STATISTICS = 512
"""Clips, spread over the data, that means and deviations of the inputs are taken from."""


@dataclass(frozen=True)
class TrainGavaOptions:
    """Train GAVA on data sets in the project's format.

    Example: meshanim train gava --data corpus --output runs/gava --tokens 1200
    """

    data: UseAppendAction[tuple[Path, ...]]
    """Folder of a data set (`meshanim data synthesize` makes one); given again for several, whose meshes may
    differ: one network with one attention graph a topology."""
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
    batch: Literal["windows", "sequences"] = "windows"
    """Batches of windows, or of whole sequences of like length."""
    batch_windows: int = 4
    """Windows a batch, on each process."""
    batch_sequences: int = 1
    """Sequences a batch, on each process."""
    window_frames: int = 4
    """Consecutive frames a window; 4 x 4 is the paper's batch of 16 frames."""
    variants: int = 3
    """Degraded variants of each sound beside the clean one."""
    mixing: float = 1.0
    """With several topologies, a topology's share of the batches: its number of frames to this power."""
    lip_weight: float = 1.0
    """Weight of lip vertices in the loss (1: the paper)."""
    warm: WarmStart = field(default_factory=WarmStart)
    """Before the run: principal components of the motion, read from speech (steps 0 for none)."""
    train: TrainConfig = field(default_factory=TrainConfig)
    """The schedule."""
    cache: Path | None = None
    """Where speech features are kept; DATA/features if `meshanim data cache-features` made it, or else
    OUTPUT/features."""
    cpu: bool = False
    """Stay on the CPU."""

    def __post_init__(self):
        if not self.data:
            raise OptionError("no data set to train on: give --data FOLDER")
        if self.batch_sequences < 1 or self.batch_windows < 1:
            raise OptionError("batch_windows and batch_sequences must be at least 1")


def train_gava(options: TrainGavaOptions, progress: bool = True) -> Path:
    """Train, and give the folder of the finished model.

    Raises
    ------
    FileFormatError, OptionError
        If a data set cannot be read or an option does not fit it.
    """
    torch.manual_seed(options.train.seed)
    encoder = load_encoder(options.encoder)
    state = PartialState(cpu=options.cpu)
    progress = progress and state.is_main_process
    surfaces, styles, emotions = load_surfaces(
        options.data,
        encoder,
        options.cache,
        options.output,
        options.variants,
        options.train.seed,
        (state.process_index, state.num_processes),
        progress,
    )
    first = surfaces[0].topology
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
        fps=first.fps,
        head=first.head,
        topologies=[surface.topology for surface in surfaces] if len(surfaces) > 1 else (),
    )
    count = options.warm.components // len(surfaces)
    components = [motion_components(s.clips, s.templates.numpy(), max(1, count)) for s in surfaces]
    tokens = []
    for surface, found in zip(surfaces, components, strict=True):
        motion = found.modes * found.scale[:, None, None]
        one = VertexTokens.from_mesh(surface.mesh, config.tokens, config.eigenfunctions, motion)
        one.amplitude.copy_(torch.from_numpy(found.amplitude)[one.vertices])
        tokens.append(one)
    model = Gava(config, tokens[0], tokens[1:])
    set_statistics(model, surfaces)
    tasks = [_task(options, config, surface, k) for k, surface in enumerate(surfaces)]
    mixed = MixedTask(tasks, [surface.topology.name for surface in surfaces], options.mixing)
    if options.warm.steps and last_checkpoint(options.output) is None:
        warm_start(
            model,
            mixed,
            components,
            options.warm,
            options.output / "warm",
            options.train,
            options.cpu,
            progress,
        )
    trainer = Trainer(
        GavaLearner(model),
        mixed if len(tasks) > 1 else tasks[0],
        options.train,
        options.output,
        cpu=options.cpu,
        find_unused=options.decoder == "mlp" or options.features != "LG",
    )
    trainer.resume()
    trainer.run(progress=progress)
    if trainer.accelerator.is_main_process:
        write_card(options.output / "model", options, encoder)
    trainer.accelerator.wait_for_everyone()
    return options.output / "model"


def _task(options: TrainGavaOptions, config: GavaConfig, surface: TrainingSurface, number: int) -> GavaTask:
    weights = torch.ones(surface.mesh.n_vertices)
    weights[surface.lips] = options.lip_weight
    return GavaTask(
        config,
        surface.clips,
        surface.templates,
        surface.eyes,
        frames=options.window_frames,
        windows=options.batch_windows,
        vertex_weights=weights if options.lip_weight != 1 else None,
        seed=options.train.seed,
        sequences=options.batch_sequences if options.batch == "sequences" else 0,
        topology=number,
        posed=surface.posed,
    )


def set_statistics(model: Gava, surfaces: Sequence[TrainingSurface]) -> None:
    """Put means and deviations of the inputs and of the pose into the model's buffers."""
    clips = [clip for surface in surfaces for clip in surface.clips]
    some = clips[:: max(1, len(clips) // STATISTICS)]
    mean, deviation, overall = _moments([rows for clip in some for rows in clip.features])
    model.feature_mean.copy_(mean)
    # Rare classes keep a moderate scale: their few frames are not blown up.
    model.feature_scale.copy_(deviation.clamp_min(0.1 * overall))
    mean, deviation, _ = _moments([rows for clip in some for rows in clip.mels])
    model.mel_mean.copy_(mean)
    model.mel_scale.copy_(deviation.clamp_min(1e-3))
    posed = [clip for surface in surfaces if surface.posed for clip in surface.clips]
    if posed:
        poses = torch.cat([torch.from_numpy(clip.pose) for clip in posed])
        model.pose_mean.copy_(poses.mean(0))
        model.pose_scale.copy_(poses.std(0).clamp_min(1e-4))


def _moments(tracks: Sequence[ArrayRows]) -> tuple[Tensor, Tensor, float]:
    """Mean and deviation of each column, and the deviation of all numbers, reading a track at a time."""
    count, total, squares = 0, torch.zeros(1), torch.zeros(1)
    for track in tracks:
        values = torch.from_numpy(track[:]).double()
        count += len(values)
        total, squares = total + values.sum(0), squares + values.square().sum(0)
    mean = total / count
    deviation = ((squares - count * mean.square()).clamp_min(0) / max(count - 1, 1)).sqrt()
    numbers = count * len(total)
    spread = squares.sum() - total.sum().square() / numbers
    return mean, deviation, float((spread / max(numbers - 1, 1)).clamp_min(0).sqrt())
