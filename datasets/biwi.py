"""BIWI B3D(AC)^2 as it is published: one .vl file a frame.

    DIR/faces/SUBJECT/SENTENCE/*.vl         uint32 count, count * 3 float32 (little-endian), millimetres
    DIR/rigid_scans/SUBJECT.obj             template and topology
    DIR/audio/SUBJECT/SENTENCE.wav          or audio/SUBJECT_SENTENCE.wav, wav/SUBJECT_SENTENCE.wav

SENTENCE is 01 to 40 spoken neutrally and e01 to e40 with emotion; 25 frames a second. In the files y points
down and z into the head; vertices are turned by half a turn about x. Source: Fanelli et al., A 3-D
Audio-Visual Corpus of Affective Communication, 2010, and CodeTalker's preprocessing.
"""

import re
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64

from meshanim.audio import Waveform, load_waveform
from meshanim.datasets.mesh_files import load_mesh
from meshanim.datasets.motion_dataset import (
    DatasetOptions,
    MotionArrays,
    MotionDataset,
    SequenceInfo,
    Subject,
)
from meshanim.datasets.published import BIWI
from meshanim.errors import FileFormatError, OptionError
from meshanim.geometry import TriangleMesh

__all__ = ["BiwiDataset", "BiwiOptions", "area_normalised", "read_vl"]

