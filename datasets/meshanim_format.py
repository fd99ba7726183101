"""The project's own data set layout: motion memory-mapped, sound beside it, anything known kept.

    DIR/dataset.json              name, version, fps, unit, head, curve_names, subjects, splits
    DIR/mesh.npz                  faces (F, 3), template (V, 3); absent where there is no topology
    DIR/subjects/NAME.npz         template (V, 3), shape (S,)
    DIR/sequences/NAME/           vertices.npy (T, V, 3) float32, in the zero pose
                                  pose.npy (T, 3), curves.npy (T, E), audio.wav
                                  coefficients.safetensors  other arrays by name; absent where there are none
                                  sequence.json name, subject, sentence, text, frames, phonemes, emotion, ...

Frame i is at (i + 0.5) / fps seconds of the sound. Unit "m" (or "biwi"), radians, seconds. dataset.json is
written last: without it the data set is not finished. Version 1 had no unit but metres, no coefficients, and
sequences named SUBJECT_sentenceNN; it is read as well.

The same files without vertices.npy and audio.wav stand beside FaceFormer's folders when a data set is
converted to those (`meshanim.datasets.faceformer`).
"""

import json
import re
import shutil
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from meshanim.audio import Waveform, load_waveform, save_waveform
from meshanim.datasets.motion_dataset import (
    UNITS,
    DatasetOptions,
    MotionArrays,
    MotionDataset,
    MotionSequence,
    SequenceInfo,
    Subject,
)
from meshanim.errors import FileFormatError, OptionError, ShapeError
from meshanim.files import written_whole
from meshanim.geometry import TriangleMesh

__all__ = [
    "DatasetRecord",
    "MeshanimDataset",
    "MotionSequence",
    "SequenceInfo",
    "Subject",
    "read_beside",
    "read_info",
    "read_record",
    "write_dataset",
    "write_sequence",
    "write_subject",
]

VERSION = 2
SUBJECT_NAME = re.compile(r"[\w-]+")


def write_sequence(
    directory: str | Path,
    sequence: MotionSequence,
    sound: Path | None = None,
    lossless: bool = False,
    beside: bool = False,
) -> None:
    """Write one sequence's folder whole: temporary folder, then renamed, replacing an old one.

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
    beside : bool
        Leave out vertices and sound, which FaceFormer's folders hold.

    Raises
    ------
    ShapeError
        If the arrays disagree in length with `info.frames`.
    OptionError
        If the sequence's name cannot be a folder's.
    """
    info = sequence.info
    lengths = {name: len(getattr(sequence, name)) for name in ("vertices", "pose", "curves")}
    if set(lengths.values()) != {info.frames}:
        raise ShapeError(f"{info.name}: {info.frames} frames are announced, the arrays have {lengths}")
    if info.name.startswith(".") or "/" in info.name or "\\" in info.name:
        raise OptionError(f"{info.name!r} cannot name a sequence: it starts with a dot or has a slash")
    folder = Path(directory) / "sequences"
    folder.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=".half-", dir=folder))
    try:
        if not beside:
            np.save(temporary / "vertices.npy", np.ascontiguousarray(sequence.vertices, np.float32))
            if sound is None:
                save_waveform(sequence.audio, temporary / "audio.wav", lossless)
            else:
                shutil.copyfile(sound, temporary / "audio.wav")
        np.save(temporary / "pose.npy", np.ascontiguousarray(sequence.pose, np.float32))
        np.save(temporary / "curves.npy", np.ascontiguousarray(sequence.curves, np.float32))
        if sequence.coefficients:
            arrays = {key: np.ascontiguousarray(array) for key, array in sequence.coefficients.items()}
            save_file(arrays, temporary / "coefficients.safetensors")
        (temporary / "sequence.json").write_text(_json(asdict(info)), encoding="utf-8")
        temporary.chmod(0o755)
        target = folder / info.name
        if target.exists():
            shutil.rmtree(target)
        temporary.rename(target)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def write_subject(directory: str | Path, subject: Subject) -> None:
    """Write DIR/subjects/NAME.npz; attributes belong to dataset.json (`write_dataset`).

    Raises
    ------
    OptionError
        If the name has other characters than letters, digits, `_` and `-`.
    """
    if not SUBJECT_NAME.fullmatch(subject.name):
        raise OptionError(f"subject {subject.name!r}: expected letters, digits, _ and - alone")
    folder = Path(directory) / "subjects"
    folder.mkdir(parents=True, exist_ok=True)
    _save_npz(folder / f"{subject.name}.npz", template=subject.template, shape=subject.shape)


