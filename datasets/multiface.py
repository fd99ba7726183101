"""Multiface (Wuu et al. 2022): tracked meshes, head poses, cameras and sound of thirteen people.

    DIR/m--DATE--TIME--ID--GHS/        one folder a person; DIR may be such a folder itself
        tracked_mesh/SEGMENT/000102.bin    raw little-endian float32 (7306, 3), millimetres, head-aligned
        tracked_mesh/SEGMENT/000102.obj    the same with faces and texture coordinates
        tracked_mesh/SEGMENT/000102_transform.txt    3 x 4, from the mesh to the world of the cameras
        audio/SEN_NAME.wav             sound of the fifty sentences
        frame_list.txt                 lines "SEGMENT FRAME"
        vert_mean.bin                  mean of all meshes
        KRT                            cameras (`read_krt`)

30 frames a second. Numbers of people and sentences, and the splits, are those of FaceDiffuser (Stan et al.
2023): sentences 1 to 40, 41 to 45 and 46 to 50 of people 2, 3, 6, 7 and 9 to 13 (train, val, test), and 46 to
50 of people 1, 4, 5 and 8 (test_unseen), whose others it does not use (here: spare). It does not say which
folder has which number: here they count in the order of the folders' names.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import roma
import torch
from jaxtyping import Float32, Int

from meshanim.audio import Waveform, load_waveform
from meshanim.datasets.motion_dataset import (
    DatasetOptions,
    MotionArrays,
    MotionDataset,
    SequenceInfo,
    Subject,
)
from meshanim.datasets.multiface_cameras import MILLIMETRE, CalibratedCamera, read_head_pose, read_krt
from meshanim.datasets.multiface_names import ENTITIES, SENTENCES
from meshanim.datasets.multiface_topology import (
    FULL,
    REDUCED,
    exact_vertices,
    read_dropped,
    read_obj,
    without_vertices,
)
from meshanim.errors import FileFormatError, OptionError
from meshanim.geometry import TriangleMesh

__all__ = ["MultifaceDataset", "MultifaceOptions"]

FPS = 30.0
SPOKEN = "SEN_"
FOLDER = re.compile(r"m--\d{8}--\d{4}--(\d+)--GHS")
NEUTRAL = "E001_Neutral_Eyes_Open"
TRAINED, UNSEEN = (2, 3, 6, 7, 9, 10, 11, 12, 13), (1, 4, 5, 8)
SPLITS = {
    "train": (TRAINED, range(1, 41)),
    "val": (TRAINED, range(41, 46)),
    "test": (TRAINED, range(46, 51)),
    "test_unseen": (UNSEEN, range(46, 51)),
}


@dataclass(frozen=True)
class MultifaceOptions(DatasetOptions):
    """Which topology.

    Parameters
    ----------
    vertices : int
        7306, as tracked, or 6172, as MeshTalk and FaceDiffuser use. The 1,134 vertices left out come from
        one of: `dropped`; `template` with `full_template`; the .obj files, where FaceDiffuser's conversion
        has rewritten them.
    dropped : path, optional
        The list of the vertices left out (`read_dropped`).
    template : path, optional
        OBJ with the faces of 6,172 vertices.
    full_template : path, optional
        OBJ of 7,306 vertices in the pose of `template`: which are kept is told by position.
    """

    vertices: int = FULL
    dropped: Path | None = None
    template: Path | None = None
    full_template: Path | None = None

    def __post_init__(self):
        super().__post_init__()
        if self.vertices not in (FULL, REDUCED):
            raise OptionError(f"Multiface has {FULL} or {REDUCED} vertices, not {self.vertices}")
        given = [name for name in ("dropped", "template", "full_template") if getattr(self, name)]
        if given and self.vertices == FULL:
            raise OptionError(
                f"{', '.join(given)} tell how to get {REDUCED} vertices: give vertices {REDUCED}"
            )
        if self.full_template and not self.template:
            raise OptionError("full_template needs template: which vertices are kept is told from both")


class MultifaceDataset(MotionDataset):
    """Reads the layout above; a sequence is a spoken segment of a person, named ID_SEGMENT.

    The other segments, of facial expressions, were recorded silent; a template comes from one of them.

    Taking a sequence reads its own files and no other. Coefficients: `translation` (T, 3), metres, and
    `frame_number` (T,). `pose` and `translation` take a mesh to the world of the cameras: the rotation is
    about the origin of the mesh, there is no neck joint. Gaps in the frame numbers stay gaps: the frames
    there are follow each other, and `check` names the gaps.

    Parameters
    ----------
    directory : path
        With the people's folders, or one of them.
    options : MultifaceOptions, optional
        Topology.

    Raises
    ------
    FileFormatError
        If a part is missing or damaged.
    """

    kind = "multiface"
    files = "m--DATE--TIME--ID--GHS/tracked_mesh/"
    Options = MultifaceOptions

    @classmethod
    def detect(cls, directory: Path) -> bool:
        """By a folder of a person with tracked_mesh/."""
        return bool(_entity_folders(directory))

    def __init__(self, directory: str | Path, options: MultifaceOptions | None = None):
        super().__init__(directory, options)
        self.name = "multiface"
        self.fps = FPS / self.options.stride
        found = _entity_folders(self.directory)
        if not found:
            raise FileFormatError(f"{self.directory} has no {self.files}: not Multiface's layout")
        order = [name for name in ENTITIES if name in found] + sorted(set(found) - set(ENTITIES))
        self._folders = {name: found[name] for name in order}
        self._listed = {name: _read_frame_list(folder) for name, folder in self._folders.items()}
        self._segments = {
            f"{entity}_{segment}": (entity, segment)
            for entity, folder in self._folders.items()
            for segment in sorted(
                entry.name for entry in (folder / "tracked_mesh").iterdir() if entry.is_dir()
            )
            if segment.startswith(SPOKEN)
        }
        self.sequences = tuple(self._segments)
        if not self.sequences:
            raise FileFormatError(
                f"{self.directory} has no spoken segments, tracked_mesh/{SPOKEN}..., among its people"
            )
        obj = self._any_obj()
        self._kept = self._kept_vertices(obj)
        self.mesh = self._topology(obj)
        self.subjects = {name: self._subject(name) for name in order}
        self.splits = self._published_splits()

    def _published_splits(self) -> dict[str, tuple[str, ...]]:
        splits: dict[str, list[str]] = {name: [] for name in (*SPLITS, "spare")}
        for name, (entity, segment) in self._segments.items():
            if entity in ENTITIES and (sentence := _sentence(segment)):
                number = ENTITIES.index(entity) + 1
                inside = [
                    key for key, (people, some) in SPLITS.items() if number in people and sentence in some
                ]
                splits[inside[0] if inside else "spare"].append(name)
        return {name: tuple(members) for name, members in splits.items()}

    def _any_obj(self) -> Path | None:
        for name in self.sequences:
            entity, segment = self._segments[name]
            folder = self._folders[entity] / "tracked_mesh" / segment
            if objs := sorted(folder.glob("*.obj")):
                return objs[0]
        return None

    def _kept_vertices(self, obj: Path | None) -> Int[np.ndarray, " kept"] | None:
        options = self.options
        if options.vertices == FULL:
            return None
        if options.dropped:
            return np.setdiff1d(np.arange(FULL), read_dropped(options.dropped))
        if options.full_template:
            full, reduced = _counted(options.full_template, FULL), _counted(options.template, REDUCED)
            what = f"{options.template} in {options.full_template}"
            return exact_vertices(full.vertices, reduced.vertices, what)
        if obj and (mesh := read_obj(obj)).n_vertices == REDUCED:
            path = obj.with_suffix(".bin")
            return exact_vertices(_read_vertices(path).astype(np.float64), mesh.vertices, f"{obj} in {path}")
        raise OptionError(
            f"{REDUCED} vertices need to know the {FULL - REDUCED} left out: give dropped, or template and "
            "full_template"
        )

    def _topology(self, obj: Path | None) -> TriangleMesh | None:
        """Faces of the template or of a frame, in the order of the vertices read; None without either."""
        if self.options.template:
            mesh = _counted(self.options.template, REDUCED)
        elif obj:
            mesh = read_obj(obj)
            if self._kept is not None and mesh.n_vertices == FULL:
                mesh = without_vertices(mesh, self._kept)
            if mesh.n_vertices != self.options.vertices:
                advice = (
                    f": FaceDiffuser's conversion rewrote it, give vertices {REDUCED}"
                    if mesh.n_vertices == REDUCED
                    else ""
                )
                raise FileFormatError(
                    f"{obj} has {mesh.n_vertices} vertices, expected {self.options.vertices}{advice}"
                )
        else:
            return None
        return mesh.with_vertices(mesh.vertices * MILLIMETRE)

    def _subject(self, entity: str) -> Subject:
        """The first frame with a neutral face, or else the mean of all meshes, or else any first frame."""
        folder = self._folders[entity]
        neutral = sorted((folder / "tracked_mesh" / NEUTRAL).glob("*.bin"))
        mean = folder / "vert_mean.bin"
        first = next(iter(neutral), mean if mean.is_file() else None)
        if first is None:
            names = [name for name in self.sequences if self._segments[name][0] == entity]
            first = next((path for name in names for path in self._frames(name)), None)
        if first is None:
            raise FileFormatError(f"{folder} has no {NEUTRAL}, no vert_mean.bin and no frames: no template")
        source = str(first.relative_to(folder))
        return Subject(entity, self._metres(first), attributes={"folder": folder.name, "template": source})

    def _metres(self, path: Path) -> Float32[np.ndarray, "vertices 3"]:
        vertices = _read_vertices(path)
        kept = vertices if self._kept is None else vertices[self._kept]
        return (kept * np.float32(MILLIMETRE)).astype(np.float32)

    def _all_frames(self, name: str) -> list[Path]:
        """Every frame of a sequence: those that frame_list.txt names, or those there are without it."""
        self._known(name)
        entity, segment = self._segments[name]
        folder = self._folders[entity] / "tracked_mesh" / segment
        listed = self._listed[entity].get(segment)
        if listed is None:
            return sorted(folder.glob("*.bin"), key=_number)
        return [folder / f"{frame}.bin" for frame in listed]

    def _frames(self, name: str) -> list[Path]:
        return self._all_frames(name)[:: self.options.stride]

    def info(self, name: str) -> SequenceInfo:
        """By the name and the list of frames."""
        frames = len(self._frames(name))
        entity, segment = self._segments[name]
        text = segment.removeprefix(SPOKEN).replace("_", " ")
        return SequenceInfo(entity, _sentence(segment), text, self.fps, frames, name=name)

    def motion(self, name: str) -> MotionArrays:
        """Vertices in metres, the head pose's rotation; translation and numbers of the frames."""
        paths = self._frames(name)
        vertices = np.empty((len(paths), self.options.vertices, 3), np.float32)
        rotation, translation = np.empty((len(paths), 3, 3)), np.empty((len(paths), 3), np.float32)
        for index, path in enumerate(paths):
            vertices[index] = self._metres(path)
            rotation[index], translation[index] = read_head_pose(path.with_name(f"{path.stem}_transform.txt"))
        pose = roma.rotmat_to_rotvec(torch.from_numpy(rotation)).numpy().astype(np.float32)
        numbers = np.array([_number(path) for path in paths], np.int64)
        coefficients: dict[str, np.ndarray] = {"translation": translation, "frame_number": numbers}
        return MotionArrays(vertices, pose, coefficients=coefficients)

    def audio(self, name: str) -> Waveform:
        """The sound of a sequence."""
        return load_waveform(self.audio_file(name), rate=None)

    def audio_file(self, name: str) -> Path:
        """Its file."""
        self._known(name)
        entity, segment = self._segments[name]
        return self._folders[entity] / "audio" / f"{segment}.wav"

    def cameras(self, subject: str) -> dict[str, CalibratedCamera]:
        """The calibrated cameras of a person's capture, from KRT."""
        if subject not in self._folders:
            raise OptionError(f"{self.directory} has no {subject!r}; there are {', '.join(self._folders)}")
        return read_krt(self._folders[subject] / "KRT")

    def check(self, progress: bool = False, workers: int = 1) -> list[str]:
        """As of every data set; also gaps, frames that are not listed, and templates that are no neutral."""
        return [*super().check(progress), *self._frame_defects()]

    def _frame_defects(self) -> Iterator[str]:
        for name, folder in self._folders.items():
            if not self._listed[name]:
                yield f"{folder}: no frame_list.txt, the frames are those that are there"
            if self.subjects[name].attributes["template"].startswith(f"tracked_mesh/{SPOKEN}"):
                yield f"{name}: no {NEUTRAL} and no vert_mean.bin: the template is a frame of speech"
        for name in self.sequences:
            frames = self._all_frames(name)
            numbers = np.array([_number(path) for path in frames])
            steps = np.diff(numbers)
            if (steps <= 0).any():
                yield f"{name}: frame_list.txt is not in order of the frames"
            gaps = np.flatnonzero(steps > 1)
            if len(gaps):
                at = gaps[0]
                lost = int((steps[gaps] - 1).sum())
                yield (
                    f"{name}: {lost} frames missing in {len(gaps)} gaps, the first between "
                    f"{numbers[at]:06d} and {numbers[at + 1]:06d}: motion after it is ahead of the sound"
                )
            entity, segment = self._segments[name]
            there = {path.name for path in (self._folders[entity] / "tracked_mesh" / segment).glob("*.bin")}
            listed = {path.name for path in frames}
            if absent := sorted(listed - there):
                yield f"{name}: {len(absent)} frames of frame_list.txt are not there, such as {absent[0]}"
            if extra := sorted(there - listed):
                yield f"{name}: {len(extra)} frames are not in frame_list.txt, such as {extra[0]}"


