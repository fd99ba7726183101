"""HDTF_TFHP as DiffPoseTalk (Sun et al. 2024) packs it: an LMDB of clips with FLAME coefficients and sound.

    DIR/data.mdb                   "metadata" {"seg_len": 100}
                                   "PERSON/VIDEO/metadata" {"n_frames": T}
                                   "PERSON/VIDEO/000", "PERSON/VIDEO/001", ...: pickles of
                                       {"coef": {"shape" (t, 100), "exp" (t, 50), "pose" (t, 6)},
                                        "audio": bytes of a flac file at 16 kHz}, t up to seg_len frames
    DIR/train.txt, val.txt, test.txt    lines "PERSON/VIDEO"
    DIR/keys.txt                        all of them
    DIR/stats_train.npz                 shape_mean, shape_std, exp_mean, ... (`coefficient_statistics`)

25 frames a second; the pose is the head's rotation and the jaw's, axis-angle. DIR may also be the folder that
lmdb/ lies in.
"""

import io
import threading
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import soundfile
from jaxtyping import Float32

from meshanim.audio import Waveform
from meshanim.datasets.flame_coefficients import (
    CoefficientOptions,
    LateSubjects,
    flame_vertices,
    optional_head,
)
from meshanim.datasets.motion_dataset import MotionArrays, MotionDataset, SequenceInfo
from meshanim.errors import DependencyError, FileFormatError
from meshanim.unpickle import load_pickled_bytes

__all__ = ["DiffPoseTalkDataset"]

FPS = 25.0
SAMPLE_RATE = 16000
WIDTHS = {"shape": 100, "exp": 50, "pose": 6}
SPLITS = ("train", "val", "test")
OPEN = threading.Lock()


