"""Any folder of meshes with wavs.

    DIR/NAME.wav                the sound of each sequence, or a single wav in DIR/NAME/
    DIR/NAME/*.obj *.ply ...    one mesh a frame, in the order of the numbers at the end of the names
    DIR/NAME.npy                or (T, V, 3) or (T, V * 3)
    DIR/NAME.npz                or `vertices`, perhaps `fps`, `faces`, `pose`: what MeshSequence saves
    DIR/templates/SUBJECT.obj   neutral meshes, any mesh format; DIR/template.obj for everybody

The subject is the part of the name before the last underscore if there is one, else the folder's name.
Without a template a subject's is the first frame of its first sequence.
"""

import re
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from meshanim.audio import Waveform, load_waveform
from meshanim.datasets.mesh_files import as_float32, load_mesh, read_npy
from meshanim.datasets.motion_dataset import (
    DatasetOptions,
    MotionArrays,
    MotionDataset,
    SequenceInfo,
    Subject,
)
from meshanim.errors import FileFormatError, OptionError
from meshanim.geometry import TriangleMesh

__all__ = ["MeshFolderDataset", "MeshFolderOptions"]

MESHES = (".obj", ".ply", ".off", ".stl", ".glb", ".gltf")
ARRAYS = (".npy", ".npz")


@dataclass(frozen=True)
class MeshFolderOptions(DatasetOptions):
    """What files do not say.

    Parameters
    ----------
    fps : float, optional
        Frames a second; only .npz files may say it themselves.
    scale : float
        Metres for one unit of the files.
    faces : path, optional
        A mesh file with the faces; otherwise a template's or the first frame's.
    """

    fps: float | None = None
    scale: float = 1.0
    faces: Path | None = None

    def __post_init__(self):
        super().__post_init__()
        if (self.fps is not None and not self.fps > 0) or not self.scale > 0:
            raise OptionError(f"fps and scale must be positive, not {self.fps} and {self.scale}")


class MeshFolderDataset(MotionDataset):
    """Reads the layout above.

    Parameters
    ----------
    directory : path
        The folder.
    options : MeshFolderOptions, optional
        Rate, stride, unit, faces.

    Raises
    ------
    FileFormatError
        If there are no sequences, or a first frame or template is damaged.
    OptionError
        If nothing says the frames a second.
    """

    kind = "meshes"
    files = "NAME.wav beside NAME/*.obj, NAME.npy or NAME.npz"
    Options = MeshFolderOptions

    @classmethod
    def detect(cls, directory: Path) -> bool:
        """By an array with its wav, or a folder with meshes."""
        sources = _sources(directory)
        return any(path.is_dir() or path.with_suffix(".wav").exists() for path in sources.values())

    def __init__(self, directory: str | Path, options: MeshFolderOptions | None = None):
        super().__init__(directory, options)
        self._sources = _sources(self.directory)
        if not self._sources:
            raise FileFormatError(f"{self.directory} holds no sequences; expected {self.files}")
        self.name = self.directory.resolve().name
        self.sequences = tuple(self._sources)
        self.splits = {}
        self._file_fps = self._rate()
        self.fps = self._file_fps / self.options.stride
        self.mesh, templates = self._read_templates()
        self.subjects = {name: Subject(name, template) for name, template in templates.items()}

    def _rate(self) -> float:
        if self.options.fps is not None:
            return self.options.fps
        rates = {}
        for name, path in self._sources.items():
            if path.suffix == ".npz":
                with _archive(path) as archive:
                    if "fps" in archive:
                        rates[name] = float(archive["fps"])
        if len(rates) < len(self._sources):
            raise OptionError(f"nothing in {self.directory} says its frames a second: give fps (--fps)")
        if len(set(rates.values())) > 1:
            given = ", ".join(f"{rate:g}" for rate in sorted(set(rates.values())))
            raise OptionError(f"sequences of {self.directory} have {given} frames a second: give one (--fps)")
        return next(iter(rates.values()))

    def _subject(self, name: str) -> str:
        return name.rpartition("_")[0] or self.name

    def _read_templates(self) -> tuple[TriangleMesh | None, dict[str, np.ndarray]]:
        named = _by_stem(self.directory / "templates")
        everybody = _by_stem(self.directory).get("template")
        templates: dict[str, np.ndarray] = {}
        mesh = None
        if self.options.faces is not None:
            mesh = load_mesh(self.options.faces, scale=self.options.scale)
        for name, source in self._sources.items():
            subject = self._subject(name)
            if subject in templates:
                continue
            path = named.get(subject, everybody)
            if path is None and source.is_dir():
                path = _frames(source)[0]
            if path is not None:
                loaded = load_mesh(path, scale=self.options.scale)
                templates[subject] = loaded.vertices.astype(np.float32)
                mesh = mesh or loaded
            else:
                vertices, faces = self._array(name)
                templates[subject] = np.array(as_float32(vertices[0], self.options.scale))
                if mesh is None and faces is not None:
                    mesh = TriangleMesh(templates[subject], faces)
        return mesh, templates

    def _array(self, name: str) -> tuple[np.ndarray, np.ndarray | None]:
        """Vertices (T, V, 3) of a file as they are, and faces where it has them."""
        path, faces = self._sources[name], None
        if path.suffix == ".npz":
            with _archive(path) as archive:
                if "vertices" not in archive:
                    raise FileFormatError(f"{path} has {', '.join(archive)}, expected vertices")
                vertices = archive["vertices"]
                faces = archive.get("faces")
        else:
            vertices = read_npy(path)
        if vertices.ndim == 2 and vertices.shape[1] % 3 == 0:
            vertices = vertices.reshape(len(vertices), -1, 3)
        if vertices.ndim != 3 or vertices.shape[2] != 3 or len(vertices) == 0:
            raise FileFormatError(f"{path} has shape {vertices.shape}, expected (frames, vertices, 3)")
        return vertices, faces

    def info(self, name: str) -> SequenceInfo:
        """By names and headers."""
        self._known(name)
        source = self._sources[name]
        if source.is_dir():
            frames = len(_frames(source))
        elif source.suffix == ".npz":
            frames = _npz_shape(source, "vertices")[0]
        else:
            frames = len(self._array(name)[0])
        digits = re.search(r"(\d+)$", name)
        sentence = int(digits[1]) if digits else 0
        info = SequenceInfo(self._subject(name), sentence, "", self._file_fps, frames, name=name)
        return self._strided(info)

    def motion(self, name: str) -> MotionArrays:
        """Vertices; memory-mapped from an .npy of float32 in metres."""
        info = self.info(name)
        count = len(self.subjects[info.subject].template)
        source, step = self._sources[name], self.options.stride
        pose = None
        if source.is_dir():
            files = _frames(source)[::step]
            vertices = np.empty((len(files), count, 3), np.float32)
            for frame, path in enumerate(files):
                vertices[frame] = load_mesh(path, count, self.options.scale).vertices
            return MotionArrays(vertices)
        read = self._array(name)[0]
        if read.shape[1] != count:
            raise FileFormatError(f"{source} has {read.shape[1]} vertices, expected {count}")
        if source.suffix == ".npz":
            with _archive(source) as archive:
                if "pose" in archive:
                    pose = as_float32(archive["pose"])
                    if pose.shape != (len(read), 3):
                        raise FileFormatError(
                            f"{source}: pose has shape {pose.shape}, expected ({len(read)}, 3)"
                        )
        return MotionArrays(
            as_float32(read[::step], self.options.scale), None if pose is None else pose[::step]
        )

    def audio(self, name: str) -> Waveform:
        """The sound of a sequence."""
        return load_waveform(self.audio_file(name), rate=None)

    def audio_file(self, name: str) -> Path:
        """Its file."""
        self._known(name)
        beside = self.directory / f"{name}.wav"
        if not beside.exists() and self._sources[name].is_dir():
            inside = sorted(self._sources[name].glob("*.wav"))
            if len(inside) == 1:
                return inside[0]
        return beside


