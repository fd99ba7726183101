"""What every data set of talking heads is: subjects, splits, and sequences of vertices with their sound.

`open_dataset` tells the layout of a folder by its files. A loader of a layout is a subclass of
`MotionDataset` in a file of its own, named in `LOADERS`.
"""

import importlib
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float32

from meshanim.audio import Phoneme, Waveform
from meshanim.errors import FileFormatError, OptionError
from meshanim.geometry import TriangleMesh
from meshanim.motion.face_parts import FaceParts

__all__ = [
    "LOADERS",
    "UNITS",
    "DatasetOptions",
    "DatasetSource",
    "MotionArrays",
    "MotionDataset",
    "MotionSequence",
    "SequenceInfo",
    "Subject",
    "detect_kind",
    "loader",
    "loader_options",
    "open_dataset",
]

# Kinds of data sets in the order in which they are tried, and where their loaders are.
LOADERS = {
    "meshanim": "meshanim_format:MeshanimDataset",
    "faceformer": "faceformer:FaceFormerDataset",
    "vocaset": "vocaset:VocasetDataset",
    "biwi": "biwi:BiwiDataset",
    "multiface": "multiface:MultifaceDataset",
    "mead": "mead:MeadDataset",
    "unitalker": "unitalker:UniTalkerDataset",
    "diffposetalk": "diffposetalk:DiffPoseTalkDataset",
    "audio2face": "audio2face:Audio2FaceDataset",
    "meshes": "mesh_folder:MeshFolderDataset",
}


UNITS = ("m", "biwi")
"""Metres, or units of the square root of the face's area in each frame (BIWI as FaceFormer reads it)."""


@dataclass(frozen=True)
class Subject:
    """One person: a template mesh, and what is known about them.

    Parameters
    ----------
    name : str
        Letters, digits, `_` and `-`, as published.
    template : (V, 3) float32
        Neutral vertices, in the data set's unit.
    shape : (S,) float32
        Identity coefficients of the head; empty where unknown.
    attributes : dict
        Anything else that fits into JSON: speaking style, voice, ...
    """

    name: str
    template: Float32[np.ndarray, "vertices 3"]
    shape: Float32[np.ndarray, " shape"] = field(default_factory=lambda: np.zeros(0, np.float32))
    attributes: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class SequenceInfo:
    """What is known about a sequence without its arrays.

    Parameters
    ----------
    subject : str
        Who speaks.
    sentence : int
        Number of the sentence, from 1 on, the same text for every subject; 0 where it has none.
    text : str
        What is said; empty where unknown.
    fps : float
        Frames a second.
    frames : int
        T.
    phonemes : tuple of (start, end, symbol)
        Seconds and ARPAbet; empty where unknown.
    emotion : str
        "neutral" or a name.
    intensity : float
        Of the emotion, 0 to 1.
    voice : str
        Who or what made the sound.
    name : str
        Of the sequence, unique in its data set, without "/"; SUBJECT_sentenceNN if not given.
    """

    subject: str
    sentence: int
    text: str
    fps: float
    frames: int
    phonemes: tuple[tuple[float, float, str], ...] = ()
    emotion: str = "neutral"
    intensity: float = 0.0
    voice: str = ""
    name: str = ""

    def __post_init__(self):
        if not self.name:
            object.__setattr__(self, "name", f"{self.subject}_sentence{self.sentence:02d}")


@dataclass(frozen=True)
class MotionSequence:
    """One recorded or synthetic sentence.

    Parameters
    ----------
    info : SequenceInfo
        Subject, text, phonemes, emotion.
    vertices : (T, V, 3) float32
        Zero pose, in the data set's unit; memory-mapped where the file allows. V is 0 where only
        coefficients are known.
    pose : (T, 3) float32
        Head rotation, axis-angle, radians, about the neck joint.
    curves : (T, E) float32
        Expression weights by the data set's `curve_names`; E is 0 where unknown.
    audio : Waveform
        The speech, at the rate of its file.
    coefficients : dict of arrays
        Anything else by frame, (T, ...), or of the whole sequence: FLAME's shape, expression, jaw, ...
    """

    info: SequenceInfo
    vertices: Float32[np.ndarray, "frames vertices 3"]
    pose: Float32[np.ndarray, "frames 3"]
    curves: Float32[np.ndarray, "frames curves"]
    audio: Waveform
    coefficients: Mapping[str, np.ndarray] = field(default_factory=dict)

    def __len__(self) -> int:
        return self.info.frames

    @property
    def phonemes(self) -> list[Phoneme]:
        """Timed phonemes; empty where unknown."""
        return [Phoneme(*entry) for entry in self.info.phonemes]


