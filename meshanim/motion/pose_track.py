"""Head pose tracks: read from files, bridged, resampled, centred, measured. All on the rotation manifold."""

import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation, Slerp

from meshanim.errors import FileFormatError, OptionError, ShapeError

__all__ = [
    "PoseStatistics",
    "PoseTrack",
    "bridge_rotations",
    "center_rotations",
    "load_pose_track",
    "pose_statistics",
    "resample_rotations",
]

# Names under which trackers keep the head's rotation, and that of the neck, which comes after it.
ROTATIONS = ("pose", "rotation", "global_pose", "global_orient")
NECKS = ("neck", "neck_pose")


@dataclass(frozen=True)
class PoseTrack:
    """Head rotation over time.

    Parameters
    ----------
    rotation : (T, 3)
        Axis-angle, radians; frame i is at (i + 0.5) / fps seconds.
    fps : float
        Frames a second.
    """

    rotation: Float[np.ndarray, "frames 3"]
    fps: float

    def __post_init__(self):
        if not (np.isfinite(self.fps) and self.fps > 0):
            raise OptionError(f"fps must be positive, not {self.fps}")
        if self.rotation.ndim != 2 or self.rotation.shape[1] != 3 or not np.isfinite(self.rotation).all():
            raise ShapeError(f"rotations must be finite and (frames, 3), not {self.rotation.shape}")

    def __len__(self) -> int:
        return len(self.rotation)


def bridge_rotations(
    rotations: Float[np.ndarray, "frames 3"], largest_gap: int
) -> Float[np.ndarray, "frames 3"]:
    """Fill frames of NaN by the shortest turn between their neighbours; the ends hold.

    Raises
    ------
    OptionError
        If more than `largest_gap` frames in a row are missing.
    """
    known = np.isfinite(rotations).all(1)
    edges = np.flatnonzero(np.diff(np.concatenate([[True], known, [True]]).astype(np.int8)))
    for first, end in edges.reshape(-1, 2):
        if end - first > largest_gap:
            raise OptionError(
                f"frames {first} to {end - 1} of {len(rotations)} are missing; {largest_gap} can be bridged"
            )
    if not known.any():
        raise OptionError("every frame is missing")
    at = np.flatnonzero(known)
    return _interpolated(rotations[at], at.astype(float), np.arange(len(rotations), dtype=float))


def resample_rotations(
    rotations: Float[np.ndarray, "frames 3"], fps: float, new_fps: float, frames: int
) -> Float[np.ndarray, "new_frames 3"]:
    """The track at the middles of other frames, along the shortest turns; it holds beyond its end.

    Parameters
    ----------
    rotations : (T, 3)
        Axis-angle, radians.
    fps, new_fps : float
        Frames a second, before and after.
    frames : int
        Of the result.

    Raises
    ------
    OptionError
        If the track is empty or a rate is not positive.
    """
    if len(rotations) == 0 or not (fps > 0 and new_fps > 0) or frames < 0:
        raise OptionError(
            f"cannot resample {len(rotations)} frames from {fps} to {frames} frames at {new_fps}"
        )
    if fps == new_fps and frames <= len(rotations):
        return rotations[:frames]
    at = (np.arange(frames) + 0.5) / new_fps
    return _interpolated(rotations, (np.arange(len(rotations)) + 0.5) / fps, at)


def _interpolated(rotations: np.ndarray, times: np.ndarray, at: np.ndarray) -> np.ndarray:
    if len(rotations) == 1:
        return np.repeat(rotations, len(at), axis=0)
    turned = Slerp(times, Rotation.from_rotvec(rotations))(np.clip(at, times[0], times[-1]))
    return turned.as_rotvec().astype(rotations.dtype)


def center_rotations(rotations: Float[np.ndarray, "frames 3"]) -> Float[np.ndarray, "frames 3"]:
    """The track seen from its mean rotation: for cameras that do not look straight at the face."""
    if len(rotations) == 0:
        return rotations
    turns = Rotation.from_rotvec(rotations)
    return (turns.mean().inv() * turns).as_rotvec().astype(rotations.dtype)


