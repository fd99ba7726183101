"""Speech with mesh motion, as windows of consecutive frames for training."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int
from torch import Tensor
from tqdm import tqdm

from meshanim.audio import SpeechEncoder, Waveform, log_mel
from meshanim.audio.augmentation import degrade
from meshanim.datasets.meshanim_format import MeshanimDataset, SequenceInfo
from meshanim.errors import FileFormatError, OptionError
from meshanim.files import written_whole

__all__ = ["Clip", "FeatureCache", "SpeechTracks", "WindowSampler", "load_clips"]

MEL_RATE = 100.0
WAVEFORM_RATE = 16000


@dataclass(frozen=True)
class Clip:
    """One sequence, its motion on disk, its features in memory.

    Parameters
    ----------
    info : SequenceInfo
        Text, phonemes, emotion.
    subject : int
        Row among the templates of the data set.
    style : int
        Row among the subjects that have a style, or -1.
    emotion : int
        Row among the emotions, 0 for neutral.
    intensity : float
        Of the emotion.
    vertices : (T, V, 3)
        Zero pose, metres; may be memory-mapped.
    pose : (T, 3)
        Radians.
    features, mels : sequence of (steps, dim) half tensors
        Of the clean sound, then of its degraded variants.
    """

    info: SequenceInfo
    subject: int
    style: int
    emotion: int
    intensity: float
    vertices: Float32[np.ndarray, "frames vertices 3"]
    pose: Float32[np.ndarray, "frames 3"]
    features: Sequence[Float[Tensor, "steps dim"]]
    mels: Sequence[Float[Tensor, "mel_steps bands"]]

    def __len__(self) -> int:
        return len(self.pose)


class FeatureCache:
    """Speech features of sound files on disk, for one encoder, clean and degraded.

    An entry belongs to its sound and to what the encoder gives for a fixed noise: a changed file or a
    retrained encoder starts anew.

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
        name = "".join(c if c.isalnum() else "-" for c in encoder.name)
        self.folder = Path(directory) / f"{name}-{mark}-{seed}"
        self.folder.mkdir(parents=True, exist_ok=True)
        self.encoder, self.seed = encoder, seed

    def get(
        self, name: str, audio: Waveform, variant: int, others: Sequence[np.ndarray]
    ) -> tuple[Tensor, Tensor]:
        """Features and log-mel of a variant: 0 is the clean sound, others are degraded in their own ways.

        Parameters
        ----------
        name : str
            Of the sequence.
        audio : Waveform
            Its sound.
        variant : int
            Which.
        others : sequence of (samples,) arrays
            Voices that noise may be made of, 16 kHz.
        """
        sound = hashlib.blake2b(audio.samples.tobytes(), digest_size=6).hexdigest()
        path = self.folder / f"{name}-{sound}.{variant}.npz"
        if not path.exists():
            if variant:
                digest = hashlib.blake2b(f"{name}.{variant}.{self.seed}".encode(), digest_size=8).digest()
                audio = _degraded(audio, np.random.default_rng(int.from_bytes(digest)), others)
            with written_whole(path) as temporary, open(temporary, "wb") as file:
                np.savez(
                    file,
                    features=self.encoder(audio).numpy().astype(np.float16),
                    mel=log_mel(audio).numpy().astype(np.float16),
                )
        try:
            with np.load(path) as archive:
                return torch.from_numpy(archive["features"]), torch.from_numpy(archive["mel"])
        except (OSError, ValueError, KeyError) as error:
            raise FileFormatError(f"{path} is damaged ({error}): delete it") from error


def _degraded(audio: Waveform, generator: np.random.Generator, others: Sequence[np.ndarray]) -> Waveform:
    def babble(rng: np.random.Generator, count: int) -> np.ndarray:
        voices = [others[int(rng.integers(len(others)))] for _ in range(int(rng.integers(3, 7)))]
        shifts = [int(rng.integers(len(voice))) for voice in voices]
        mixed = np.stack([np.resize(np.roll(v, s), count) for v, s in zip(voices, shifts)])
        return mixed.sum(0).astype(np.float32)

    samples = audio.resampled(WAVEFORM_RATE).samples
    return Waveform(degrade(samples[None], generator, babble)[0].numpy(), WAVEFORM_RATE)