MILLIMETRE = 1e-3
HALF_TURN = np.array([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class BiwiOptions(DatasetOptions):
    """What becomes of the vertices.

    Parameters
    ----------
    preprocess : str
        metres: millimetres to metres. codetalker: each frame moved to its mean vertex and divided by the
        square root of its area, the unit of FaceFormer's and CodeTalker's files ("biwi").
    """

    preprocess: str = "metres"

    def __post_init__(self):
        super().__post_init__()
        if self.preprocess not in ("metres", "codetalker"):
            raise OptionError(f"preprocess is {self.preprocess!r}; expected metres or codetalker")


def read_vl(path: str | Path) -> Float32[np.ndarray, "vertices 3"]:
    """The vertices of a .vl file, millimetres.

    Raises
    ------
    FileFormatError
        If it is missing, or its size is not what its count says.
    """
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise FileFormatError(f"cannot read {path}: {error.strerror}") from error
    count = int.from_bytes(content[:4], "little")
    if len(content) < 4 or len(content) != 4 + 12 * count:
        raise FileFormatError(
            f"{path} has {len(content)} bytes, expected {4 + 12 * count} for {count} vertices: cut short?"
        )
    return np.frombuffer(content, "<f4", offset=4).reshape(count, 3).astype(np.float32)


def area_normalised(
    vertices: Float64[np.ndarray, "*frames vertices 3"], faces: np.ndarray
) -> Float64[np.ndarray, "*frames vertices 3"]:
    """Vertices less their mean, divided by the square root of the surface's area, frame by frame.

    Source: CodeTalker, BIWI preprocessing.
    """
    centred = vertices - vertices.mean(axis=-2, keepdims=True)
    first, second, third = (centred[..., faces[:, corner], :] for corner in range(3))
    normals = np.cross(second - first, third - first)
    area = np.linalg.norm(normals, axis=-1).sum(-1) / 2
    return centred / np.sqrt(area)[..., None, None]


class BiwiDataset(MotionDataset):
    """Reads the layout above, a sequence's frames when it is taken.

    Sequences are named SUBJECT_eNN, as FaceFormer names them, and SUBJECT_NN. The neutral half is in no
    published split: it is `spare`.

    Parameters
    ----------
    directory : path
        With faces/ and rigid_scans/.
    options : BiwiOptions, optional
        Stride and unit.

    Raises
    ------
    FileFormatError
        If a template is missing or damaged.
    """

    kind = "biwi"
    files = "faces/SUBJECT/SENTENCE/*.vl, rigid_scans/SUBJECT.obj"
    Options = BiwiOptions

    @classmethod
    def detect(cls, directory: Path) -> bool:
        """By faces/ and rigid_scans/."""
        return (directory / "faces").is_dir() and (directory / "rigid_scans").is_dir()

    def __init__(self, directory: str | Path, options: BiwiOptions | None = None):
        super().__init__(directory, options)
        self.name = BIWI.name
        self.fps = BIWI.fps / self.options.stride
        self.unit = "biwi" if self.options.preprocess == "codetalker" else "m"
        scans = sorted(path for path in (self.directory / "rigid_scans").glob("*.obj"))
        if not scans:
            raise FileFormatError(f"{self.directory / 'rigid_scans'} holds no .obj: the templates")
        found = {path.stem: load_mesh(path) for path in scans}
        first = next(iter(found.values()))
        for path in scans:
            if not np.array_equal(found[path.stem].faces, first.faces):
                raise FileFormatError(f"{path} has other faces than {scans[0]}: it is of another topology")
        self._faces = first.faces
        self.subjects = {
            name: Subject(name, self._converted(found[name].vertices)) for name in BIWI.ordered(found)
        }
        mean = np.mean([subject.template for subject in self.subjects.values()], axis=0)
        self.mesh = TriangleMesh(mean, self._faces)
        folders = {
            f"{folder.parent.name}_{folder.name}": folder
            for folder in (self.directory / "faces").glob("*/*")
            if folder.is_dir() and not folder.name.startswith(".")
        }
        self._folders = dict(sorted(folders.items()))
        self.sequences = tuple(self._folders)
        self.splits = BIWI.split(
            [(name, folder.parent.name, folder.name) for name, folder in self._folders.items()]
        )

    def _converted(self, vertices: np.ndarray) -> Float32[np.ndarray, "*frames vertices 3"]:
        turned = np.asarray(vertices, np.float64) * HALF_TURN
        if self.options.preprocess == "codetalker":
            return area_normalised(turned, self._faces).astype(np.float32)
        return (turned * MILLIMETRE).astype(np.float32)

    def _files(self, name: str) -> list[Path]:
        """Frames in the order of their numbers."""
        self._known(name)
        numbered = []
        for path in self._folders[name].glob("*.vl"):
            digits = re.search(r"(\d+)$", path.stem)
            if digits is None:
                raise FileFormatError(f"{path} has no number of a frame in its name")
            numbered.append((int(digits[1]), path))
        numbered.sort()
        for (before, path), (after, _) in pairwise(numbered):
            if after != before + 1:
                raise FileFormatError(f"{path.parent} has no frame {before + 1}")
        return [path for _, path in numbered]

    def info(self, name: str) -> SequenceInfo:
        """By the names of the files."""
        frames = len(self._files(name))
        folder = self._folders[name]
        subject = folder.parent.name
        if subject not in self.subjects:
            raise FileFormatError(f"{self.directory / 'rigid_scans' / subject}.obj is missing: the template")
        moved = folder.name.startswith("e")
        digits = folder.name.removeprefix("e")
        number = int(digits) if digits.isdigit() else 0
        emotion, intensity = ("emotional", 1.0) if moved else ("neutral", 0.0)
        info = SequenceInfo(
            subject, number, "", BIWI.fps, frames, emotion=emotion, intensity=intensity, name=name
        )
        return self._strided(info)

    def motion(self, name: str) -> MotionArrays:
        """All frames of a sequence, converted."""
        files = self._files(name)[:: self.options.stride]
        count = self.mesh.n_vertices if self.mesh else 0
        vertices = np.empty((len(files), count, 3), np.float32)
        for frame, path in enumerate(files):
            read = read_vl(path)
            if len(read) != count:
                raise FileFormatError(f"{path} has {len(read)} vertices, the templates {count}")
            vertices[frame] = self._converted(read)
        return MotionArrays(vertices)

    def audio(self, name: str) -> Waveform:
        """The sound of a sequence."""
        return load_waveform(self.audio_file(name), rate=None)

    def audio_file(self, name: str) -> Path:
        """Its file, in any of the three places."""
        self._known(name)
        return self._sounds.get(name, self.directory / "audio" / f"{name}.wav")

    @cached_property
    def _sounds(self) -> dict[str, Path]:
        found = {}
        for folder in ("audio", "wav"):
            flat = (self.directory / folder).glob("*.wav")
            nested = (self.directory / folder).glob("*/*.wav")
            found.update({path.stem: path for path in flat})
            found.update({f"{path.parent.name}_{path.stem}": path for path in nested})
        return found
