"""Speech features on disk: made once by any number of processes, read in parts."""

import hashlib
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import torch
from filelock import FileLock, Timeout
from tqdm import tqdm
from tyro.conf import Positional

from meshanim.audio import SpeechEncoder, Waveform, load_encoder, log_mel
from meshanim.audio.augmentation import degrade
from meshanim.datasets.meshanim_format import MeshanimDataset
from meshanim.errors import FileFormatError, OptionError
from meshanim.files import written_whole
from meshanim.jobs import run_jobs
from meshanim.training.array_rows import ArrayRows

__all__ = ["CacheFeaturesOptions", "FeatureCache", "Voices", "cache_features", "cache_folder"]

WAVEFORM_RATE = 16000
VOICES = 64
"""Voices that babble is made of, spread over the data."""
Tracks = list[tuple[ArrayRows, ArrayRows]]


class FeatureCache:
    """Speech features of sound files on disk, for one encoder, clean and degraded.

    An entry belongs to its sound and to what the encoder gives for a fixed noise: a changed file or a
    retrained encoder starts anew. Entries are written whole, and under a lock: processes that fill one cache
    do nothing twice. (Where a network's file system has no locks they may, with the same result.)

    Parameters
    ----------
    directory : Path
        Gets a folder an encoder; made where it is missing.
    encoder : SpeechEncoder
        Frozen.
    seed : int
        Of the degradation.
    """

    def __init__(self, directory: str | Path, encoder: SpeechEncoder, seed: int = 0):
        noise = np.random.default_rng(0).normal(0, 0.1, WAVEFORM_RATE // 2).astype(np.float32)
        probe = encoder(Waveform(noise, WAVEFORM_RATE)).numpy().round(2)
        mark = hashlib.blake2b(probe.tobytes(), digest_size=6).hexdigest()
        # A folder's name alone, so that a cache may be made under a relative and read under an absolute one.
        kind, _, path = encoder.name.partition(":")
        name = "".join(c if c.isalnum() else "-" for c in f"{kind}-{Path(path).name}".strip("-"))
        self.folder = Path(directory) / f"{name}-{mark}-{seed}"
        try:
            (self.folder / "locks").mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise FileFormatError(f"cannot write speech features to {self.folder}: {error}") from error
        self.encoder, self.seed = encoder, seed

    def tracks(
        self,
        name: str,
        audio: Waveform,
        variants: int,
        others: Callable[[], Sequence[np.ndarray]],
        wait: bool = True,
    ) -> Tracks | None:
        """Features and log-mel of a sound, made where they are missing.

        Parameters
        ----------
        name : str
            Of the sequence.
        audio : Waveform
            Its sound.
        variants : int
            Degraded variants, each in its own way, beside the clean sound, which is the first.
        others : callable
            Gives the voices that noise may be made of, 16 kHz.
        wait : bool
            Whether to wait for another process that makes them; None otherwise.

        Raises
        ------
        FileFormatError
            If an entry is damaged.
        """
        sound = hashlib.blake2b(audio.samples.tobytes(), digest_size=6).hexdigest()
        paths = [self._paths(f"{name}-{sound}.{k}") for k in range(variants + 1)]
        if not all(features.exists() for features, _ in paths):
            try:
                # A lock for every first byte of the sound, so that there are no more files than that.
                with FileLock(self.folder / "locks" / sound[:2], blocking=wait):
                    for variant, (features, mel) in enumerate(paths):
                        if not features.exists():
                            self._write(name, audio, variant, others, features, mel)
            except Timeout:
                return None
        return [(ArrayRows.open(features), ArrayRows.open(mel)) for features, mel in paths]

    def _paths(self, entry: str) -> tuple[Path, Path]:
        return self.folder / f"{entry}.features.npy", self.folder / f"{entry}.mel.npy"

    def _write(
        self,
        name: str,
        audio: Waveform,
        variant: int,
        others: Callable[[], Sequence[np.ndarray]],
        features: Path,
        mel: Path,
    ) -> None:
        if variant:
            digest = hashlib.blake2b(f"{name}.{variant}.{self.seed}".encode(), digest_size=8).digest()
            audio = _degraded(audio, np.random.default_rng(int.from_bytes(digest)), others())
        # The features last: where they are, all is.
        _save(mel, log_mel(audio).numpy().astype(np.float16))
        _save(features, self.encoder(audio).numpy().astype(np.float16))


def _save(path: Path, values: np.ndarray) -> None:
    with written_whole(path) as temporary, open(temporary, "wb") as file:
        np.save(file, values)


def _degraded(audio: Waveform, generator: np.random.Generator, others: Sequence[np.ndarray]) -> Waveform:
    def babble(rng: np.random.Generator, count: int) -> np.ndarray:
        voices = [others[int(rng.integers(len(others)))] for _ in range(int(rng.integers(3, 7)))]
        shifts = [int(rng.integers(len(voice))) for voice in voices]
        mixed = np.stack([np.resize(np.roll(v, s), count) for v, s in zip(voices, shifts)])
        return mixed.sum(0).astype(np.float32)

    samples = audio.resampled(WAVEFORM_RATE).samples
    return Waveform(degrade(samples[None], generator, babble)[0].numpy(), WAVEFORM_RATE)


class Voices:
    """Some of a data set's voices, read when they are first asked for.

    Parameters
    ----------
    dataset : MeshanimDataset
        The data.
    names : sequence of str
        Sequences, of which some are taken.
    """

    def __init__(self, dataset: MeshanimDataset, names: Sequence[str]):
        self.dataset, self.names = dataset, names[:: max(1, len(names) // VOICES)]
        self.samples: list[np.ndarray] = []

    def __call__(self) -> list[np.ndarray]:
        if not self.samples:
            sounds = (self.dataset[name].audio for name in self.names)
            self.samples = [sound.resampled(WAVEFORM_RATE).samples for sound in sounds]
        return self.samples


@dataclass(frozen=True)
class CacheFeaturesOptions:
    """Make the speech features that training reads, in parallel, ahead of it.

    Example: meshanim data cache-features corpus --encoder visemes --variants 3
    """

    directory: Positional[Path]
    """Folder of a data set in the project's format."""
    encoder: str = "visemes"
    """Speech encoder: visemes, mel, phones, wav2vec2:PATH, hubert:PATH."""
    variants: int = 3
    """Degraded variants of each sound beside the clean one, as in training."""
    split: str = "train"
    """Split of the data set."""
    seed: int = 0
    """Of the degradation: the seed of the training run."""
    cache: Path | None = None
    """Where features are kept; DIRECTORY/features, where training looks, if not given."""
    workers: int = 0
    """Processes; 0 takes one a core."""
    dask: str = ""
    """Address of a Dask scheduler, such as tcp://host:8786, whose workers do it instead."""

    def __post_init__(self):
        for name in ("variants", "seed", "workers"):
            if getattr(self, name) < 0:
                raise OptionError(f"--{name} must not be negative, not {getattr(self, name)}")


def cache_folder(directory: Path) -> Path:
    """Where the features of a data set are kept unless told otherwise."""
    return directory / "features"


def cache_features(options: CacheFeaturesOptions, progress: bool = True) -> Path:
    """Fill a cache; give the folder of its entries.

    Raises
    ------
    FileFormatError, OptionError
        If the data set cannot be read or the encoder does not exist.
    """
    directory = options.directory.absolute()
    names = MeshanimDataset(directory).split(options.split)
    kind, separator, path = options.encoder.partition(":")
    if separator and Path(path.partition("@")[0]).exists():
        path = os.path.abspath(path)
    job = _Fill(
        directory,
        kind + separator + path,
        (options.cache or cache_folder(directory)).absolute(),
        options.variants,
        options.split,
        options.seed,
    )
    _opened(job)  # what does not exist is said before any worker starts
    for _ in tqdm(
        run_jobs(partial(_fill, job), names, options.workers, options.dask),
        total=len(names),
        unit="clip",
        desc="features",
        disable=not progress,
    ):
        pass
    return _opened(job)[1].folder


@dataclass(frozen=True)
class _Fill:
    directory: Path
    encoder: str
    cache: Path
    variants: int
    split: str
    seed: int


@lru_cache(maxsize=1)
def _opened(job: _Fill) -> tuple[MeshanimDataset, FeatureCache, Voices]:
    dataset = MeshanimDataset(job.directory)
    cache = FeatureCache(job.cache, load_encoder(job.encoder), job.seed)
    return dataset, cache, Voices(dataset, dataset.split(job.split))


def _fill(job: _Fill, name: str) -> str:
    """Make the entries of one sequence; one thread, for there is a process a core."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        dataset, cache, voices = _opened(job)
        cache.tracks(name, dataset[name].audio, job.variants, voices)
    finally:
        torch.set_num_threads(threads)
    return name
