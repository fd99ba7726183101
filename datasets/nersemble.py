"""The NeRSemble benchmark as it is downloaded: videos, calibration and FLAME tracking of one participant.

    DIR/calibration/camera_params.json                  world_2_cam and intrinsics by serial number, OpenCV
    DIR/sequences/SEQ/images/cam_SERIAL.mp4             background removed
    DIR/sequences/SEQ/alpha_maps/cam_SERIAL.mp4
    DIR/sequences/SEQ/tracking/flame2023_tracking_v2.npz   mono_flame_avatar alone; flame2023_tracking.npz
                                                        where no sequence has the second version

DIR is mono_flame_avatar/ID or nvs/ID. What the benchmark keeps to itself (the test sequences' pictures, the
held-out cameras' ones) has no views: `hidden_views` gives the cameras and parameters to render for a
submission.

The tracking turns and moves FLAME about the world's origin (intrinsic x, y, z angles) and scales it, after
everything else. Here the head stays at the origin, unscaled: each view's camera has that motion. Pictures in
mp4 are decoded from the nearest key frame on, which is slow in random order; `meshanim data convert DIR
TARGET --format folder` unpacks them. Names as in the benchmark's own toolkit.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import av
import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from meshanim.datasets.capture import Capture, Picture, View, check_camera
from meshanim.errors import FileFormatError
from meshanim.files import read_json, read_npz
from meshanim.heads import HeadParameters

__all__ = [
    "MONO_HELD_OUT_CAMERAS",
    "MONO_TEST_SEQUENCES",
    "MONO_TRAIN_CAMERA",
    "NVS_HELD_OUT_CAMERAS",
    "detect",
    "hidden_views",
    "read_capture",
]

MONO_TRAIN_CAMERA = "222200037"
MONO_HELD_OUT_CAMERAS = ("222200046", "220700191", "222200039")
"""Left, centre, right."""
MONO_TEST_SEQUENCES = (
    "FREE",
    "EMO-1-shout+laugh",
    "SEN-09-frown_events_bad",
    "SEN-10-port_strong_smokey",
)
NVS_HELD_OUT_CAMERAS = ("222200046", "222200037", "222200039")
TRACKINGS = ("flame2023_tracking_v2.npz", "flame2023_tracking.npz")
"""Newest first; the second version (2026) is what submissions are judged by."""
COLUMNS = {"expression": 100, "rotation": 3, "translation": 3, "jaw": 3, "neck": 3, "eyes": 6}


def detect(directory: Path) -> bool:
    """Whether the folder has this layout."""
    return (directory / "calibration" / "camera_params.json").is_file() and (directory / "sequences").is_dir()


@dataclass(frozen=True)
class _Calibration:
    poses: Mapping[str, Float[np.ndarray, "4 4"]]
    intrinsics: Mapping[str, Float[np.ndarray, "3 3"]]


@dataclass(frozen=True)
class _Sequence:
    """One sequence of a participant, its rows in the capture's parameters starting at `start`."""

    name: str
    folder: Path
    frames: int
    start: int
    tracking: Mapping[str, np.ndarray] | None

    def motion(self) -> Float[np.ndarray, "frames 4 4"]:
        """From FLAME's own frame to the benchmark's world, divided by the tracking's scale."""
        motion = np.tile(np.eye(4), (self.frames, 1, 1))
        if self.tracking is not None:
            motion[:, :3, :3] = Rotation.from_euler("XYZ", self.tracking["rotation"]).as_matrix()
            motion[:, :3, 3] = self.tracking["translation"] / self.scale
        return motion

    @property
    def scale(self) -> float:
        return 1.0 if self.tracking is None else float(np.ravel(self.tracking["scale"])[0])

    def pose(self, world_to_camera: np.ndarray, motion: np.ndarray) -> Float[np.ndarray, "4 4"]:
        """World to camera of one frame, the head's motion taken in. Pictures do not know a common scale."""
        smaller = world_to_camera.copy()
        smaller[:3, 3] /= self.scale
        return smaller @ motion

    def video(self, kind: str, serial: str) -> Path:
        return self.folder / kind / f"cam_{serial}.mp4"

    def cameras(self) -> list[str]:
        videos = sorted((self.folder / "images").glob("cam_*.mp4"))
        return [path.stem.removeprefix("cam_") for path in videos]