@dataclass(frozen=True)
class MotionArrays:
    """What a loader reads of a sequence beside its sound, as `MotionSequence` has it.

    Parameters
    ----------
    vertices : (T, V, 3) float32
        Zero pose, in the data set's unit.
    pose, curves : arrays, optional
        Where the layout has them.
    coefficients : dict of arrays
        By name.
    """

    vertices: Float32[np.ndarray, "frames vertices 3"]
    pose: Float32[np.ndarray, "frames 3"] | None = None
    curves: Float32[np.ndarray, "frames curves"] | None = None
    coefficients: Mapping[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True)
class DatasetOptions:
    """How to read any layout; a loader with more to choose has a subclass of this.

    Parameters
    ----------
    stride : int
        Take every `stride`-th frame.
    """

    stride: int = 1

    def __post_init__(self):
        if self.stride < 1:
            raise OptionError(f"stride is {self.stride}; expected at least 1")


@dataclass(frozen=True)
class DatasetSource:
    """Where a data set is and how to read it: what a job takes to another process or machine.

    Parameters
    ----------
    directory : Path
        Absolute.
    kind : str
        A key of `LOADERS`.
    options : DatasetOptions
        The loader's.
    """

    directory: Path
    kind: str
    options: DatasetOptions

    def open(self) -> "MotionDataset":
        """The data set."""
        return open_dataset(self.directory, self.kind, self.options)


