"""The project's own data set layout: registered heads, motion memory-mapped, sound beside it.

    DIR/dataset.json                   name, version, fps, head, units, curve_names, subjects, splits
    DIR/mesh.npz                       faces (F, 3), template (V, 3)
    DIR/subjects/NAME.npz              template (V, 3), shape (S,)
    DIR/sequences/NAME_sentence01/     vertices.npy (T, V, 3) float32, in the zero pose
                                       pose.npy (T, 3), curves.npy (T, E), audio.wav
                                       sequence.json subject, sentence, text, frames, phonemes, emotion, ...

Frame i is at (i + 0.5) / fps seconds of the sound. Metres, radians, seconds.
"""

import json
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from meshanim.audio import Waveform, load_waveform, save_waveform
from meshanim.datasets.motion_dataset import (
    DatasetOptions,
    MotionArrays,
    MotionDataset,
    MotionSequence,
    SequenceInfo,
    Subject,
)
from meshanim.errors import FileFormatError, ShapeError
from meshanim.files import written_whole
from meshanim.geometry import TriangleMesh

__all__ = [
    "MeshanimDataset",
    "MotionSequence",
    "SequenceInfo",
    "Subject",
    "write_dataset",
    "write_sequence",
    "write_subject",
]

VERSION = 1


def write_sequence(directory: str | Path, sequence: MotionSequence) -> None:
    """Write one sequence's folder whole: temporary folder, then renamed, replacing an old one.

    Raises
    ------
    ShapeError
        If the arrays disagree in length with `info.frames`.
    """
    info = sequence.info
    lengths = {name: len(getattr(sequence, name)) for name in ("vertices", "pose", "curves")}
    if set(lengths.values()) != {info.frames}:
        raise ShapeError(f"{info.name}: {info.frames} frames are announced, the arrays have {lengths}")
    folder = Path(directory) / "sequences"
    folder.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{info.name}-", dir=folder))
    try:
        np.save(temporary / "vertices.npy", np.ascontiguousarray(sequence.vertices, np.float32))
        np.save(temporary / "pose.npy", np.ascontiguousarray(sequence.pose, np.float32))
        np.save(temporary / "curves.npy", np.ascontiguousarray(sequence.curves, np.float32))
        save_waveform(sequence.audio, temporary / "audio.wav")
        (temporary / "sequence.json").write_text(_json(asdict(info)), encoding="utf-8")
        temporary.chmod(0o755)
        target = folder / info.name
        if target.exists():
            shutil.rmtree(target)
        temporary.rename(target)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def write_subject(directory: str | Path, subject: Subject) -> None:
    """Write DIR/subjects/NAME.npz; attributes belong to dataset.json (`write_dataset`)."""
    folder = Path(directory) / "subjects"
    folder.mkdir(parents=True, exist_ok=True)
    _save_npz(folder / f"{subject.name}.npz", template=subject.template, shape=subject.shape)


def write_dataset(
    directory: str | Path,
    name: str,
    fps: float,
    head: str,
    mesh: TriangleMesh,
    curve_names: Sequence[str],
    subjects: Sequence[Subject],
    splits: Mapping[str, Sequence[str]],
) -> None:
    """Write mesh.npz and dataset.json; written last, dataset.json says that the data set is complete.

    Parameters
    ----------
    directory : path
        DIR, with sequences and subjects written.
    name : str
        Of the data set.
    fps : float
        Frames a second of every sequence.
    head : str
        What `meshanim.heads.load_head` understands, or "" for a topology without a head model.
    mesh : TriangleMesh
        Topology and mean template.
    curve_names : sequence of str
        Columns of curves.npy.
    subjects : sequence of Subject
        Everybody.
    splits : mapping
        Sequence names by split: train, val, test, and others if wanted.
    """
    directory = Path(directory)
    _save_npz(
        directory / "mesh.npz",
        faces=mesh.faces.astype(np.int32),
        template=mesh.vertices.astype(np.float32),
    )
    record = {
        "name": name,
        "version": VERSION,
        "fps": fps,
        "head": head,
        "units": "m",
        "frame_time": "(i + 0.5) / fps",
        "curve_names": list(curve_names),
        "subjects": {subject.name: dict(subject.attributes) for subject in subjects},
        "splits": {split: list(names) for split, names in splits.items()},
    }
    with written_whole(directory / "dataset.json") as temporary:
        temporary.write_text(_json(record), encoding="utf-8")