def read_capture(directory: Path) -> Capture:
    """Open a participant's folder.

    `train` is what is there of the training sequences and cameras; `test` is what is there of the rest: with
    the public download, nothing.

    Raises
    ------
    FileFormatError
        If a file is missing or damaged, or there are no videos.
    """
    calibration, sequences = _read(directory)
    tracked = any(sequence.tracking is not None for sequence in sequences)
    views: list[View] = []
    splits: dict[str, list[int]] = {"train": [], "test": []}
    videos: dict[str, tuple[Path, Path, int, tuple[int, int]]] = {}
    for sequence in sequences:
        motion = sequence.motion()
        for serial in sequence.cameras():
            images, masks = (sequence.video(kind, serial) for kind in ("images", "alpha_maps"))
            frames, size = _measured(images)
            if frames != sequence.frames:
                raise FileFormatError(
                    f"{images} has {frames} frames, the others of {sequence.name} {sequence.frames}"
                )
            where = f"{directory / 'calibration' / 'camera_params.json'}"
            if serial not in calibration.poses or serial not in calibration.intrinsics:
                raise FileFormatError(f"{where} lacks camera {serial} of {images}")
            split = "train" if _is_training(sequence.name, serial, tracked) else "test"
            for frame in range(frames):
                name = f"{sequence.name}/{frame:05d}_{serial}"
                videos[name] = (images, masks, frame, size)
                splits[split].append(len(views))
                pose = sequence.pose(calibration.poses[serial], motion[frame])
                intrinsics = calibration.intrinsics[serial]
                views.append(View(name, sequence.start + frame, serial, pose, intrinsics, *size))
    if not views:
        raise FileFormatError(f"{directory / 'sequences'} has no images/cam_SERIAL.mp4")
    present = {masks: masks.is_file() for masks in sorted({masks for _, masks, _, _ in videos.values()})}
    if len(set(present.values())) > 1:
        absent = next(path for path, there in present.items() if not there)
        raise FileFormatError(f"{absent} is missing; other videos have alpha maps")
    return Capture(
        name=directory.resolve().name,
        kind="nersemble",
        directory=directory,
        views=tuple(views),
        splits={split: tuple(indices) for split, indices in splits.items()},
        read=_Videos(videos),
        parameters=_parameters(sequences) if tracked else None,
        timesteps=tuple(f"{s.name}/{frame:05d}" for s in sequences for frame in range(s.frames)),
    )


def hidden_views(directory: str | Path, width: int = 512, height: int = 512) -> tuple[View, ...]:
    """What the monocular benchmark wants rendered: its test sequences from all four cameras.

    Timesteps are rows of the parameters of `read_capture` on the same folder.

    Parameters
    ----------
    directory : path
        mono_flame_avatar/ID.
    width, height : int
        Pixels of the pictures.

    Raises
    ------
    FileFormatError
        If a file is missing or damaged.
    """
    calibration, sequences = _read(Path(directory))
    views = []
    for sequence in sequences:
        if sequence.name not in MONO_TEST_SEQUENCES or sequence.tracking is None:
            continue
        motion = sequence.motion()
        for serial in (MONO_TRAIN_CAMERA, *MONO_HELD_OUT_CAMERAS):
            if serial not in calibration.poses:
                raise FileFormatError(f"{directory}/calibration/camera_params.json lacks camera {serial}")
            for frame in range(sequence.frames):
                pose = sequence.pose(calibration.poses[serial], motion[frame])
                name = f"{sequence.name}/{frame:05d}_{serial}"
                intrinsics = calibration.intrinsics[serial]
                views.append(View(name, sequence.start + frame, serial, pose, intrinsics, width, height))
    return tuple(views)


def _is_training(sequence: str, serial: str, tracked: bool) -> bool:
    if tracked:
        return serial == MONO_TRAIN_CAMERA and sequence not in MONO_TEST_SEQUENCES
    return serial not in NVS_HELD_OUT_CAMERAS


def _read(directory: Path) -> tuple[_Calibration, list[_Sequence]]:
    path = directory / "calibration" / "camera_params.json"
    content = read_json(path)
    try:
        poses = {serial: np.array(pose, np.float64) for serial, pose in content["world_2_cam"].items()}
        listed: Any = content["intrinsics"]
        if not isinstance(listed, dict):  # the raw data set has one matrix for all
            listed = dict.fromkeys(poses, listed)
        intrinsics = {serial: np.array(matrix, np.float64) for serial, matrix in listed.items()}
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise FileFormatError(f"{path} is no calibration of NeRSemble: {error}") from error
    for serial, pose in poses.items():
        if serial in intrinsics:
            check_camera(f"{path}: camera {serial}", pose, intrinsics[serial])
    sequences: list[_Sequence] = []
    start = 0
    folders = sorted(path for path in (directory / "sequences").iterdir() if path.is_dir())
    tracking = TRACKINGS[-1]
    for name in reversed(TRACKINGS):  # versions of different identities are not to be mixed
        if any((folder / "tracking" / name).is_file() for folder in folders):
            tracking = name
    for folder in folders:
        sequence = _read_sequence(folder, start, tracking)
        sequences.append(sequence)
        start += sequence.frames
    return _Calibration(poses, intrinsics), sequences


