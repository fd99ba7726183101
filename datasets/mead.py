"""3D-MEAD: FLAME coefficients of the emotional speech of MEAD (Wang et al. 2020), in its two layouts.

As EMOTE (Danecek et al. 2023) released its reconstructions, sound apart in MEAD's own folders:

    DIR/M003/front/EMOTION/level_K/001/shape_pose_cam.hdf5
        shape (1, T, 300), exp (1, T, 100), jaw (1, T, 3), global_pose (1, T, 3); radians
    AUDIO/M003/audio/EMOTION/level_K/001.m4a

As ProbTalk3D (Wu et al. 2024) converts them:

    DIR/param/M003_001_0_0.npy      (1, T, 403): 300 shape, 100 expression, 3 jaw; person, sentence,
                                    emotion 0 to 7, level 0 to 2
    DIR/wav/M003_001_0_0.wav

25 frames a second. Splits are those of ProbTalk3D: by sentence for 32 people (train, val, test), and by
person for its motion prior (prior_train, prior_val, prior_test).
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from meshanim.audio import Waveform, load_waveform
from meshanim.datasets.flame_coefficients import (
    CoefficientOptions,
    LateSubjects,
    flame_vertices,
    optional_head,
)
from meshanim.datasets.motion_dataset import MotionArrays, MotionDataset, SequenceInfo
from meshanim.errors import DependencyError, FileFormatError

__all__ = ["EMOTIONS", "MeadDataset", "MeadOptions"]

FPS = 25.0
EMOTIONS = ("neutral", "happy", "sad", "surprised", "fear", "disgusted", "angry", "contempt")
LEVELS = 3
# Numbers of men and women by split of the prior, as published.
NUMBERS = {
    "train": (
        (3, 5, 7, 9, 11, 12, 13, 19, 22, 23, 24, 25, 26, 27, 28, 29, 30, 31),
        (9, 11, 14, 15, 16, 18, 19, 21, 23, 24, 25, 26, 28, 29),
    ),
    "val": ((32, 33, 34, 35), (33, 35, 36)),
    "test": ((37, 39, 40, 41, 42), (37, 38, 40)),
}
PEOPLE = {
    split: tuple(f"{letter}{number:03d}" for letter, some in zip("MW", numbers) for number in some)
    for split, numbers in NUMBERS.items()
}
# Sentences by split: of neutral speech, of emotional speech.
SENTENCES = {
    "train": (range(1, 33), range(1, 25)),
    "val": (range(33, 37), range(25, 28)),
    "test": (range(37, 41), range(28, 31)),
}
HDF5 = "shape_pose_cam.hdf5"
WIDTHS = {"shape": 300, "exp": 100, "jaw": 3, "global_pose": 3}
NAME = re.compile(r"([MW]\d+)_(\d+)_([0-7])_([0-2])")


@dataclass(frozen=True)
class MeadOptions(CoefficientOptions):
    """Where the sound is, and the head.

    Parameters
    ----------
    audio : path, optional
        Folder with the people's folders of MEAD, PERSON/audio/EMOTION/level_K/001.m4a. By default
        MEAD_audio_source/ beside the data set, or the data set itself. ProbTalk3D's layout has its own.
    """

    audio: Path | None = None


class MeadDataset(MotionDataset):
    """Reads either layout; sequences are named as ProbTalk3D does, M003_001_0_0, in both.

    Coefficients: `shape` (T, 300), as reconstructed, different in every frame; `expression` (T, 100); `jaw`
    (T, 3), axis-angle. The pose is `global_pose`, and zero in ProbTalk3D's layout, which dropped it. A
    subject's shape is the mean over the frames of their first sequence that can be read.

    Parameters
    ----------
    directory : path
        DIR above, or the folder that EMICA-MEAD_flame2020/ lies in.
    options : MeadOptions, optional
        Sound and head.

    Raises
    ------
    DependencyError
        If h5py is missing and the layout needs it.
    FileFormatError
        If a part is missing or damaged.
    """

    kind = "mead"
    files = f"M003/front/EMOTION/level_K/001/{HDF5}, or param/M003_001_0_0.npy"
    Options = MeadOptions

    @classmethod
    def detect(cls, directory: Path) -> bool:
        """By names of people and of parameter files."""
        if any(NAME.fullmatch(path.stem) for path in (directory / "param").glob("*.npy")):
            return True
        root = _reconstructions(directory)
        return any(True for _ in root.glob("[MW][0-9]*/front/*/level_[1-3]"))

    def __init__(self, directory: str | Path, options: MeadOptions | None = None):
        super().__init__(directory, options)
        self.name = "mead"
        self.fps = FPS / self.options.stride
        self._head = optional_head(self.options.head)
        self.head = self.options.head
        self.mesh = None if self._head is None else self._head.mesh
        self._converted = (self.directory / "param").is_dir()
        self._files = self._find_converted() if self._converted else self._find_reconstructions()
        if not self._files:
            raise FileFormatError(f"{self.directory} is no 3D-MEAD: it has no {self.files}")
        self.sequences = tuple(sorted(self._files))
        known = [name for names in PEOPLE.values() for name in names]
        there = {name.split("_")[0] for name in self.sequences}
        people = [name for name in known if name in there] + sorted(there - set(known))
        order = {person: index for index, person in enumerate(people)}
        names = [(name.split("_")[0], name) for name in self.sequences]
        self.subjects = LateSubjects(self._head, sorted(names, key=lambda pair: order[pair[0]]), self._shape)
        self.splits = {
            split: tuple(name for name in self.sequences if _in_split(name, split)) for split in SENTENCES
        } | {
            f"prior_{split}": tuple(name for name in self.sequences if name.split("_")[0] in names)
            for split, names in PEOPLE.items()
        }

    def _find_converted(self) -> dict[str, Path]:
        paths = (self.directory / "param").glob("*.npy")
        return {path.stem: path for path in paths if NAME.fullmatch(path.stem)}

    def _find_reconstructions(self) -> dict[str, Path]:
        files = {}
        for path in _reconstructions(self.directory).glob(f"[MW][0-9]*/front/*/level_[1-3]/*/{HDF5}"):
            person, _, emotion, level, sentence = path.parts[-6:-1]
            if emotion in EMOTIONS:
                files[f"{person}_{sentence}_{EMOTIONS.index(emotion)}_{int(level[-1]) - 1}"] = path
        return files

    def _shape(self, name: str) -> Float32[np.ndarray, "frames shape"]:
        return self._read(name)["shape"]

    def _path(self, name: str) -> Path:
        self._known(name)
        return self._files[name]

    def info(self, name: str) -> SequenceInfo:
        """By the name and the header of the file; level k of an emotion has intensity k / 3."""
        frames = _frames(self._path(name))
        person, sentence, emotion, level = name.split("_")
        return SequenceInfo(
            person,
            int(sentence),
            "",
            self.fps,
            len(range(0, frames, self.options.stride)),
            emotion=EMOTIONS[int(emotion)],
            intensity=0.0 if emotion == "0" else (int(level) + 1) / LEVELS,
            voice=person,
            name=name,
        )

    def _read(self, name: str) -> dict[str, Float32[np.ndarray, "frames width"]]:
        path = self._path(name)
        return _read_converted(path) if self._converted else _read_reconstruction(path)

    def motion(self, name: str) -> MotionArrays:
        """Coefficients, and vertices where there is a head."""
        read = {key: array[:: self.options.stride] for key, array in self._read(name).items()}
        vertices = flame_vertices(self._head, read["shape"], read["exp"], read["jaw"])
        coefficients = {"shape": read["shape"], "expression": read["exp"], "jaw": read["jaw"]}
        return MotionArrays(vertices, read.get("global_pose"), coefficients=coefficients)

    def audio(self, name: str) -> Waveform:
        """The sound of a sequence; .m4a is decoded."""
        return load_waveform(self._sound(name), rate=None)

    def audio_file(self, name: str) -> Path | None:
        """Its file if it is a wav file."""
        path = self._sound(name)
        return path if path.suffix == ".wav" else None

    def _sound(self, name: str) -> Path:
        path = self._path(name)
        if self._converted:
            return self.directory / "wav" / f"{name}.wav"
        sentence, level, emotion, person = path.parts[-2], path.parts[-3], path.parts[-4], path.parts[-6]
        root = _reconstructions(self.directory)
        roots = [self.options.audio] if self.options.audio else [root.parent / "MEAD_audio_source", root]
        candidates = [
            Path(folder) / person / "audio" / emotion / level / f"{sentence}{suffix}"
            for folder in roots
            for suffix in (".wav", ".m4a")
        ]
        return next((path for path in candidates if path.is_file()), candidates[1])


def _reconstructions(directory: Path) -> Path:
    inner = directory / "EMICA-MEAD_flame2020"
    return inner if inner.is_dir() else directory


def _in_split(name: str, split: str) -> bool:
    person, sentence, emotion, _ = name.split("_")
    neutral, emotional = SENTENCES[split]
    return person in PEOPLE["train"] and int(sentence) in (neutral if emotion == "0" else emotional)


def _open_converted(path: Path) -> np.ndarray:
    """(T, 403), memory-mapped."""
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except OSError as error:
        raise FileFormatError(f"cannot read {path}: {error.strerror or error}") from error
    except (ValueError, EOFError) as error:
        raise FileFormatError(f"{path} is damaged or cut short: {error}") from error
    width = WIDTHS["shape"] + WIDTHS["exp"] + WIDTHS["jaw"]
    if array.ndim != 3 or array.shape[0] != 1 or array.shape[2] != width or array.dtype.kind != "f":
        raise FileFormatError(
            f"{path} holds {array.dtype} of shape {array.shape}, expected floats of (1, frames, {width})"
        )
    return array[0]


def _read_converted(path: Path) -> dict[str, np.ndarray]:
    array = np.array(_open_converted(path), np.float32)
    shape, expression, jaw = np.split(array, [WIDTHS["shape"], WIDTHS["shape"] + WIDTHS["exp"]], axis=1)
    return {"shape": shape, "exp": expression, "jaw": jaw}


def _h5py() -> Any:
    try:
        import h5py
    except ImportError as error:
        raise DependencyError("h5py", "data") from error
    return h5py


def _frames(path: Path) -> int:
    if path.suffix == ".npy":
        return len(_open_converted(path))
    return _opened(path, lambda file: _dataset(path, file, "exp").shape[1])


def _opened(path: Path, read) -> Any:
    """What `read` makes of the open file; damage is told by name."""
    h5py = _h5py()
    try:
        with h5py.File(path, "r") as file:
            return read(file)
    except FileNotFoundError as error:
        raise FileFormatError(f"{path} does not exist") from error
    except (OSError, RuntimeError) as error:
        raise FileFormatError(f"{path} is no whole HDF5 file: {error}") from error


def _dataset(path: Path, file: Any, key: str) -> Any:
    if key not in file:
        raise FileFormatError(f"{path} lacks {key}; it has {', '.join(file) or 'nothing'}")
    entry = file[key]
    shape: tuple[int, ...] = getattr(entry, "shape", ())
    if len(shape) != 3 or shape[0] != 1 or shape[2] != WIDTHS[key] or entry.dtype.kind != "f":
        raise FileFormatError(
            f"{path}: {key} has shape {shape}, expected floats of (1, frames, {WIDTHS[key]})"
        )
    return entry


def _read_reconstruction(path: Path) -> dict[str, np.ndarray]:
    def read(file: Any) -> dict[str, np.ndarray]:
        return {key: np.asarray(_dataset(path, file, key)[0], np.float32) for key in WIDTHS}

    arrays = _opened(path, read)
    lengths = {key: len(array) for key, array in arrays.items()}
    if len(set(lengths.values())) != 1:
        raise FileFormatError(f"{path} has arrays of different length: {lengths}")
    return arrays
