"""The folder layout of FaceFormer, CodeTalker and their successors.

    DIR/wav/SUBJECT_sentence01.wav
    DIR/vertices_npy/SUBJECT_sentence01.npy     (T, V * 3)
    DIR/templates.pkl                           {SUBJECT: (V, 3)}

The subject is the name up to the last underscore, the sentence the last two digits. FaceFormer's own loader
for VOCASET takes every second frame of files at 60 frames a second.
"""

import pickle
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from meshanim.audio import Waveform, load_waveform, save_waveform
from meshanim.datasets.motion_dataset import (
    DatasetOptions,
    MotionArrays,
    MotionDataset,
    MotionSequence,
    SequenceInfo,
    Subject,
)
from meshanim.errors import FileFormatError, OptionError
from meshanim.files import written_whole
from meshanim.unpickle import load_pickle

__all__ = [
    "FaceFormerDataset",
    "FaceFormerOptions",
    "write_faceformer_sequence",
    "write_faceformer_templates",
]


def write_faceformer_sequence(directory: str | Path, sequence: MotionSequence) -> None:
    """Write the sound, then the vertices of one sequence; the layout has no pose and no curves."""
    directory = Path(directory)
    for folder in ("wav", "vertices_npy"):
        (directory / folder).mkdir(parents=True, exist_ok=True)
    name = sequence.info.name
    save_waveform(sequence.audio, directory / "wav" / f"{name}.wav")
    with (
        written_whole(directory / "vertices_npy" / f"{name}.npy") as temporary,
        open(temporary, "wb") as file,
    ):
        flat = np.ascontiguousarray(sequence.vertices, np.float32).reshape(len(sequence), -1)
        np.save(file, flat)


def write_faceformer_templates(directory: str | Path, subjects: Sequence[Subject]) -> None:
    """Write templates.pkl: a pickled dictionary of arrays, as the public loaders expect."""
    written = pickle.dumps({subject.name: subject.template for subject in subjects}, protocol=2)
    # The environments of the public loaders have NumPy 1, which knows its core by the old name only.
    written = written.replace(b"cnumpy._core.", b"cnumpy.core.")
    with written_whole(Path(directory) / "templates.pkl") as temporary:
        temporary.write_bytes(written)


@dataclass(frozen=True)
class FaceFormerOptions(DatasetOptions):
    """What the folders do not say.

    Parameters
    ----------
    fps : float
        Frames a second of the files.
    scale : float
        Metres for one unit of the files.
    """

    fps: float = 30.0
    scale: float = 1.0

    def __post_init__(self):
        super().__post_init__()
        if not self.fps > 0 or not self.scale > 0:
            raise OptionError(f"fps and scale must be positive, not {self.fps} and {self.scale}")


class FaceFormerDataset(MotionDataset):
    """Reads the layout above.

    Parameters
    ----------
    directory : path
        With wav/, vertices_npy/ and templates.pkl.
    options : FaceFormerOptions, optional
        Rate, stride and unit.

    Raises
    ------
    FileFormatError
        If a part is missing or damaged.
    """

    kind = "faceformer"
    files = "vertices_npy/, wav/, templates.pkl"
    Options = FaceFormerOptions

    @classmethod
    def detect(cls, directory: Path) -> bool:
        """By vertices_npy/."""
        return (directory / "vertices_npy").is_dir()

    def __init__(self, directory: str | Path, options: FaceFormerOptions | None = None):
        super().__init__(directory, options)
        self.name = self.directory.name
        self.fps = self.options.fps / self.options.stride
        self.subjects = {name: Subject(name, value) for name, value in self._read_templates().items()}
        self.splits = {}
        folder = self.directory / "vertices_npy"
        self.sequences = tuple(
            sorted(path.stem for path in folder.glob("*.npy") if not path.name.startswith("."))
        )
        if not self.sequences:
            raise FileFormatError(f"{folder} holds no .npy files: not FaceFormer's layout")

    def _read_templates(self) -> dict[str, Float32[np.ndarray, "vertices 3"]]:
        path = self.directory / "templates.pkl"
        templates = load_pickle(path)
        if not isinstance(templates, dict) or not all(
            isinstance(value, np.ndarray) and value.ndim == 2 and value.shape[1] == 3
            for value in templates.values()
        ):
            raise FileFormatError(f"{path} holds no dictionary of (vertices, 3) arrays")
        return {name: np.asarray(value * self.options.scale, np.float32) for name, value in templates.items()}

    def _flat(self, name: str) -> np.ndarray:
        """The array of a sequence, memory-mapped, its width checked."""
        self._known(name)
        path = self.directory / "vertices_npy" / f"{name}.npy"
        try:
            flat = np.load(path, mmap_mode="r", allow_pickle=False)
        except OSError as error:
            raise FileFormatError(f"cannot read {path}: {error.strerror or error}") from error
        except (ValueError, EOFError) as error:
            raise FileFormatError(f"{path} is damaged or cut short: {error}") from error
        subject = name.rpartition("_")[0]
        if subject not in self.subjects:
            raise FileFormatError(f"{path}: templates.pkl has no subject {subject!r}")
        template = self.subjects[subject].template
        if flat.ndim != 2 or flat.shape[1] != template.size:
            raise FileFormatError(f"{path} has shape {flat.shape}, expected (frames, {template.size})")
        return flat[:: self.options.stride]

    def info(self, name: str) -> SequenceInfo:
        """By the name and the header of the array."""
        subject, _, sentence = name.rpartition("_")
        digits = sentence[-2:]
        number = int(digits) if digits.isdigit() else 0
        return SequenceInfo(subject, number, "", self.fps, len(self._flat(name)), name=name)

    def motion(self, name: str) -> MotionArrays:
        """Vertices, memory-mapped where they are float32 in the data set's unit."""
        vertices = np.asanyarray(self._flat(name), np.float32)
        if self.options.scale != 1:
            vertices = vertices * np.float32(self.options.scale)
        return MotionArrays(vertices.reshape(len(vertices), -1, 3))

    def audio(self, name: str) -> Waveform:
        """The sound of a sequence."""
        return load_waveform(self.audio_file(name), rate=None)

    def audio_file(self, name: str) -> Path:
        """Its file."""
        self._known(name)
        return self.directory / "wav" / f"{name}.wav"