def _read_sequence(folder: Path, start: int, tracking: str) -> _Sequence:
    path = folder / "tracking" / tracking
    if not path.is_file():
        videos = sorted((folder / "images").glob("cam_*.mp4"))
        if not videos:
            raise FileFormatError(f"{folder} has neither tracking/{tracking} nor images/cam_SERIAL.mp4")
        return _Sequence(folder.name, folder, _measured(videos[0])[0], start, None)
    arrays = read_npz(path)
    missing = [name for name in ("shape", "scale", *COLUMNS) if name not in arrays]
    if missing:
        raise FileFormatError(f"{path} lacks {', '.join(missing)}")
    frames = len(arrays["expression"])
    for name, columns in COLUMNS.items():
        if arrays[name].shape != (frames, columns):
            raise FileFormatError(f"{path}: {name} is {arrays[name].shape}, expected ({frames}, {columns})")
    for name in ("shape", "scale", *COLUMNS):
        if not np.isfinite(arrays[name]).all():
            raise FileFormatError(f"{path}: {name} has numbers that are not finite")
    if arrays["shape"].shape != (1, 300) or arrays["scale"].size != 1 or not arrays["scale"].min() > 0:
        raise FileFormatError(
            f"{path}: shape is {arrays['shape'].shape} and scale {arrays['scale'].tolist()}; expected "
            "(1, 300) and one positive number"
        )
    return _Sequence(folder.name, folder, frames, start, arrays)


def _parameters(sequences: Sequence[_Sequence]) -> HeadParameters:
    """Rows of all sequences, one after the other; turning and moving the head is the cameras' part."""
    untracked = [sequence.name for sequence in sequences if sequence.tracking is None]
    if untracked:
        raise FileFormatError(f"{sequences[0].folder.parent}: {untracked[0]} has no tracking like the others")
    tracks = [(s.tracking or {}, s.frames) for s in sequences]
    arrays = {
        name: np.concatenate([track[name] for track, _ in tracks])
        for name in ("expression", "jaw", "neck", "eyes")
    }
    arrays["shape"] = np.concatenate([np.repeat(track["shape"], frames, axis=0) for track, frames in tracks])
    return HeadParameters(
        **{name: torch.from_numpy(array.astype(np.float32)) for name, array in arrays.items()}
    )


def _measured(path: Path) -> tuple[int, tuple[int, int]]:
    """Number of frames and (width, height) of a video."""
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            count = stream.frames or sum(packet.pts is not None for packet in container.demux(stream))
            return count, (stream.width, stream.height)
    except (av.FFmpegError, OSError, IndexError) as error:
        raise FileFormatError(f"cannot read {path}: {error}") from error


@dataclass
class _Video:
    """One video that is open, and the frame that it gives next."""

    path: Path
    next: int = 0
    last: tuple[int, UInt8[np.ndarray, "height width 3"]] | None = None
    frames: Iterator[Any] = field(default_factory=lambda: iter(()))

    def __post_init__(self):
        try:
            self._container = av.open(str(self.path))
        except (av.FFmpegError, OSError) as error:
            raise FileFormatError(f"cannot read {self.path}: {error}") from error
        self._stream = self._container.streams.video[0]
        rate, base = self._stream.average_rate, self._stream.time_base
        if not rate or not base:
            raise FileFormatError(f"{self.path} has no frame rate")
        self._step = 1 / rate / base
        self._start = self._stream.start_time or 0
        self.frames = self._container.decode(self._stream)

    def frame(self, index: int) -> UInt8[np.ndarray, "height width 3"]:
        """A frame by number, decoded on from where the last call stopped, or from the key frame before."""
        if self.last is not None and self.last[0] == index:
            return self.last[1]
        try:
            if not self.next <= index < self.next + 32:
                self._seek(index)
            for decoded in self.frames:
                position = self._position(decoded)
                if position == index:
                    self.next = index + 1
                    self.last = (index, decoded.to_ndarray(format="rgb24"))
                    return self.last[1]
        except (av.FFmpegError, OSError) as error:
            raise FileFormatError(f"{self.path}: frame {index}: {error}") from error
        raise FileFormatError(f"{self.path} ends before frame {index}")

    def _seek(self, index: int) -> None:
        at = self._start + round(index * self._step)
        self._container.seek(at, stream=self._stream, backward=True)
        self.frames, self.next = self._container.decode(self._stream), index

    def _position(self, decoded) -> int:
        return round((decoded.pts - self._start) / self._step)


@dataclass(frozen=True)
class _Videos:
    """Pictures by name; keeps the videos that were read last open."""

    places: Mapping[str, tuple[Path, Path, int, tuple[int, int]]]
    opened: dict[Path, _Video] = field(default_factory=dict)

    def __call__(self, name: str) -> Picture:
        images, masks, frame, size = self.places[name]
        image = self._frame(images, frame, size)
        mask = np.ascontiguousarray(self._frame(masks, frame, size)[..., 0]) if masks.is_file() else None
        return Picture(image, mask)

    def _frame(self, path: Path, index: int, size: tuple[int, int]) -> np.ndarray:
        if path not in self.opened:
            if len(self.opened) >= 64:
                self.opened.pop(next(iter(self.opened)))
            self.opened[path] = _Video(path)
        array = self.opened[path].frame(index)
        if array.shape[1::-1] != size:
            raise FileFormatError(
                f"{path} has {array.shape[1]} x {array.shape[0]} pixels, the images {size[0]} x {size[1]}"
            )
        return array

    def __reduce__(self):  # videos do not cross to another process open
        return _Videos, (self.places,)
