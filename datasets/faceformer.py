"""The folder layout of FaceFormer, CodeTalker and their successors.

    DIR/wav/SUBJECT_sentence01.wav
    DIR/vertices_npy/SUBJECT_sentence01.npy     (T, V * 3)
    DIR/templates.pkl                           {SUBJECT: (V, 3)}
    DIR/templates/*.ply                         the topology; absent in some copies

The subject is the name up to the last underscore, the sentence the last two digits. FaceFormer's own loader
for VOCASET takes every second frame of files at 60 frames a second (`stride` 2 here).

What the layout has no place for stands beside it when meshanim writes it, and is read again: dataset.json,
mesh.npz and subjects/ of the project's own layout, and sequences/NAME/ without vertices and sound
(`meshanim.datasets.meshanim_format`). Other programs do not look there.
"""

import pickle
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from meshanim.audio import Waveform, load_waveform, save_waveform
from meshanim.datasets.mesh_files import as_float32, load_mesh, read_npy
from meshanim.datasets.meshanim_format import (
    DatasetRecord,
    read_beside,
    read_info,
    read_record,
    write_sequence,
)
from meshanim.datasets.motion_dataset import (
    DatasetOptions,
    MotionArrays,
    MotionDataset,
    MotionSequence,
    SequenceInfo,
    Subject,
    every_frame,
)
from meshanim.datasets.published import PUBLISHED, recognise
from meshanim.errors import FileFormatError, OptionError
from meshanim.files import written_whole
from meshanim.geometry import TriangleMesh
from meshanim.unpickle import load_pickle

__all__ = [
    "FaceFormerDataset",
    "FaceFormerOptions",
    "faceformer_stem",
    "write_faceformer_sequence",
    "write_faceformer_templates",
    "write_faceformer_topology",
]

# The mesh files that the public renderers look for, by number of vertices.
TOPOLOGY_FILES = {5023: "FLAME_sample.ply", 23370: "BIWI_topology.ply"}


def faceformer_stem(info: SequenceInfo) -> str:
    """Name of a sequence's files: its own if it is SUBJECT_SENTENCE, else made so."""
    if info.name.rpartition("_")[0] == info.subject:
        return info.name
    return f"{info.subject}_{info.name.replace('_', '-')}"


def write_faceformer_sequence(
    directory: str | Path, sequence: MotionSequence, sound: Path | None = None, lossless: bool = False
) -> None:
    """Write the sound, the vertices, then beside them what the layout has no place for.

    Parameters
    ----------
    directory : path
        DIR.
    sequence : MotionSequence
        What to write.
    sound : Path, optional
        A wav file that is copied byte by byte instead of the waveform.
    lossless : bool
        Write the waveform as 32-bit floats where 16 bits do not hold it.

    Raises
    ------
    OptionError
        If the sequence has coefficients but no vertices.
    """
    if sequence.vertices.shape[1] == 0:
        raise OptionError(
            f"{sequence.info.name} has no vertices for FaceFormer's layout: open the data set with a head"
        )
    directory = Path(directory)
    for folder in ("wav", "vertices_npy"):
        (directory / folder).mkdir(parents=True, exist_ok=True)
    stem = faceformer_stem(sequence.info)
    if sound is None:
        save_waveform(sequence.audio, directory / "wav" / f"{stem}.wav", lossless)
    else:
        with written_whole(directory / "wav" / f"{stem}.wav") as temporary:
            temporary.write_bytes(sound.read_bytes())
    with (
        written_whole(directory / "vertices_npy" / f"{stem}.npy") as temporary,
        open(temporary, "wb") as file,
    ):
        flat = np.ascontiguousarray(sequence.vertices, np.float32).reshape(len(sequence), -1)
        np.save(file, flat)
    write_sequence(directory, sequence, beside=True)