def _save_npz(path: Path, **arrays: np.ndarray) -> None:
    with written_whole(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def _json(record: Mapping[str, Any]) -> str:
    return json.dumps(record, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _read_json(path: Path, keys: Sequence[str]) -> dict[str, Any]:
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise FileFormatError(f"cannot read {path}: {error.strerror}") from error
    except ValueError as error:
        raise FileFormatError(f"{path} is not JSON: {error}") from error
    missing = [key for key in keys if key not in record] if isinstance(record, dict) else list(keys)
    if missing:
        raise FileFormatError(f"{path} lacks {', '.join(missing)}")
    return record


def _read_array(path: Path, shape: tuple[int | None, ...], memory_map: bool) -> np.ndarray:
    """A float32 array of the shape (None: any length); FileFormatError names the file otherwise."""
    try:
        array = np.load(path, mmap_mode="r" if memory_map else None, allow_pickle=False)
    except OSError as error:
        raise FileFormatError(f"cannot read {path}: {error.strerror or error}") from error
    except (ValueError, EOFError) as error:
        raise FileFormatError(f"{path} is damaged or cut short: {error}") from error
    expected = tuple("any" if size is None else size for size in shape)
    if array.dtype != np.float32:
        raise FileFormatError(f"{path} holds {array.dtype}, expected float32")
    if array.ndim != len(shape) or any(b is not None and a != b for a, b in zip(array.shape, shape)):
        raise FileFormatError(f"{path} has shape {array.shape}, expected {expected}")
    return array


class MeshanimDataset(MotionDataset):
    """Reads the layout at the top of this module.

    Opening reads the small files; vertices are memory-mapped when a sequence is taken. Length and iteration
    go over all sequences, in the order of their names.

    Parameters
    ----------
    directory : path
        With dataset.json.

    Attributes
    ----------
    name, fps, head : str, float, str
        As written.
    mesh : TriangleMesh
        Topology and mean template.
    curve_names : tuple of str
        Columns of the curves.
    subjects : dict of Subject
        By name.
    splits : dict of tuple of str
        Names of sequences.
    sequences : tuple of str
        All of them.

    Raises
    ------
    FileFormatError
        If a file is missing, damaged, of another version, or contradicts another file.
    """

    kind = "meshanim"
    files = "dataset.json, sequences/"
    mesh: TriangleMesh

    @classmethod
    def detect(cls, directory: Path) -> bool:
        """By dataset.json and sequences/."""
        return (directory / "dataset.json").is_file() and (directory / "sequences").is_dir()

    def __init__(self, directory: str | Path, options: DatasetOptions | None = None):
        super().__init__(directory, options)
        path = self.directory / "dataset.json"
        if not path.exists():
            raise FileFormatError(f"{self.directory} has no dataset.json: no data set, or one not finished")
        record = _read_json(
            path, ["name", "version", "fps", "head", "units", "curve_names", "subjects", "splits"]
        )
        if record["version"] != VERSION or record["units"] != "m":
            given = f"version {record['version']} in {record['units']}"
            raise FileFormatError(f"{path} is {given}, expected version {VERSION} in m")
        self.name = record["name"]
        self.fps = float(record["fps"])
        self.head = record["head"]
        self.curve_names = tuple(record["curve_names"])
        self.mesh = self._read_mesh()
        self.subjects = {
            name: self._read_subject(name, attributes) for name, attributes in record["subjects"].items()
        }
        folder = self.directory / "sequences"
        found = folder.iterdir() if folder.is_dir() else ()
        self.sequences = tuple(
            sorted(entry.name for entry in found if entry.is_dir() and not entry.name.startswith("."))
        )
        self.splits = {split: tuple(names) for split, names in record["splits"].items()}
        present = set(self.sequences)
        for split, names in self.splits.items():
            missing = [name for name in names if name not in present]
            if missing:
                raise FileFormatError(
                    f"{folder} lacks {len(missing)} sequences of split {split}, such as {missing[0]}"
                )

    def _read_mesh(self) -> TriangleMesh:
        arrays = self._read_npz(self.directory / "mesh.npz", ["faces", "template"])
        return TriangleMesh(arrays["template"], arrays["faces"])

    def _read_subject(self, name: str, attributes: Mapping[str, Any]) -> Subject:
        path = self.directory / "subjects" / f"{name}.npz"
        arrays = self._read_npz(path, ["template", "shape"])
        if arrays["template"].shape != (self.mesh.n_vertices, 3):
            expected = (self.mesh.n_vertices, 3)
            raise FileFormatError(
                f"{path}: template has shape {arrays['template'].shape}, expected {expected}"
            )
        template = arrays["template"].astype(np.float32)
        return Subject(name, template, arrays["shape"].astype(np.float32), attributes)

    @staticmethod
    def _read_npz(path: Path, keys: Sequence[str]) -> dict[str, np.ndarray]:
        try:
            with np.load(path, allow_pickle=False) as archive:
                arrays = {key: archive[key] for key in keys}
        except OSError as error:
            raise FileFormatError(f"cannot read {path}: {error.strerror or error}") from error
        except (ValueError, KeyError, EOFError) as error:
            raise FileFormatError(f"{path} is damaged or lacks one of {', '.join(keys)}: {error}") from error
        return arrays

    def info(self, name: str) -> SequenceInfo:
        """What is known about a sequence, without its arrays."""
        self._known(name)
        path = self.directory / "sequences" / name / "sequence.json"
        keys = ["subject", "sentence", "text", "fps", "frames", "phonemes", "emotion", "intensity", "voice"]
        record = _read_json(path, keys)
        info = SequenceInfo(
            **{key: record[key] for key in keys if key not in ("phonemes", "name")},
            phonemes=tuple((float(start), float(end), symbol) for start, end, symbol in record["phonemes"]),
        )
        if info.name != name or info.subject not in self.subjects:
            raise FileFormatError(
                f"{path} describes {info.name}, which is not this folder or of no known subject"
            )
        if info.fps != self.fps:
            raise FileFormatError(f"{path} has {info.fps} frames a second, the data set {self.fps}")
        return info

    def motion(self, name: str) -> MotionArrays:
        """Vertices memory-mapped, shapes checked."""
        info = self.info(name)
        folder = self.directory / "sequences" / name
        pose = _read_array(folder / "pose.npy", (info.frames, 3), memory_map=False)
        curves = _read_array(folder / "curves.npy", (info.frames, len(self.curve_names)), memory_map=False)
        for path, array in (("pose.npy", pose), ("curves.npy", curves)):
            if not np.isfinite(array).all():
                raise FileFormatError(f"{folder / path} holds values that are not finite")
        vertices = _read_array(
            folder / "vertices.npy", (info.frames, self.mesh.n_vertices, 3), memory_map=True
        )
        return MotionArrays(vertices, pose, curves)

    def audio(self, name: str) -> Waveform:
        """The sound of a sequence."""
        return load_waveform(self.audio_file(name), rate=None)

    def audio_file(self, name: str) -> Path:
        """Its file."""
        self._known(name)
        return self.directory / "sequences" / name / "audio.wav"