def write_dataset(
    directory: str | Path,
    name: str,
    fps: float,
    head: str,
    mesh: TriangleMesh | None,
    curve_names: Sequence[str],
    subjects: Sequence[Subject],
    splits: Mapping[str, Sequence[str]],
    unit: str = "m",
    stems: Mapping[str, str] | None = None,
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
    mesh : TriangleMesh or None
        Topology and mean template, None where there is no topology.
    curve_names : sequence of str
        Columns of curves.npy.
    subjects : sequence of Subject
        Everybody, in the order of one-hot codes.
    splits : mapping
        Sequence names by split: train, val, test, and others if wanted.
    unit : str
        Of vertices and templates: "m", or "biwi".
    stems : mapping, optional
        Names of files in FaceFormer's folders, where they are not those of the sequences.
    """
    directory = Path(directory)
    if mesh is not None:
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
        "unit": unit,
        "frame_time": "(i + 0.5) / fps",
        "topology": mesh is not None,
        "curve_names": list(curve_names),
        "subjects": {subject.name: dict(subject.attributes) for subject in subjects},
        "splits": {split: list(names) for split, names in splits.items()},
        "stems": dict(stems or {}),
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


def _read_npz(path: Path, keys: Sequence[str]) -> dict[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {key: archive[key] for key in keys}
    except OSError as error:
        raise FileFormatError(f"cannot read {path}: {error.strerror or error}") from error
    except (ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise FileFormatError(f"{path} is damaged or lacks one of {', '.join(keys)}: {error}") from error


@dataclass(frozen=True)
class DatasetRecord:
    """What dataset.json, mesh.npz and subjects/ hold, by the names of `MotionDataset`."""

    name: str
    fps: float
    unit: str
    head: str
    curve_names: tuple[str, ...]
    mesh: TriangleMesh | None
    subjects: dict[str, Subject]
    splits: dict[str, tuple[str, ...]]
    stems: dict[str, str]


def read_record(directory: Path) -> DatasetRecord:
    """Read the small files of a data set.

    Raises
    ------
    FileFormatError
        If a file is missing, damaged, of another version, or contradicts another file.
    """
    path = directory / "dataset.json"
    record = _read_json(path, ["version"])
    version = record["version"]
    if version == 1:
        record = {"topology": True, "stems": {}, "unit": record.get("units"), **record}
    elif version != VERSION:
        raise FileFormatError(f"{path} is version {version}, expected 1 or {VERSION}")
    required = ["name", "fps", "head", "unit", "topology", "curve_names", "subjects", "splits", "stems"]
    missing = [key for key in required if key not in record]
    if missing:
        raise FileFormatError(f"{path} lacks {', '.join(missing)}")
    if record["unit"] not in UNITS:
        raise FileFormatError(f"{path} is in {record['unit']}, expected {' or '.join(UNITS)}")
    mesh = None
    if record["topology"]:
        arrays = _read_npz(directory / "mesh.npz", ["faces", "template"])
        mesh = TriangleMesh(arrays["template"], arrays["faces"])
    return DatasetRecord(
        record["name"],
        float(record["fps"]),
        record["unit"],
        record["head"],
        tuple(record["curve_names"]),
        mesh,
        {name: _read_subject(directory, name, more, mesh) for name, more in record["subjects"].items()},
        {split: tuple(names) for split, names in record["splits"].items()},
        record["stems"],
    )


def _read_subject(
    directory: Path, name: str, attributes: Mapping[str, Any], mesh: TriangleMesh | None
) -> Subject:
    path = directory / "subjects" / f"{name}.npz"
    arrays = _read_npz(path, ["template", "shape"])
    template = arrays["template"].astype(np.float32)
    expected = (mesh.n_vertices if mesh else len(template), 3)
    if template.shape != expected:
        raise FileFormatError(f"{path}: template has shape {template.shape}, expected {expected}")
    return Subject(name, template, arrays["shape"].astype(np.float32), attributes)


def read_info(folder: Path, record_fps: float, subjects: Mapping[str, Subject]) -> SequenceInfo:
    """Read sequence.json of a sequence's folder, which is named as the sequence is.

    Raises
    ------
    FileFormatError
        If it is missing, damaged, or of another sequence, subject or rate.
    """
    path = folder / "sequence.json"
    keys = ["subject", "sentence", "text", "fps", "frames", "phonemes", "emotion", "intensity", "voice"]
    record = _read_json(path, keys)
    info = SequenceInfo(
        **{key: record[key] for key in keys if key != "phonemes"},
        phonemes=tuple((float(start), float(end), symbol) for start, end, symbol in record["phonemes"]),
        name=record.get("name", ""),
    )
    if info.name != folder.name or info.subject not in subjects:
        raise FileFormatError(
            f"{path} describes {info.name}, which is not this folder or of no known subject"
        )
    if info.fps != record_fps:
        raise FileFormatError(f"{path} has {info.fps} frames a second, the data set {record_fps}")
    return info


def read_beside(
    folder: Path, info: SequenceInfo, curves: int
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Pose, curves and coefficients of a sequence's folder, finite.

    Raises
    ------
    FileFormatError
        If a file is missing, cut short, of another shape than `info` says, or not finite.
    """
    pose = _read_array(folder / "pose.npy", (info.frames, 3), memory_map=False)
    weights = _read_array(folder / "curves.npy", (info.frames, curves), memory_map=False)
    for name, array in (("pose.npy", pose), ("curves.npy", weights)):
        if not np.isfinite(array).all():
            raise FileFormatError(f"{folder / name} holds values that are not finite")
    path = folder / "coefficients.safetensors"
    if not path.exists():
        return pose, weights, {}
    try:
        return pose, weights, load_file(path)
    except (SafetensorError, OSError) as error:
        raise FileFormatError(f"{path} is damaged or cut short: {error}") from error


class MeshanimDataset(MotionDataset):
    """Reads the layout at the top of this module.

    Opening reads the small files; vertices are memory-mapped when a sequence is taken. Length and iteration
    go over all sequences, in the order of their names.

    Parameters
    ----------
    directory : path
        With dataset.json.
    options : DatasetOptions, optional
        The stride.

    Raises
    ------
    FileFormatError
        If a file is missing, damaged, of another version, or contradicts another file.
    """

    kind = "meshanim"
    files = "dataset.json, sequences/"

    @classmethod
    def detect(cls, directory: Path) -> bool:
        """By sequences/ with vertices; dataset.json is missing where the data set is not finished."""
        return (directory / "sequences").is_dir() and not (directory / "vertices_npy").is_dir()

    def __init__(self, directory: str | Path, options: DatasetOptions | None = None):
        super().__init__(directory, options)
        if (self.directory / "vertices_npy").is_dir():
            raise FileFormatError(
                f"{self.directory} is in FaceFormer's layout: convert it (meshanim data convert)"
            )
        if not (self.directory / "dataset.json").exists():
            raise FileFormatError(f"{self.directory} has no dataset.json: no data set, or one not finished")
        record = read_record(self.directory)
        self.name, self.unit, self.head = record.name, record.unit, record.head
        self.curve_names, self.mesh = record.curve_names, record.mesh
        self.subjects, self.splits = record.subjects, record.splits
        self._file_fps = record.fps
        self.fps = record.fps / self.options.stride
        folder = self.directory / "sequences"
        found = folder.iterdir() if folder.is_dir() else ()
        self.sequences = tuple(
            sorted(entry.name for entry in found if not entry.name.startswith(".") and entry.is_dir())
        )

    def _written(self, name: str) -> SequenceInfo:
        self._known(name)
        return read_info(self.directory / "sequences" / name, self._file_fps, self.subjects)

    def info(self, name: str) -> SequenceInfo:
        """What is known about a sequence, without its arrays."""
        return self._strided(self._written(name))

    def motion(self, name: str) -> MotionArrays:
        """Vertices memory-mapped, shapes checked."""
        info = self._written(name)
        folder = self.directory / "sequences" / name
        pose, curves, coefficients = read_beside(folder, info, len(self.curve_names))
        count = len(self.subjects[info.subject].template)
        vertices = _read_array(folder / "vertices.npy", (info.frames, count, 3), memory_map=True)
        return self._every(info.frames, MotionArrays(vertices, pose, curves, coefficients))

    def audio(self, name: str) -> Waveform:
        """The sound of a sequence."""
        return load_waveform(self.audio_file(name), rate=None)

    def audio_file(self, name: str) -> Path:
        """Its file."""
        self._known(name)
        return self.directory / "sequences" / name / "audio.wav"