def write_faceformer_templates(directory: str | Path, subjects: Sequence[Subject]) -> None:
    """Write templates.pkl: a pickled dictionary of arrays, as the public loaders expect."""
    written = pickle.dumps({subject.name: subject.template for subject in subjects}, protocol=2)
    # The environments of the public loaders have NumPy 1, which knows its core by the old name only.
    written = written.replace(b"cnumpy._core.", b"cnumpy.core.")
    with written_whole(Path(directory) / "templates.pkl") as temporary:
        temporary.write_bytes(written)


def write_faceformer_topology(directory: str | Path, mesh: TriangleMesh) -> None:
    """Write templates/FLAME_sample.ply or BIWI_topology.ply, another name for other topologies."""
    folder = Path(directory) / "templates"
    folder.mkdir(parents=True, exist_ok=True)
    import trimesh  # slow to load, and few need it

    written = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    with written_whole(folder / TOPOLOGY_FILES.get(mesh.n_vertices, "topology.ply")) as temporary:
        written.export(temporary)


@dataclass(frozen=True)
class FaceFormerOptions(DatasetOptions):
    """What the folders do not say.

    Parameters
    ----------
    fps : float, optional
        Frames a second of the files; known of VOCASET (60), BIWI (25) and what meshanim wrote.
    scale : float
        Metres for one unit of the files (for a published data set in a unit of its own, leave 1).
    published : str
        Whose splits: vocaset, biwi; auto tells by subjects and number of vertices, none takes none.
    faces : path, optional
        A mesh file with the faces, where templates/ has none.
    """

    fps: float | None = None
    scale: float = 1.0
    published: str = "auto"
    faces: Path | None = None

    def __post_init__(self):
        super().__post_init__()
        if (self.fps is not None and not self.fps > 0) or not self.scale > 0:
            raise OptionError(f"fps and scale must be positive, not {self.fps} and {self.scale}")
        if self.published not in (*PUBLISHED, "auto", "none"):
            raise OptionError(
                f"no published data set {self.published!r}; there are {', '.join(PUBLISHED)}, auto, none"
            )


