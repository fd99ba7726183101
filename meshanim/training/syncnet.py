"""Training of SyncNet: the run behind `meshanim train syncnet`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from accelerate import PartialState
from jaxtyping import Float32
from torch import Tensor, nn
from torch.nn import functional
from tqdm import tqdm

from meshanim.audio import load_encoder
from meshanim.datasets.meshanim_format import MeshanimDataset
from meshanim.errors import OptionError
from meshanim.heads import load_head
from meshanim.models.syncnet import (
    RATE,
    SyncConfig,
    SyncNet,
    mouth_landmarks,
    mouth_moments,
    speech_moments,
)
from meshanim.motion.face_parts import FaceParts, face_parts
from meshanim.training.feature_cache import FeatureCache, cache_folder
from meshanim.training.sampling import WindowSampler
from meshanim.training.trainer import TrainConfig, Trainer

__all__ = ["SyncClip", "SyncTask", "TrainSyncNetOptions", "load_sync_clips", "parts_of", "train_syncnet"]

APART = 0.2
"""Seconds between moments of one clip in a batch: they share no lip frame."""


@dataclass(frozen=True)
class TrainSyncNetOptions:
    """Train a SyncNet on mouth landmarks, for the sync scores of meshanim evaluate a2f.

    Example: meshanim train syncnet --data corpus --output runs/syncnet
    """

    data: Path
    """Folder of a data set in the project's format."""
    output: Path = Path("runs/syncnet")
    """Gets checkpoints/, tensorboard/ and model/; an interrupted run with the same options is continued."""
    parts: Path | None = None
    """JSON that names the lips where the data set has no head, as for meshanim data a2f."""
    encoder: str = "mel"
    """Speech encoder; one that was not trained on lips judges without favour. GeneFace's is hubert:PATH."""
    width: int = 128
    """Channels, and numbers of a vector."""
    clips: int = 8
    """Clips a batch, on each process."""
    moments: int = 8
    """Moments of each clip, 0.2 s apart; all others of a batch are what one must not be mistaken for."""
    train: TrainConfig = field(
        default_factory=lambda: TrainConfig(
            steps=4000, learning_rate=1e-3, warmup=100, schedule="cosine", weight_decay=1e-4, ema=0.995
        )
    )
    """The schedule."""
    cache: Path | None = None
    """Where speech features are kept; DATA/features if not given."""
    cpu: bool = False
    """Stay on the CPU."""

    def __post_init__(self):
        if self.clips < 1 or self.moments < 2:
            raise OptionError("a batch needs at least one clip and two moments of each")


@dataclass(frozen=True)
class SyncClip:
    """One sequence's lips and sound.

    Parameters
    ----------
    mouth : (T, L, 3) float32
        Landmarks, zero pose, metres.
    neutral : (L, 3) float32
        The subject at rest.
    features : (steps, dim) float32
        Of the sound.
    """

    mouth: Float32[Tensor, "frames landmarks 3"]
    neutral: Float32[Tensor, "landmarks 3"]
    features: Float32[Tensor, "steps dim"]


class SyncTask:
    """Batches of moments, each to be told from all others by its sound and by its lips.

    Parameters
    ----------
    config : SyncConfig
        The network's.
    clips : sequence of SyncClip
        Training data.
    fps : float
        Of their lips.
    clips_a_batch, moments : int
        Size of a batch.
    seed : int
        Of the order.
    """

    def __init__(
        self,
        config: SyncConfig,
        clips: Sequence[SyncClip],
        fps: float,
        clips_a_batch: int = 8,
        moments: int = 8,
        seed: int = 0,
    ):
        self.config, self.clips, self.fps, self.moments = config, clips, fps, moments
        frames = int(np.ceil(moments * APART * fps))
        self.sampler = WindowSampler([len(clip.mouth) for clip in clips], frames, clips_a_batch, seed)

    def batch(self, number: int, share: int = 0, shares: int = 1) -> dict[str, Any]:
        """Moments (B, 5, 3 L) and features (B, steps, dim), those of one clip one after the other."""
        seen, heard = [], []
        for span in self.sampler.spans(number, share, shares):
            clip = self.clips[span.clip]
            times = (
                span.first / self.fps + (torch.arange(self.moments, dtype=torch.float64) + span.coin) * APART
            )
            seen.append(mouth_moments(clip.mouth, clip.neutral, self.fps, times))
            heard.append(speech_moments(clip.features, self.config, times))
        return {"moments": torch.cat(seen), "features": torch.cat(heard)}

    def loss(self, model: nn.Module, batch: Mapping[str, Any]) -> tuple[Tensor, dict[str, Tensor]]:
        """Cross entropy of the right sound among all of the batch, and of the right lips."""
        likeness = model(batch["moments"], batch["features"])
        right = torch.arange(len(likeness), device=likeness.device)
        sound = functional.cross_entropy(likeness, right)
        lips = functional.cross_entropy(likeness.mT, right)
        found = (likeness.detach().argmax(1) == right).float().mean()
        return (sound + lips) / 2, {"sound": sound, "lips": lips, "found": found}

    def save(self, model: nn.Module, directory: Path) -> None:
        assert isinstance(model, SyncNet)
        model.save_pretrained(directory)


