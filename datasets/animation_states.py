"""Audio2Face-3D's training data: animation states beside the data they were made of.

    DIR/a2f.json                      rate, emotions, subjects, clips, source; written last
    DIR/basis.safetensors             `StateBasis`, and templates.NAME (V, 3) of every subject, metres
    DIR/clips/NAME.safetensors        state (T, D) float32; timeline (T,) float64; open (T,) uint8;
                                      phonemes (S,) int64 at 50 a second
    DIR/clips/NAME.wav                the sound, 16 kHz

A clip's frame i is at (i + 0.5) / fps seconds of its sound, and at frame `timeline[i]`, a real number, of a
sequence of the source: warped and resting clips need no vertices of their own. `open` is 0 where the eyes are
closed, a phoneme is an index into `meshanim.audio.PHONEMES` or -1 where it is not known.
"""

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from meshanim.audio import Waveform, load_waveform, save_waveform
from meshanim.datasets.motion_dataset import LOADERS, DatasetSource, MotionDataset, loader
from meshanim.errors import FileFormatError, OptionError
from meshanim.files import written_whole
from meshanim.motion.animation_state import read_actors

__all__ = ["PHONEME_RATE", "AnimationStates", "ClipArrays", "StateClip", "at_positions"]

PHONEME_RATE = 50.0
VERSION = 1


@dataclass(frozen=True)
class StateClip:
    """What is known about a clip without its arrays.

    Parameters
    ----------
    name : str
        Unique; NAME of its files.
    sequence : str
        Of the source.
    subject : str
        Who speaks.
    frames : int
        T.
    emotion : str
        "neutral" or a name.
    intensity : float
        Of the emotion, 0 to 1.
    made : str
        recorded, silence, pitch, voice or speech.
    split : str
        Of the source, "train" where it has none.
    language : str
        Of what is said.
    labels : str
        Where the phonemes are from: given, aligned, recognized, or none.
    """

    name: str
    sequence: str
    subject: str
    frames: int
    emotion: str = "neutral"
    intensity: float = 0.0
    made: str = "recorded"
    split: str = "train"
    language: str = "en"
    labels: str = "none"


@dataclass(frozen=True)
class ClipArrays:
    """What a clip's file holds, as the top of this module says."""

    state: Float32[np.ndarray, "frames state"]
    timeline: Float64[np.ndarray, " frames"]
    open: UInt8[np.ndarray, " frames"]
    phonemes: Int64[np.ndarray, " labels"]

    def save(self, path: Path) -> None:
        """Write a safetensors file whole."""
        arrays = {name: np.ascontiguousarray(value) for name, value in asdict(self).items()}
        with written_whole(path) as temporary:
            save_file(arrays, temporary)

    @classmethod
    def load(cls, path: Path) -> "ClipArrays":
        """Read what `save` wrote; FileFormatError if it is missing or damaged."""
        try:
            arrays = load_file(path)
            clip = cls(*(arrays[name] for name in ("state", "timeline", "open", "phonemes")))
        except (OSError, SafetensorError, KeyError) as error:
            raise FileFormatError(f"{path} is no clip of animation states: {error}") from error
        if not (len(clip.state) == len(clip.timeline) == len(clip.open) and np.isfinite(clip.state).all()):
            raise FileFormatError(f"{path} holds arrays of different lengths, or NaN")
        return clip


def at_positions(array: np.ndarray, positions: Float64[np.ndarray, " frames"]) -> np.ndarray:
    """Rows of an array at real-numbered positions, by linear interpolation, in the array's precision."""
    positions = np.clip(positions, 0, len(array) - 1)
    lower = np.minimum(positions.astype(np.int64), max(len(array) - 2, 0))
    first = int(lower.min())
    part = np.asarray(array[first : int(lower.max()) + 2])
    weight = (positions - lower).astype(array.dtype).reshape(-1, *(1 for _ in array.shape[1:]))
    below, above = part[lower - first], part[np.minimum(lower - first + 1, len(part) - 1)]
    return below + weight * (above - below)