class FaceFormerDataset(MotionDataset):
    """Reads the layout above.

    Parameters
    ----------
    directory : path
        With wav/, vertices_npy/ and templates.pkl.
    options : FaceFormerOptions, optional
        Rate, stride, unit, splits, faces.

    Raises
    ------
    FileFormatError
        If a part is missing or damaged.
    OptionError
        If nothing says the rate of the files.
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
        templates = self._read_templates()
        folder = self.directory / "vertices_npy"
        stems = sorted(path.stem for path in folder.glob("*.npy") if not path.name.startswith("."))
        if not stems:
            raise FileFormatError(f"{folder} holds no .npy files: not FaceFormer's layout")
        self._record: DatasetRecord | None = None
        if (self.directory / "dataset.json").exists():
            self._record = read_record(self.directory)
            self._take_record(self._record, stems)
        else:
            self._take_published(templates, stems)
        self.fps = self._file_fps / self.options.stride

    def _take_record(self, record: DatasetRecord, stems: list[str]) -> None:
        names = {stem: name for name, stem in record.stems.items()}
        self._stems = {names.get(stem, stem): stem for stem in stems}
        self.sequences = tuple(sorted(self._stems))
        self.name, self.unit, self.head = record.name, record.unit, record.head
        self.curve_names, self.mesh = record.curve_names, record.mesh
        self.subjects, self.splits = record.subjects, record.splits
        self._file_fps = self.options.fps or record.fps

    def _take_published(self, templates: dict[str, np.ndarray], stems: list[str]) -> None:
        self._stems = {stem: stem for stem in stems}
        self.sequences = tuple(stems)
        count = max((len(template) for template in templates.values()), default=0)
        asked = self.options.published
        published = recognise(templates, count) if asked == "auto" else PUBLISHED.get(asked)
        self.name = published.name if published else self.directory.name
        order = published.ordered(templates) if published else list(templates)
        self.subjects = {name: Subject(name, templates[name]) for name in order}
        self.splits = {}
        if published:
            self.unit = published.unit if self.options.scale == 1 else "m"
            parts = [(name, *name.rpartition("_")[::2]) for name in stems]
            self.splits = published.split(parts)
        fps = self.options.fps or (published.fps if published else None)
        if fps is None:
            raise OptionError(f"nothing in {self.directory} says its frames a second: give fps (--fps)")
        self._file_fps = fps
        self.mesh = self._read_topology(count)

    def _read_topology(self, count: int) -> TriangleMesh | None:
        path = self.options.faces
        if path is None:
            folder = self.directory / "templates"
            found = [folder / name for name in (TOPOLOGY_FILES.get(count, ""), "topology.ply")]
            path = next((file for file in found if file.is_file()), None)
        return None if path is None else load_mesh(path, count, self.options.scale)

    def _read_templates(self) -> dict[str, Float32[np.ndarray, "vertices 3"]]:
        path = self.directory / "templates.pkl"
        templates = load_pickle(path)
        if not isinstance(templates, dict) or not all(
            isinstance(value, np.ndarray) and value.ndim == 2 and value.shape[1] == 3
            for value in templates.values()
        ):
            raise FileFormatError(f"{path} holds no dictionary of (vertices, 3) arrays")
        return {
            str(name): np.asarray(value * self.options.scale, np.float32) for name, value in templates.items()
        }

    def _flat(self, name: str) -> np.ndarray:
        """The array of a sequence's file, memory-mapped, its width checked."""
        self._known(name)
        path = self.directory / "vertices_npy" / f"{self._stems[name]}.npy"
        subject = self._stems[name].rpartition("_")[0]
        if subject not in self.subjects:
            raise FileFormatError(f"{path}: templates.pkl has no subject {subject!r}")
        size = self.subjects[subject].template.size
        flat = read_npy(path)
        if flat.ndim == 3 and flat.shape[2] == 3:
            flat = flat.reshape(len(flat), -1)
        if flat.ndim != 2 or flat.shape[1] != size:
            raise FileFormatError(f"{path} has shape {flat.shape}, expected (frames, {size})")
        return flat

    def _written(self, name: str) -> SequenceInfo:
        frames = len(self._flat(name))
        folder = self.directory / "sequences" / name
        if self._record is not None and folder.is_dir():
            info = read_info(folder, self._record.fps, self.subjects)
            if info.frames != frames:
                raise FileFormatError(f"{folder} has {info.frames} frames, its vertices {frames}")
            return info
        subject, _, sentence = self._stems[name].rpartition("_")
        number = int(sentence[-2:]) if sentence[-2:].isdigit() else 0
        return SequenceInfo(subject, number, "", self._file_fps, frames, name=name)

    def info(self, name: str) -> SequenceInfo:
        """By the name and the header of the array, and what stands beside it."""
        return self._strided(self._written(name))

    def motion(self, name: str) -> MotionArrays:
        """Vertices, memory-mapped where they are float32 in the data set's unit."""
        info = self._written(name)
        vertices = self._flat(name).reshape(info.frames, -1, 3)[:: self.options.stride]
        arrays = MotionArrays(as_float32(vertices, self.options.scale))
        folder = self.directory / "sequences" / name
        if self._record is None or not folder.is_dir():
            return arrays
        step = self.options.stride
        pose, curves, coefficients = read_beside(folder, info, len(self.curve_names))
        coefficients = every_frame(coefficients, info.frames, step)
        return replace(arrays, pose=pose[::step], curves=curves[::step], coefficients=coefficients)

    def audio(self, name: str) -> Waveform:
        """The sound of a sequence."""
        return load_waveform(self.audio_file(name), rate=None)

    def audio_file(self, name: str) -> Path:
        """Its file."""
        self._known(name)
        return self.directory / "wav" / f"{self._stems[name]}.wav"