def _entity_folders(directory: Path) -> dict[str, Path]:
    """Folders of people by their number, `directory` itself or in it."""
    candidates = [directory, *sorted(entry for entry in directory.glob("m--*--GHS"))]
    return {
        match.group(1): path
        for path in candidates
        if (match := FOLDER.fullmatch(path.resolve().name)) and (path / "tracked_mesh").is_dir()
    }


def _read_frame_list(folder: Path) -> dict[str, list[str]]:
    """Frames by segment; empty without the file."""
    path = folder / "frame_list.txt"
    if not path.is_file():
        return {}
    frames: dict[str, list[str]] = {}
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        words = line.split()
        if not words:
            continue
        if len(words) != 2 or not words[1].isdigit():
            raise FileFormatError(f"{path}, line {number}: {line!r}; expected a segment and a frame")
        frames.setdefault(words[0], []).append(words[1])
    return frames


def _number(path: Path) -> int:
    if not path.stem.isdigit():
        raise FileFormatError(f"{path}: the name of a frame is its number")
    return int(path.stem)


def _sentence(segment: str) -> int:
    return SENTENCES.index(segment) + 1 if segment in SENTENCES else 0


def _read_vertices(path: Path) -> Float32[np.ndarray, "vertices 3"]:
    """The memory-mapped 7,306 vertices of a frame, millimetres."""
    try:
        size = path.stat().st_size
        if size != FULL * 12:
            count = f"{size // 12} vertices" if size % 12 == 0 else f"{size} bytes, no whole vertices"
            raise FileFormatError(f"{path} has {count}, expected {FULL}: cut short or of another topology")
        return np.memmap(path, np.dtype("<f4"), "r", shape=(FULL, 3))
    except OSError as error:
        raise FileFormatError(f"cannot read {path}: {error.strerror or error}") from error


def _counted(path: Path, count: int) -> TriangleMesh:
    mesh = read_obj(path)
    if mesh.n_vertices != count:
        raise FileFormatError(f"{path} has {mesh.n_vertices} vertices, expected {count}")
    return mesh
