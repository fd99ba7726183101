"""Clips of animation states with their sound and speech features, for both Audio2Face networks."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int16, Int64
from torch import Tensor
from tqdm import tqdm

from meshanim.audio import SpeechEncoder, Waveform
from meshanim.datasets.animation_states import PHONEME_RATE, AnimationStates, ClipArrays, StateClip
from meshanim.errors import OptionError
from meshanim.files import written_whole
from meshanim.models.audio2face.speech import RATE, Hearing, cut_windows, features_at, window_features
from meshanim.training.array_rows import ArrayRows
from meshanim.training.feature_cache import FeatureCache

__all__ = ["SpeechClip", "chosen_subjects", "felt", "load_speech_clips"]

FULL_SCALE = 32768.0


@dataclass(frozen=True)
class SpeechClip:
    """A clip of animation states and what is heard in it.

    Parameters
    ----------
    clip : StateClip
        Name, subject, emotion, language.
    arrays : ClipArrays
        States, timeline, eyes, phonemes.
    samples : (N,) int16
        Sound, 16 kHz.
    features : rows on disk
        Steps of the whole speech, or a row of `steps * dim` numbers for each frame's window.
    """

    clip: StateClip
    arrays: ClipArrays
    samples: Int16[np.ndarray, " samples"]
    features: ArrayRows

    def __len__(self) -> int:
        return len(self.arrays.state)

    def sound(self, starts: Sequence[int], width: int) -> Float32[Tensor, "batch width"]:
        """Windows of sound by their first samples, zeros beyond the ends."""
        first, last = max(min(starts), 0), max(max(starts) + width, 0)
        part = torch.from_numpy(self.samples[first:last].astype(np.float32)) / FULL_SCALE
        return cut_windows(part, [start - first for start in starts], width)

    def features_at(self, rate: float, times: Float64[Tensor, "*times"]) -> Float32[Tensor, "*times dim"]:
        """Features of the whole speech at times, reading only the steps around them."""
        first = max(0, min(int(float(times.min()) * rate - 0.5) - 1, len(self.features) - 1))
        last = max(first + 1, int(float(times.max()) * rate + 0.5) + 2)
        part = torch.from_numpy(self.features[first:last].astype(np.float32))
        return features_at(part, rate, times - first / rate)

    def phonemes_at(self, times: Float64[np.ndarray, "*times"]) -> Int64[np.ndarray, "*times"]:
        """Labels at times: -1 where nothing is known, silence beyond the ends."""
        labels = self.arrays.phonemes
        if not len(labels) or labels[0] < 0:
            return np.full(times.shape, -1)
        step = np.floor(times * PHONEME_RATE).astype(np.int64)
        inside = (step >= 0) & (step < len(labels))
        return np.where(inside, labels[step.clip(0, len(labels) - 1)], 0)


def chosen_subjects(states: AnimationStates, subject: str) -> tuple[str, ...]:
    """One subject by name, or the only one there is.

    Raises
    ------
    OptionError
        If there are several and none is named.
    """
    people = tuple(states.templates)
    if not subject and len(people) > 1:
        raise OptionError(
            f"{states.directory} has several subjects: choose one with --subject: {', '.join(people)}"
        )
    return (subject,) if subject else people


def felt(clips: Sequence[SpeechClip]) -> tuple[str, ...]:
    """Emotions of clips but neutral, by name."""
    return tuple(sorted({clip.clip.emotion for clip in clips} - {"neutral"}))


def load_speech_clips(
    states: AnimationStates,
    clips: Sequence[StateClip],
    encoder: SpeechEncoder,
    hearing: Hearing,
    cache: Path,
    window: tuple[int, Float64[np.ndarray, " steps"]] | None = None,
    progress: bool = False,
) -> list[SpeechClip]:
    """Clips with their features; those that are missing in the cache are made.

    Parameters
    ----------
    states : AnimationStates
        The data.
    clips : sequence of StateClip
        Which of its clips.
    encoder : SpeechEncoder
        Frozen.
    hearing : "speech" or "window"
        Features of the whole sound, or of each frame's window alone.
    cache : Path
        Folder of features.
    window : (samples, times), optional
        Width of a frame's window and the times of its steps from its beginning; needed for "window".
    progress : bool
        Show a bar.
    """
    features = FeatureCache(cache, encoder)
    loaded = []
    for clip in tqdm(clips, unit="clip", desc="features", disable=not progress):
        waveform, arrays = states.audio(clip.name), states.arrays(clip.name)
        if hearing == "window":
            assert window is not None
            track = _window_track(features.folder, encoder, clip, waveform, states.fps, *window)
        else:
            tracks = features.tracks(clip.name, waveform, 0, list)
            assert tracks is not None
            track = tracks[0][0]
        samples = np.rint(waveform.samples * FULL_SCALE).clip(-FULL_SCALE, FULL_SCALE - 1).astype(np.int16)
        loaded.append(SpeechClip(clip, arrays, samples, track))
    return loaded


def _window_track(
    folder: Path,
    encoder: SpeechEncoder,
    clip: StateClip,
    waveform: Waveform,
    fps: float,
    width: int,
    times: Float64[np.ndarray, " steps"],
) -> ArrayRows:
    """A row for each frame: the features of its window, step after step, in half precision."""
    sound = hashlib.blake2b(waveform.samples.tobytes(), digest_size=6).hexdigest()
    path = folder / f"{clip.name}-{sound}-{width}-{fps:g}.windows.npy"
    if not path.exists():
        samples = torch.from_numpy(waveform.samples)
        starts = [round((frame + 0.5) / fps * RATE - width / 2) for frame in range(clip.frames)]
        rows = [
            window_features(encoder, cut_windows(samples, starts[k : k + 32], width), torch.from_numpy(times))
            for k in range(0, len(starts), 32)
        ]
        with written_whole(path) as temporary, open(temporary, "wb") as file:
            np.save(file, torch.cat(rows).flatten(1).numpy().astype(np.float16))
    return ArrayRows.open(path)