class MotionDataset(ABC):
    """Subjects, splits and sequences of one folder; opening reads small files and headers alone.

    Parameters
    ----------
    directory : path
        The folder.
    options : DatasetOptions, optional
        An instance of the loader's `Options`.

    Attributes
    ----------
    name : str
        Of the data set.
    directory : Path
        Where it is.
    fps : float
        Frames a second of the files, divided by the stride.
    unit : str
        "m", or "biwi" for units of the square root of the face's area.
    mesh : TriangleMesh or None
        Topology and mean template; None where the layout has no faces.
    head : str
        What `meshanim.heads.load_head` understands, or "".
    parts : FaceParts or None
        Which vertices are what, where the files say it.
    curve_names : tuple of str
        Columns of the curves.
    subjects : mapping of Subject
        By name, in the published order.
    sequences : tuple of str
        All names.
    splits : dict of tuple of str
        Names of sequences by published split.
    """

    kind: ClassVar[str]
    """The loader's name for `open_dataset`."""
    files: ClassVar[str]
    """What a folder of this layout holds, as `open_dataset` says it when it finds none."""
    Options: ClassVar[type[DatasetOptions]] = DatasetOptions

    name: str
    fps: float
    unit: str = "m"
    mesh: TriangleMesh | None = None
    head: str = ""
    parts: FaceParts | None = None
    curve_names: tuple[str, ...] = ()
    subjects: Mapping[str, Subject]
    sequences: tuple[str, ...]
    splits: dict[str, tuple[str, ...]]

    def __init__(self, directory: str | Path, options: DatasetOptions | None = None):
        if options is not None and not isinstance(options, self.Options):
            raise OptionError(
                f"{type(self).__name__} takes {self.Options.__name__}, not {type(options).__name__}"
            )
        self.directory = Path(directory)
        self.options: Any = self.Options() if options is None else options

    @classmethod
    @abstractmethod
    def detect(cls, directory: Path) -> bool:
        """Whether the folder has this layout, by the files that are there."""

    @abstractmethod
    def info(self, name: str) -> SequenceInfo:
        """What is known about a sequence, without its arrays and sound.

        Raises
        ------
        FileFormatError
            If a header is missing or damaged.
        OptionError
            If there is no such sequence.
        """

    @abstractmethod
    def motion(self, name: str) -> MotionArrays:
        """The arrays of a sequence without its sound.

        Raises
        ------
        FileFormatError
            If a file is missing, cut short, or of another shape than the rest says.
        """

    @abstractmethod
    def audio(self, name: str) -> Waveform:
        """The sound of a sequence, at the rate of its file.

        Raises
        ------
        FileFormatError
            If it is missing or damaged.
        """

    def language(self, name: str) -> str:
        """What is spoken in a sequence; "en" unless the files say otherwise."""
        return "en"

    def audio_file(self, name: str) -> Path | None:
        """The wav file with exactly the sound of this sequence; None where it is kept otherwise."""
        return None

    def __getitem__(self, key: int | str) -> MotionSequence:
        """A sequence by name or position."""
        name = self.sequences[key] if isinstance(key, int) else key
        info, arrays = self.info(name), self.motion(name)
        still = np.zeros((info.frames, 3), np.float32)
        return MotionSequence(
            info,
            arrays.vertices,
            still if arrays.pose is None else arrays.pose,
            np.zeros((info.frames, 0), np.float32) if arrays.curves is None else arrays.curves,
            self.audio(name),
            arrays.coefficients,
        )

    def __len__(self) -> int:
        return len(self.sequences)

    def __iter__(self) -> Iterator[MotionSequence]:
        return (self[name] for name in self.sequences)

    def split(self, name: str) -> tuple[str, ...]:
        """Sequence names of a split.

        Raises
        ------
        OptionError
            If there is no such split; the message lists those there are.
        FileFormatError
            If a sequence of it is missing.
        """
        if name not in self.splits:
            raise OptionError(
                f"{self.directory} has no split {name!r}; there are {', '.join(self.splits) or 'none'}"
            )
        missing = [member for member in self.splits[name] if member not in self._names]
        if missing:
            raise FileFormatError(
                f"{self.directory} lacks {len(missing)} sequences of split {name}, such as {missing[0]}"
            )
        return self.splits[name]

    @cached_property
    def _names(self) -> frozenset[str]:
        return frozenset(self.sequences)

    def _strided(self, info: SequenceInfo) -> SequenceInfo:
        """What is known of the file, as it is with every `stride`-th frame."""
        return replace(info, fps=self.fps, frames=-(-info.frames // self.options.stride))

    def _every(self, frames: int, arrays: MotionArrays) -> MotionArrays:
        """Every `stride`-th frame of arrays of the file; coefficients of other lengths are of no frame."""
        step = self.options.stride
        if step == 1:
            return arrays
        return MotionArrays(
            arrays.vertices[::step],
            None if arrays.pose is None else arrays.pose[::step],
            None if arrays.curves is None else arrays.curves[::step],
            every_frame(arrays.coefficients, frames, step),
        )

    def _known(self, name: str) -> None:
        if name not in self._names:
            raise OptionError(f"{self.directory} has no sequence {name!r}; there are {len(self.sequences)}")

    @property
    def surface(self) -> TriangleMesh:
        """The mesh, for those who cannot do without one.

        Raises
        ------
        FileFormatError
            If the data set has no faces.
        """
        if self.mesh is None:
            raise FileFormatError(f"{self.directory} has no faces: convert it with --faces MESH")
        return self.mesh

    @property
    def source(self) -> DatasetSource:
        """How to open it again elsewhere."""
        return DatasetSource(self.directory.resolve(), self.kind, self.options)

    def check(self, progress: bool = False, workers: int = 1) -> list[str]:
        """Read everything; every defect as one line "where: what", empty if all is well."""
        from meshanim.datasets.checking import check_dataset

        return check_dataset(self, progress, workers)


def every_frame(arrays: Mapping[str, np.ndarray], frames: int, stride: int) -> dict[str, np.ndarray]:
    """Every `stride`-th frame of arrays with as many rows as frames; others are of no frame and stay."""
    return {
        key: array[::stride] if array.ndim and len(array) == frames else array
        for key, array in arrays.items()
    }


def loader(kind: str) -> type[MotionDataset]:
    """The class that reads a kind of data set.

    Raises
    ------
    OptionError
        If there is no such kind; the message lists those there are.
    """
    if kind not in LOADERS:
        raise OptionError(f"no kind of data set {kind!r}; there are {', '.join(LOADERS)}")
    module, name = LOADERS[kind].split(":")
    return getattr(importlib.import_module(f"meshanim.datasets.{module}"), name)


def detect_kind(directory: str | Path) -> str:
    """The kind of data set that a folder holds, by the files in it.

    Raises
    ------
    FileFormatError
        If the folder is missing or of no known layout; the message lists what was looked for.
    """
    directory = Path(directory)
    if not directory.is_dir():
        raise FileFormatError(f"{directory} is no folder; expected a data set")
    for kind in LOADERS:
        if loader(kind).detect(directory):
            return kind
    sought = "; ".join(f"{kind}: {loader(kind).files}" for kind in LOADERS)
    raise FileFormatError(f"{directory} is no data set of a known layout; looked for {sought}")


def loader_options(kind: str, values: Mapping[str, Any]) -> DatasetOptions:
    """The options of a kind of data set from those that were given (None: not given).

    Raises
    ------
    OptionError
        If the loader has no such option.
    """
    options = loader(kind).Options
    given = {key: value for key, value in values.items() if value is not None}
    known = [entry.name for entry in fields(options)]
    for key in given:
        if key not in known:
            raise OptionError(f"data sets of kind {kind} have no option {key}; there are {', '.join(known)}")
    return options(**given)


def open_dataset(
    directory: str | Path, kind: str = "auto", options: DatasetOptions | None = None
) -> MotionDataset:
    """Open a data set of any known layout.

    Parameters
    ----------
    directory : path
        The folder.
    kind : str
        A key of `LOADERS`; auto tells the layout by the files that are there.
    options : DatasetOptions, optional
        An instance of the loader's `Options`.

    Raises
    ------
    FileFormatError
        If no layout fits (the message lists what was looked for), or a file is missing or damaged.
    OptionError
        If there is no such kind, or the options are another loader's.
    """
    return loader(detect_kind(directory) if kind == "auto" else kind)(directory, options)