def load_clips(
    dataset: MeshanimDataset,
    names: Sequence[str],
    cache: FeatureCache,
    styles: Sequence[str],
    emotions: Sequence[str],
    variants: int = 0,
    progress: bool = True,
) -> list[Clip]:
    """Clips of a data set with cached features.

    Parameters
    ----------
    dataset : MeshanimDataset
        The data.
    names : sequence of str
        Which sequences.
    cache : FeatureCache
        Gives and keeps the features.
    styles, emotions : sequence of str
        Subjects that have a style and emotions, in the order of the network.
    variants : int
        Degraded variants of each sound beside the clean one.
    progress : bool
        Whether to show a bar.
    """
    people = list(dataset.subjects)
    sequences = [dataset[name] for name in names]
    voices = [
        sequence.audio.resampled(WAVEFORM_RATE).samples for sequence in sequences[:: max(1, len(names) // 64)]
    ]
    clips = []
    for sequence in tqdm(sequences, unit="clip", desc="features", disable=not progress):
        info = sequence.info
        if info.emotion not in emotions:
            raise OptionError(
                f"{info.name} has emotion {info.emotion!r}; the network knows {', '.join(emotions)}"
            )
        features, mels = zip(*(cache.get(info.name, sequence.audio, k, voices) for k in range(variants + 1)))
        clips.append(
            Clip(
                info,
                people.index(info.subject),
                styles.index(info.subject) if info.subject in styles else -1,
                emotions.index(info.emotion),
                info.intensity,
                sequence.vertices,
                sequence.pose,
                features,
                mels,
            )
        )
    return clips


class WindowSampler:
    """Which windows of consecutive frames a batch has, as a function of its number.

    Every epoch is a new permutation of all windows, cut at a new offset.

    Parameters
    ----------
    lengths : sequence of int
        Frames of each clip; clips shorter than a window are left out.
    frames : int
        Consecutive frames a window.
    windows : int
        Windows a batch.
    seed : int
        Of the order.
    """

    def __init__(self, lengths: Sequence[int], frames: int, windows: int, seed: int = 0):
        self.lengths, self.frames, self.windows, self.seed = list(lengths), frames, windows, seed
        self.slots = [(clip, k) for clip, n in enumerate(lengths) for k in range(n // frames)]
        if not self.slots:
            raise OptionError(f"no clip has the {frames} consecutive frames of a window")
        self._epoch: tuple[int, Tensor, Tensor] | None = None

    def picks(self, number: int) -> list[tuple[int, int]]:
        """(clip, first frame) of each window of a batch."""
        picks = []
        for position in range(number * self.windows, (number + 1) * self.windows):
            epoch, place = divmod(position, len(self.slots))
            if self._epoch is None or self._epoch[0] != epoch:
                generator = torch.Generator().manual_seed(self.seed * 1_000_003 + epoch)
                order = torch.randperm(len(self.slots), generator=generator)
                offsets = torch.randint(self.frames, (len(self.lengths),), generator=generator)
                self._epoch = (epoch, order, offsets)
            _, order, offsets = self._epoch
            clip, k = self.slots[int(order[place])]
            first = min(k * self.frames + int(offsets[clip]), self.lengths[clip] - self.frames)
            picks.append((clip, first))
        return picks


class SpeechTracks:
    """The feature tracks of all clips end to end, read as windows around many frames at once.

    The same windows as `feature_windows` gives clip by clip.

    Parameters
    ----------
    tracks : sequence of sequence of (steps, dim) tensors
        Variants of each clip; all clips have as many.
    rate : float
        Feature frames a second.
    width : int
        Feature frames a window.
    """

    def __init__(self, tracks: Sequence[Sequence[Float[Tensor, "_ dim"]]], rate: float, width: int):
        flat = [track for variants in tracks for track in variants]
        self.rate, self.width, self.variants = rate, width, len(tracks[0])
        lengths = torch.tensor([len(track) for track in flat])
        self.last = lengths - 1
        self.start = lengths.cumsum(0) - lengths
        self.values = torch.cat(flat)

    def windows(
        self, clips: Int[Tensor, " batch"], variants: Int[Tensor, " batch"], times: Float64[Tensor, " batch"]
    ) -> Float32[Tensor, "batch width dim"]:
        """Windows centred on times, seconds, of variants of clips."""
        track = clips * self.variants + variants
        steps = torch.arange(self.width, dtype=torch.float64) - (self.width - 1) / 2
        position = times[:, None] * self.rate - 0.5 + steps
        last = self.last[track][:, None]
        position = torch.minimum(position.clamp_min(0), last.double())
        lower = position.floor().long()
        weight = (position - lower).float()[..., None]
        start = self.start[track][:, None]
        below = self.values[start + lower].float()
        return below.lerp(self.values[start + torch.minimum(lower + 1, last)].float(), weight)