def load_pose_track(path: str | Path, fps: float | None = None) -> PoseTrack:
    """Read tracked head poses.

    Parameters
    ----------
    path : path
        An npz with `pose`, `rotation`, `global_pose` or `global_orient` (T, 3), and `neck` or `neck_pose`
        (T, 3) if there is one, which turns on top of FLAME's global rotation (VHAP, NeRSemble's
        flame2023_tracking, `MeshSequence.save`). A .npy (T, 3). Or a folder with such an npz a frame, (1, 3)
        each, as VHAP exports `flame_param/`.
    fps : float, optional
        Frames a second, where the file does not say (`fps`).

    Raises
    ------
    FileFormatError
        If the file holds none of these, or no rate is known.
    """
    path = Path(path)
    if path.is_dir():
        names = sorted(path.glob("*.npz"))
        if not names:
            raise FileFormatError(f"{path} holds no npz files of tracked poses")
        parts = [_read_rotation(name) for name in names]
        rotation, rate = np.concatenate([part for part, _ in parts]), parts[0][1]
    else:
        rotation, rate = _read_rotation(path)
    rate = fps if fps is not None else rate
    if rate is None:
        raise FileFormatError(f"{path} does not say its frame rate: give fps")
    if not np.isfinite(rotation).all():
        raise FileFormatError(f"{path} holds rotations that are not finite")
    return PoseTrack(rotation, float(rate))


def _read_rotation(path: Path) -> tuple[np.ndarray, float | None]:
    try:
        loaded = np.load(path, allow_pickle=False)
        arrays: Mapping[str, np.ndarray]
        if isinstance(loaded, np.ndarray):
            arrays = {"pose": loaded}
        else:
            with loaded:
                wanted = {*ROTATIONS, *NECKS, "fps"}
                arrays = {name: loaded[name] for name in loaded.files if name in wanted}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise FileFormatError(f"{path} cannot be read as poses: {error}") from error
    found = [name for name in ROTATIONS if name in arrays]
    if not found:
        raise FileFormatError(f"{path} has none of {', '.join(ROTATIONS)}")
    rotation = _rows(arrays[found[0]], path, found[0])
    for name in NECKS:
        if name in arrays:
            neck = _rows(arrays[name], path, name)
            if len(neck) != len(rotation):
                raise FileFormatError(f"{path}: {len(rotation)} rotations but {len(neck)} of {name}")
            rotation = (Rotation.from_rotvec(rotation) * Rotation.from_rotvec(neck)).as_rotvec()
            break
    return rotation, float(arrays["fps"]) if "fps" in arrays else None


def _rows(values: np.ndarray, path: Path, name: str) -> np.ndarray:
    if values.ndim == 3 and values.shape[0] == 1:
        values = values[0]
    if values.ndim != 2 or values.shape[1] != 3 or not np.issubdtype(values.dtype, np.floating):
        raise FileFormatError(f"{path}: {name} is {values.dtype} {values.shape}, expected float (frames, 3)")
    return values.astype(np.float64)


@dataclass(frozen=True)
class PoseStatistics:
    """How much heads move.

    Parameters
    ----------
    edges : (B + 1,)
        Radians, of the histogram's bins.
    counts : (B,)
        Frames whose rotation vector has a modulus in the bin (GAVA, Fig. 4).
    mean, deviation, largest : float
        Of the modulus, radians.
    speed : float
        Mean angular speed, radians a second.
    """

    edges: Float[np.ndarray, " edges"]
    counts: Int[np.ndarray, " bins"]
    mean: float
    deviation: float
    largest: float
    speed: float


def pose_statistics(tracks: Sequence[PoseTrack], bins: int = 40) -> PoseStatistics:
    """Histogram and moments of the modulus of all rotation vectors, and the mean speed.

    Raises
    ------
    OptionError
        If there is no frame.
    """
    moduli = [np.linalg.norm(track.rotation, axis=1) for track in tracks]
    if not sum(map(len, moduli)):
        raise OptionError("there are no poses to measure")
    modulus = np.concatenate(moduli)
    speeds = [
        (turns[:-1].inv() * turns[1:]).magnitude() * track.fps
        for track in tracks
        if len(track) > 1
        for turns in [Rotation.from_rotvec(track.rotation)]
    ]
    counts, edges = np.histogram(modulus, bins, (0.0, max(float(modulus.max()), 1e-6)))
    return PoseStatistics(
        edges,
        counts,
        float(modulus.mean()),
        float(modulus.std()),
        float(modulus.max()),
        float(np.concatenate(speeds).mean()) if speeds else 0.0,
    )