def parts_of(dataset: MeshanimDataset, file: Path | None = None) -> FaceParts:
    """The parts of a data set's face: from a file, or by its head.

    Raises
    ------
    OptionError
        If it has no head and no file is given, or they name vertices that it lacks.
    """
    if file is None and not dataset.head:
        raise OptionError(f"{dataset.directory} has no head: name its lips with --parts")
    parts = face_parts(load_head(dataset.head)) if file is None else FaceParts.load(file)
    if parts.largest >= dataset.surface.n_vertices:
        raise OptionError(
            f"vertex {parts.largest} is none of the {dataset.surface.n_vertices} of this data set"
        )
    return parts


def load_sync_clips(
    dataset: MeshanimDataset,
    names: Sequence[str],
    landmarks: Sequence[int],
    features: FeatureCache,
    progress: bool = False,
) -> list[SyncClip]:
    """Lips and speech features of sequences; features that are missing in the cache are made."""
    rows = list(landmarks)
    clips = []
    for name in tqdm(names, unit="clip", desc="lips", disable=not progress):
        sequence = dataset[name]
        tracks = features.tracks(name, sequence.audio, 0, lambda: ())
        assert tracks is not None  # it waits
        clips.append(
            SyncClip(
                torch.from_numpy(np.ascontiguousarray(sequence.vertices[:, rows], np.float32)),
                torch.from_numpy(dataset.subjects[sequence.info.subject].template[rows]),
                torch.from_numpy(tracks[0][0][:].astype(np.float32)),
            )
        )
    return clips


def train_syncnet(options: TrainSyncNetOptions, progress: bool = True) -> Path:
    """Train, and give the folder of the finished model.

    Raises
    ------
    FileFormatError, OptionError
        If the data cannot be read or an option does not fit them.
    """
    torch.manual_seed(options.train.seed)
    state = PartialState(cpu=options.cpu)
    progress = progress and state.is_main_process
    dataset = MeshanimDataset(options.data)
    landmarks = mouth_landmarks(parts_of(dataset, options.parts))
    encoder = load_encoder(options.encoder)
    with state.main_process_first():
        cache = FeatureCache(options.cache or cache_folder(options.data), encoder, options.train.seed)
        clips = load_sync_clips(dataset, dataset.split("train"), landmarks, cache, progress)
    config = SyncConfig(encoder.dim, encoder.rate, options.encoder, landmarks, dataset.head, options.width)
    network = SyncNet(config)
    set_statistics(network, clips, dataset.fps)
    task = SyncTask(config, clips, dataset.fps, options.clips, options.moments, options.train.seed)
    trainer = Trainer(network, task, options.train, options.output, cpu=options.cpu)
    trainer.resume()
    trainer.run(progress=progress)
    return options.output / "model"


def set_statistics(network: SyncNet, clips: Sequence[SyncClip], fps: float) -> None:
    """Put means and deviations of lip motion and of features into the network's buffers."""

    def note(name: str, rows: Tensor) -> None:
        deviation = rows.std(0, correction=0)
        getattr(network, f"{name}_mean").copy_(rows.mean(0))
        # A landmark that hardly moves must not become loud.
        getattr(network, f"{name}_scale").copy_(deviation.clamp_min(0.1 * float(rows.std()) + 1e-6))

    def middles(clip: SyncClip) -> Tensor:
        return (torch.arange(int(len(clip.mouth) / fps * RATE), dtype=torch.float64) + 0.5) / RATE

    note("feature", torch.cat([clip.features for clip in clips]))
    moved = [mouth_moments(clip.mouth, clip.neutral, fps, middles(clip))[:, 2] for clip in clips]
    note("mouth", torch.cat(moved))