def _archive(path: Path):
    try:
        archive = np.load(path, allow_pickle=False)
    except OSError as error:
        raise FileFormatError(f"cannot read {path}: {error.strerror or error}") from error
    except (ValueError, EOFError, zipfile.BadZipFile) as error:
        raise FileFormatError(f"{path} is damaged or cut short: {error}") from error
    if not isinstance(archive, np.lib.npyio.NpzFile):
        raise FileFormatError(f"{path} is no .npz archive")
    return archive


def _npz_shape(path: Path, key: str) -> tuple[int, ...]:
    """Shape of an array in an archive, by its header."""
    try:
        with zipfile.ZipFile(path) as archive, archive.open(f"{key}.npy") as stream:
            version = np.lib.format.read_magic(stream)
            if version == (1, 0):
                return np.lib.format.read_array_header_1_0(stream)[0]
            return np.lib.format.read_array_header_2_0(stream)[0]
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise FileFormatError(f"{path} is damaged or has no {key}: {error}") from error


def _by_stem(folder: Path) -> dict[str, Path]:
    """Mesh files of a folder by their names without ending."""
    if not folder.is_dir():
        return {}
    return {path.stem: path for path in sorted(folder.iterdir()) if path.suffix.lower() in MESHES}


def _frames(folder: Path) -> tuple[Path, ...]:
    """Meshes of a folder in the order of the numbers that end their names."""
    files = [path for path in folder.iterdir() if path.suffix.lower() in MESHES]

    def order(path: Path) -> tuple[int, str]:
        digits = re.search(r"(\d+)$", path.stem)
        return int(digits[1]) if digits else -1, path.stem

    return tuple(sorted(files, key=order))


def _sources(directory: Path) -> dict[str, Path]:
    """Where the motion of each sequence is: a folder of meshes or an array with a wav beside it."""
    found = {}
    for path in sorted(directory.iterdir()) if directory.is_dir() else ():
        if path.name.startswith(".") or path.name == "templates":
            continue
        if path.is_dir() and any(entry.suffix.lower() in MESHES for entry in path.iterdir()):
            found[path.name] = path
        elif path.suffix in ARRAYS:
            found[path.stem] = path
    return found
