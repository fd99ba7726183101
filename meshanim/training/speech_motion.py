"""Speech with mesh motion, clip by clip on disk, as what a training batch is made of."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int
from torch import Tensor
from tqdm import tqdm

from meshanim.datasets.meshanim_format import MeshanimDataset, SequenceInfo
from meshanim.errors import OptionError
from meshanim.training.array_rows import ArrayRows, rows_on_disk
from meshanim.training.feature_cache import FeatureCache, Voices

__all__ = ["MEL_RATE", "Clip", "SpeechTracks", "load_clips"]

MEL_RATE = 100.0


@dataclass(frozen=True)
class Clip:
    """One sequence; its motion and its features stay on disk.

    Parameters
    ----------
    info : SequenceInfo
        Text, phonemes, emotion.
    subject : int
        Row among the templates.
    style : int
        Row among the subjects that have a style, or -1.
    emotion : int
        Row among the emotions, 0 for neutral.
    intensity : float
        Of the emotion.
    vertices : (T, V, 3)
        Zero pose, metres; slices of it are arrays.
    pose : (T, 3)
        Radians.
    features, mels : sequence of (steps, dim) half-precision rows
        Of the clean sound, then of its degraded variants.
    """

    info: SequenceInfo
    subject: int
    style: int
    emotion: int
    intensity: float
    vertices: Float32[np.ndarray, "frames vertices 3"] | ArrayRows
    pose: Float32[np.ndarray, "frames 3"]
    features: Sequence[ArrayRows]
    mels: Sequence[ArrayRows]

    def __len__(self) -> int:
        return len(self.pose)


def load_clips(
    dataset: MeshanimDataset,
    names: Sequence[str],
    cache: FeatureCache,
    styles: Sequence[str],
    emotions: Sequence[str],
    variants: int = 0,
    progress: bool = True,
    share: int = 0,
    shares: int = 1,
) -> list[Clip]:
    """Clips of a data set; features that are missing in the cache are made.

    Several processes may do this at once: each begins with its share and takes over what nobody works on.

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
    share, shares : int
        Which process of how many this is.
    """
    people = list(dataset.subjects)
    voices = Voices(dataset, names)
    clips: dict[str, Clip] = {}
    first = share * len(names) // shares
    left = deque([*names[first:], *names[:first]])
    busy = 0
    with tqdm(total=len(names), unit="clip", desc="features", disable=not progress) as bar:
        while left:
            name = left.popleft()
            sequence = dataset[name]
            info = sequence.info
            if info.emotion not in emotions:
                raise OptionError(
                    f"{info.name} has emotion {info.emotion!r}; the network knows {', '.join(emotions)}"
                )
            # What another process makes comes last; when nothing else is left, wait for it.
            tracks = cache.tracks(name, sequence.audio, variants, voices, wait=busy >= len(left))
            if tracks is None:
                left.append(name)
                busy += 1
                continue
            busy = 0
            features, mels = zip(*tracks)
            clips[name] = Clip(
                info,
                people.index(info.subject),
                styles.index(info.subject) if info.subject in styles else -1,
                emotions.index(info.emotion),
                info.intensity,
                rows_on_disk(sequence.vertices),
                sequence.pose,
                features,
                mels,
            )
            bar.update()
    return [clips[name] for name in names]


class SpeechTracks:
    """The feature tracks of all clips, read as windows around many frames at once.

    The same windows as `feature_windows` gives clip by clip; only the part of a track that a batch needs is
    read.

    Parameters
    ----------
    tracks : sequence of sequence of (steps, dim) rows
        Variants of each clip; all clips have as many.
    rate : float
        Feature frames a second.
    width : int
        Feature frames a window.
    """

    def __init__(self, tracks: Sequence[Sequence[ArrayRows | np.ndarray]], rate: float, width: int):
        self.tracks = [track for variants in tracks for track in variants]
        self.rate, self.width, self.variants = rate, width, len(tracks[0])
        self.last = torch.tensor([len(track) for track in self.tracks]) - 1

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
        upper = torch.minimum(lower + 1, last)
        weight = (position - lower).float()[..., None]
        below = above = None
        for number in track.unique().tolist():
            rows = track == number
            first, end = int(lower[rows].min()), int(upper[rows].max()) + 1
            part = torch.from_numpy(self.tracks[number][first:end]).float()
            if below is None or above is None:
                below = part.new_empty(*position.shape, part.shape[1])
                above = torch.empty_like(below)
            below[rows], above[rows] = part[lower[rows] - first], part[upper[rows] - first]
        assert below is not None
        assert above is not None
        return below.lerp(above, weight)