class AnimationStates:
    """Reads the layout at the top of this module.

    Parameters
    ----------
    directory : path
        What `meshanim data a2f` wrote.

    Attributes
    ----------
    fps : float
        Frames a second.
    head : str
        What `load_head` understands, or "".
    emotions : tuple of str
        "neutral" first.
    actors : Actors
        The next three.
    basis : StateBasis
        States to vertices.
    templates : dict of (V, 3) tensors
        Neutral faces, metres, by subject.
    clips : dict of StateClip
        By name.
    faces : (F, 3) array
        Of the source's mesh; empty where it has none.

    Raises
    ------
    FileFormatError
        If a file is missing, damaged or of another version.
    """

    def __init__(self, directory: str | Path):
        self.directory = Path(directory)
        path = self.directory / "a2f.json"
        try:
            record = json.loads(path.read_text(encoding="utf-8"))
            if record["version"] != VERSION:
                raise ValueError(f"version {record['version']}, expected {VERSION}")
            self.fps, self.head = float(record["fps"]), str(record["head"])
            self.emotions = tuple(record["emotions"])
            self.explained: dict[str, float] = record["explained"]
            self.clips = {entry["name"]: StateClip(**entry) for entry in record["clips"]}
            self._source: dict[str, Any] = record["source"]
        except OSError as error:
            raise FileFormatError(
                f"cannot read {path}: {error.strerror}; meshanim data a2f makes it"
            ) from error
        except (ValueError, KeyError, TypeError) as error:
            raise FileFormatError(f"{path} does not describe animation states: {error}") from error
        self.actors = read_actors(self.directory / "basis.safetensors")
        self.basis, self.templates, self.faces = self.actors

    def of(
        self, subjects: Sequence[str] = (), split: str = "train", made: Sequence[str] = ()
    ) -> list[StateClip]:
        """Clips of some subjects (all if none are named) in a split, made in some ways (any if not named).

        Raises
        ------
        OptionError
            If there is no such subject, or no clip.
        """
        unknown = [name for name in subjects if name not in self.templates]
        if unknown:
            raise OptionError(
                f"no subject {unknown[0]!r} in {self.directory}; there are {', '.join(self.templates)}"
            )
        found = [
            clip
            for clip in self.clips.values()
            if clip.split == split
            and clip.subject in (subjects or self.templates)
            and clip.made in (made or (clip.made,))
        ]
        if not found:
            raise OptionError(f"{self.directory} has no clip of split {split}")
        return found

    def arrays(self, name: str) -> ClipArrays:
        """A clip's states, times, eyes and phonemes; FileFormatError if its file is damaged."""
        arrays = ClipArrays.load(self.directory / "clips" / f"{name}.safetensors")
        expected = (self.clips[name].frames, self.basis.width)
        if arrays.state.shape != expected:
            raise FileFormatError(
                f"clip {name} has states of shape {arrays.state.shape}, expected {expected}"
            )
        return arrays

    def audio(self, name: str) -> Waveform:
        """A clip's sound, 16 kHz."""
        return load_waveform(self.directory / "clips" / f"{name}.wav")

    @cached_property
    def source(self) -> MotionDataset:
        """The data set that the states were made of.

        Raises
        ------
        FileFormatError
            If it is no longer where it was.
        """
        record = self._source
        directory = (self.directory / record["directory"]).resolve()
        if not directory.is_dir() or record["kind"] not in LOADERS:
            raise FileFormatError(f"{directory}, which {self.directory} was made of, is gone: make it again")
        given: dict[str, Any] = record["options"] | {n: Path(p) for n, p in record["paths"].items()}
        options = loader(record["kind"]).Options(**given)
        return DatasetSource(directory, record["kind"], options).open()

    def vertices(
        self, name: str, timeline: Float64[np.ndarray, " frames"]
    ) -> Float32[np.ndarray, "frames vertices 3"]:
        """Vertices of a clip at some of its times: rows of `ClipArrays.timeline`."""
        return at_positions(self._motion(self.clips[name].sequence), timeline).astype(np.float32)

    def __getstate__(self) -> dict[str, Any]:
        """Worker processes open the source anew."""
        return {name: value for name, value in vars(self).items() if name not in ("source", "_motion")}

    @cached_property
    def _motion(self):
        # Some layouts parse whole files for a few frames.
        return lru_cache(maxsize=4)(lambda sequence: self.source.motion(sequence).vertices)


def write_states(
    directory: Path,
    source: DatasetSource,
    fps: float,
    head: str,
    emotions: Sequence[str],
    explained: Mapping[str, float],
    clips: Sequence[StateClip],
) -> None:
    """Write a2f.json, which says that all is there."""
    options = {name: value for name, value in vars(source.options).items() if not isinstance(value, Path)}
    paths = {
        name: str(value.resolve()) for name, value in vars(source.options).items() if isinstance(value, Path)
    }
    record = {
        "version": VERSION,
        "fps": fps,
        "head": head,
        "emotions": list(emotions),
        "explained": dict(explained),
        "source": {
            "directory": os.path.relpath(source.directory, directory.resolve()),
            "kind": source.kind,
            "options": options,
            "paths": paths,
        },
        "clips": [asdict(clip) for clip in clips],
    }
    with written_whole(directory / "a2f.json") as temporary:
        temporary.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


def write_clip(directory: Path, clip: StateClip, arrays: ClipArrays, waveform: Waveform) -> StateClip:
    """Write a clip's files, the sound first; the clip with its number of frames."""
    folder = directory / "clips"
    folder.mkdir(parents=True, exist_ok=True)
    save_waveform(waveform.resampled(16000), folder / f"{clip.name}.wav")
    arrays.save(folder / f"{clip.name}.safetensors")
    return replace(clip, frames=len(arrays.state))