class DiffPoseTalkDataset(MotionDataset):
    """Reads the layout above; clips of a video are joined into one sequence, named PERSON_VIDEO.

    Coefficients: `shape` (T, 100), `expression` (T, 50), `jaw` (T, 3). A subject's shape is the mean over the
    first clip of their first video that can be read. Values are unpickled by `meshanim.unpickle`, which knows
    arrays alone.

    Parameters
    ----------
    directory : path
        With data.mdb, or with lmdb/data.mdb.
    options : CoefficientOptions, optional
        Head.

    Raises
    ------
    DependencyError
        If lmdb is missing.
    FileFormatError
        If a part is missing or damaged.
    """

    kind = "diffposetalk"
    files = "data.mdb, train.txt"
    Options = CoefficientOptions

    @classmethod
    def detect(cls, directory: Path) -> bool:
        """By data.mdb."""
        return (_database(directory) / "data.mdb").is_file()

    def __init__(self, directory: str | Path, options: CoefficientOptions | None = None):
        super().__init__(directory, options)
        self.name = "hdtf_tfhp"
        self.fps = FPS / self.options.stride
        self._folder = _database(self.directory)
        self._head = optional_head(self.options.head)
        self.head = self.options.head
        self.mesh = None if self._head is None else self._head.mesh
        self._clips = self._list_clips()
        if not self._clips:
            raise FileFormatError(f"{self._folder / 'data.mdb'} has no key PERSON/VIDEO/metadata")
        self._keys = {key.replace("/", "_"): key for key in sorted(self._clips)}
        self.sequences = tuple(self._keys)
        self.subjects = LateSubjects(
            self._head,
            [(_person(key), name) for name, key in self._keys.items()],
            self._first_shape,
        )
        self.splits = {
            split: tuple(line.replace("/", "_") for line in _lines(path))
            for split in SPLITS
            if (path := self._folder / f"{split}.txt").is_file()
        }
        self._clip_frames = self._length("metadata", "seg_len")

    @contextmanager
    def _reading(self) -> Iterator[Any]:
        """A transaction. LMDB opens a folder once a process and not across a fork: it is closed at once."""
        lmdb = _lmdb()
        try:
            with (
                OPEN,
                lmdb.open(str(self._folder), readonly=True, lock=False, readahead=False) as environment,
                environment.begin() as transaction,
            ):
                yield transaction
        except lmdb.Error as error:
            raise FileFormatError(f"{self._folder / 'data.mdb'} is no whole LMDB: {error}") from error

    def _list_clips(self) -> dict[str, list[int]]:
        """Numbers of the clips by key of their video."""
        clips: dict[str, list[int]] = {}
        found: dict[str, list[int]] = defaultdict(list)
        with self._reading() as transaction:
            for raw in transaction.cursor().iternext(keys=True, values=False):
                key, _, last = raw.decode("utf-8", "replace").rpartition("/")
                if last == "metadata" and key:
                    clips[key] = found[key]
                elif last.isdigit():
                    found[key].append(int(last))
        return clips

    def _value(self, key: str) -> Any:
        where = f"{self._folder / 'data.mdb'}, key {key}"
        with self._reading() as transaction:
            content = transaction.get(key.encode())
        if content is None:
            raise FileFormatError(f"{where} does not exist")
        return load_pickled_bytes(content, where)

    def _length(self, key: str, field: str) -> int:
        value = self._value(key)
        number = value.get(field) if isinstance(value, dict) else None
        if not isinstance(number, int | np.integer) or number < 1:
            raise FileFormatError(
                f"{self._folder / 'data.mdb'}, key {key} has {field} {number!r}, expected a number of frames"
            )
        return int(number)

    def _key(self, name: str) -> str:
        self._known(name)
        return self._keys[name]

    def _frames(self, key: str) -> int:
        return self._length(f"{key}/metadata", "n_frames")

    def _read_clips(self, key: str) -> Iterator[tuple[dict[str, Float32[np.ndarray, "frames width"]], bytes]]:
        frames = self._frames(key)
        for number in range(-(-frames // self._clip_frames)):
            length = min(self._clip_frames, frames - number * self._clip_frames)
            yield self._read_clip(f"{key}/{number:03d}", length)

    def _read_clip(self, key: str, length: int) -> tuple[dict[str, np.ndarray], bytes]:
        where = f"{self._folder / 'data.mdb'}, key {key}"
        value = self._value(key)
        if not isinstance(value, dict) or not isinstance(value.get("coef"), dict) or "audio" not in value:
            raise FileFormatError(f"{where} is no clip: expected a dictionary of coef and audio")
        if not isinstance(value["audio"], bytes):
            given = type(value["audio"]).__name__
            raise FileFormatError(f"{where}: audio is {given}, expected a flac file's bytes")
        arrays = {}
        for name, width in WIDTHS.items():
            array = np.asarray(value["coef"].get(name))
            if array.dtype.kind != "f" or array.shape != (length, width):
                raise FileFormatError(f"{where}: {name} has shape {array.shape}, not ({length}, {width})")
            arrays[name] = array.astype(np.float32)
        return arrays, value["audio"]

    def _first_shape(self, name: str) -> Float32[np.ndarray, "frames shape"]:
        return next(self._read_clips(self._keys[name]))[0]["shape"]

    def info(self, name: str) -> SequenceInfo:
        """By the video's metadata."""
        key = self._key(name)
        frames = len(range(0, self._frames(key), self.options.stride))
        person = _person(key)
        return SequenceInfo(person, 0, "", self.fps, frames, voice=person, name=name)

    def motion(self, name: str) -> MotionArrays:
        """Coefficients of the joined clips, and vertices where there is a head."""
        clips = [arrays for arrays, _ in self._read_clips(self._key(name))]
        joined = {
            key: np.concatenate([clip[key] for clip in clips])[:: self.options.stride] for key in WIDTHS
        }
        shape, expression = joined["shape"], joined["exp"]
        pose, jaw = joined["pose"][:, :3].copy(), joined["pose"][:, 3:].copy()
        vertices = flame_vertices(self._head, shape, expression, jaw)
        coefficients = {"shape": shape, "expression": expression, "jaw": jaw}
        return MotionArrays(vertices, pose, coefficients=coefficients)

    def audio(self, name: str) -> Waveform:
        """The sound of the joined clips, 16 kHz."""
        key = self._key(name)
        samples = [
            _decode(content, f"{self._folder / 'data.mdb'}, key {key}/{number:03d}")
            for number, (_, content) in enumerate(self._read_clips(key))
        ]
        return Waveform(np.concatenate(samples), SAMPLE_RATE)

    def coefficient_statistics(self, split: str = "train") -> dict[str, Float32[np.ndarray, " width"]]:
        """Moments for normalising, from stats_SPLIT.npz: shape_mean, shape_std, exp_mean and so on.

        Raises
        ------
        FileFormatError
            If the file is missing, damaged or of other widths.
        """
        path = self._folder / f"stats_{split}.npz"
        try:
            with np.load(path, allow_pickle=False) as archive:
                statistics = {key: archive[key].astype(np.float32) for key in archive.files}
        except OSError as error:
            raise FileFormatError(f"cannot read {path}: {error.strerror or error}") from error
        except (ValueError, KeyError, EOFError) as error:
            raise FileFormatError(f"{path} is no .npz of plain arrays: {error}") from error
        for name, width in WIDTHS.items():
            for moment in ("mean", "std"):
                if statistics.get(f"{name}_{moment}", np.zeros(0)).shape != (width,):
                    raise FileFormatError(f"{path} has no {name}_{moment} of {width} numbers")
        return statistics

    def check(self, progress: bool = False, workers: int = 1) -> list[str]:
        """As of every data set; also clips of no video, and keys.txt against the database."""
        return [*super().check(progress), *self._key_defects()]

    def _key_defects(self) -> Iterator[str]:
        for name, key in self._keys.items():
            try:
                expected = -(-self._frames(key) // self._clip_frames)
            except FileFormatError:
                continue  # told as a defect of the sequence
            if extra := [number for number in self._clips[key] if number >= expected]:
                yield f"{name}: {len(extra)} clips beyond its frames, the first is {key}/{extra[0]:03d}"
        path = self._folder / "keys.txt"
        if path.is_file():
            listed = set(_lines(path))
            if lost := sorted(listed - set(self._clips)):
                yield f"{path} names {len(lost)} videos that are not in data.mdb, such as {lost[0]}"
            if more := sorted(set(self._clips) - listed):
                yield f"{path} lacks {len(more)} videos of data.mdb, such as {more[0]}"


def _database(directory: Path) -> Path:
    inner = directory / "lmdb"
    return inner if (inner / "data.mdb").is_file() else directory


def _lmdb() -> Any:
    try:
        import lmdb
    except ImportError as error:
        raise DependencyError("lmdb", "data") from error
    return lmdb


def _person(key: str) -> str:
    return key.rpartition("/")[0].replace("/", "_")


def _lines(path: Path) -> list[str]:
    return [words[0] for line in path.read_text(encoding="utf-8").splitlines() if (words := line.split())]


def _decode(content: bytes, where: str) -> Float32[np.ndarray, " samples"]:
    try:
        samples, rate = soundfile.read(io.BytesIO(content), dtype="float32", always_2d=True)
    except soundfile.LibsndfileError as error:
        raise FileFormatError(f"{where}: audio is no whole flac file: {error}") from error
    if rate != SAMPLE_RATE:
        raise FileFormatError(f"{where}: audio has {rate} Hz, expected {SAMPLE_RATE}")
    return samples.mean(axis=1)
