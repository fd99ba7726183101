"""ARKit weights as tables: Audio2Face-3D's animation_frames.csv and the recordings of Live Link Face."""

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import roma
import torch
from jaxtyping import Float

from meshanim.errors import FileFormatError, OptionError
from meshanim.files import written_whole
from meshanim.motion.idle import GAZE_RANGE

__all__ = [
    "ARKIT_SHAPES",
    "LIVE_LINK_COLUMNS",
    "CsvForm",
    "WeightTable",
    "read_weight_csv",
    "shape_key",
    "write_audio2face_csv",
    "write_live_link_csv",
]

CsvForm = Literal["audio2face", "livelink"]

_PAIRS = "Blink LookDown LookIn LookOut LookUp Squint Wide"
ARKIT_SHAPES: tuple[str, ...] = (
    *(f"eye{name}{side}" for side in ("Left", "Right") for name in _PAIRS.split()),
    *("jawForward", "jawLeft", "jawRight", "jawOpen"),
    *("mouthClose", "mouthFunnel", "mouthPucker", "mouthLeft", "mouthRight"),
    *(f"mouth{name}{side}" for name in ("Smile", "Frown", "Dimple", "Stretch") for side in ("Left", "Right")),
    *("mouthRollLower", "mouthRollUpper", "mouthShrugLower", "mouthShrugUpper"),
    *(f"mouth{name}{side}" for name in ("Press", "LowerDown", "UpperUp") for side in ("Left", "Right")),
    *("browDownLeft", "browDownRight", "browInnerUp", "browOuterUpLeft", "browOuterUpRight"),
    *("cheekPuff", "cheekSquintLeft", "cheekSquintRight", "noseSneerLeft", "noseSneerRight", "tongueOut"),
)
"""Apple's 52 shapes in the order of Audio2Face-3D's files."""

_ROTATIONS = tuple(
    f"{part}{axis}" for part in ("Head", "LeftEye", "RightEye") for axis in ("Yaw", "Pitch", "Roll")
)
_SWAPPED = {
    "jawLeft": "jawRight",
    "jawRight": "jawLeft",
    "mouthLeft": "mouthRight",
    "mouthRight": "mouthLeft",
}
LIVE_LINK_COLUMNS: tuple[str, ...] = (
    *(_SWAPPED.get(name, name)[:1].upper() + _SWAPPED.get(name, name)[1:] for name in ARKIT_SHAPES),
    *_ROTATIONS,
)
"""The 61 columns of a Live Link Face recording: it has right before left for jaw and mouth alone."""

TIME, PREFIX = "timeCode", "blendShapes."
TIMECODE, COUNT = "Timecode", "BlendShapeCount"
TICKS = 60
"""Frames that a second of Live Link Face's timecode has, whatever the rate of the recording."""
RATES = (24000 / 1001, 24.0, 25.0, 30000 / 1001, 30.0, 48.0, 50.0, 60000 / 1001, 60.0, 90.0, 100.0, 120.0)
GRID = 1e-4
"""Seconds that rows may be off a regular grid and still be taken as they are."""


class WeightTable(NamedTuple):
    """What a CSV holds: names (E,), weights (T, E), frames a second, head rotation (T, 3) in radians."""

    names: tuple[str, ...]
    weights: Float[np.ndarray, "frames shapes"]
    fps: float
    pose: Float[np.ndarray, "frames 3"]


def shape_key(name: str) -> str:
    """A name as ARKit writes it: files write JawOpen, ARKit jawOpen."""
    return name[:1].lower() + name[1:]


def _file_name(name: str) -> str:
    return name[:1].upper() + name[1:]


def write_audio2face_csv(
    path: str | Path, names: Sequence[str], weights: Float[np.ndarray, "frames shapes"], fps: float
) -> None:
    """Write the table that Audio2Face-3D's clients write as animation_frames.csv.

    A column without a name that counts the rows, `timeCode` in seconds, then `blendShapes.EyeBlinkLeft` and
    so on: all of `ARKIT_SHAPES`, zeros for those that are not given, then the others. Numbers have all their
    digits. There is no head rotation in it.

    Source: NVIDIA/Audio2Face-3D-Samples, `animation_frames.csv` by pandas' `json_normalize` and `to_csv`.
    """
    given = {shape_key(name): column for name, column in zip(names, np.asarray(weights, np.float64).T)}
    columns = list(dict.fromkeys((*ARKIT_SHAPES, *given)))
    table = np.stack([given.get(name, np.zeros(len(weights))) for name in columns], 1)
    rows = (
        (frame, repr(frame / fps), *(repr(value) for value in row))
        for frame, row in enumerate(table.tolist())
    )
    _write(path, ["", TIME, *(PREFIX + _file_name(name) for name in columns)], rows)


def write_live_link_csv(
    path: str | Path,
    names: Sequence[str],
    weights: Float[np.ndarray, "frames shapes"],
    fps: float,
    pose: Float[np.ndarray, "frames 3"],
) -> None:
    """Write a recording as the iPhone app Live Link Face does, for Unreal, Blender, Maya and MotionBuilder.

    `Timecode` (HH:MM:SS:FF.sss from 0, 60 FF a second), `BlendShapeCount` (61), `LIVE_LINK_COLUMNS` with ten
    decimals. Rotations are radians, R = Rz(roll) Ry(yaw) Rx(pitch) in a mirror image of our frame: pitch
    looks down, yaw turns to the subject's right, roll tilts towards its right shoulder. The eyes turn as the
    default head's do under the eyeLook weights.

    Raises
    ------
    OptionError
        If a shape with a weight other than zero is none of ARKit's.

    Notes
    -----
    Header, order, units and the composition of rotations are those of a public recording (7,839 frames, of
    which the eyes' angles fit this composition to 1e-7); the signs are those of its eyes beside its eyeLook
    weights. Its head did not turn: the head's signs are taken to be the eyes'.
    """
    given = {shape_key(name): column for name, column in zip(names, np.asarray(weights, np.float64).T)}
    lost = [name for name, column in given.items() if name not in ARKIT_SHAPES and column.any()]
    if lost:
        raise OptionError(
            f"Live Link Face has no column for {', '.join(lost)}; solve with ARKit's 52 only (--active)"
        )
    still = np.zeros(len(weights))

    def column(name: str) -> np.ndarray:
        return given.get(name, still)

    values = {_file_name(name): column(name) for name in ARKIT_SHAPES}
    angles = _angles(pose)
    values |= {"HeadRoll": angles[:, 0], "HeadYaw": angles[:, 1], "HeadPitch": angles[:, 2]}
    for side, right in (("Left", "In"), ("Right", "Out")):
        left = {"In": "Out", "Out": "In"}[right]
        pitch = GAZE_RANGE[0] * (column(f"eyeLookDown{side}") - column(f"eyeLookUp{side}"))
        yaw = GAZE_RANGE[1] * (column(f"eyeLook{right}{side}") - column(f"eyeLook{left}{side}"))
        values |= {f"{side}EyePitch": pitch, f"{side}EyeYaw": yaw, f"{side}EyeRoll": still}
    table = np.stack([values[name] for name in LIVE_LINK_COLUMNS], 1) + 0.0  # no -0.0000000000
    count = len(LIVE_LINK_COLUMNS)
    rows = (
        (_timecode(frame / fps), count, *(f"{value:.10f}" for value in row))
        for frame, row in enumerate(table)
    )
    _write(path, [TIMECODE, COUNT, *LIVE_LINK_COLUMNS], rows)


def _write(path: str | Path, header: Sequence[str], rows) -> None:
    with written_whole(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as text:
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)


def _timecode(seconds: float) -> str:
    frames, thousandths = divmod(round(seconds * TICKS * 1000), 1000)
    total, frame = divmod(frames, TICKS)
    minutes, second = divmod(total, 60)
    hours, minute = divmod(minutes, 60)
    return f"{hours % 24:02d}:{minute:02d}:{second:02d}:{frame:02d}.{thousandths:03d}"


_MIRROR = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)


def _angles(pose: Float[np.ndarray, "frames 3"]) -> Float[np.ndarray, "frames 3"]:
    """Roll, yaw, pitch of Live Link Face from axis-angles in our frame, radians."""
    turned = torch.from_numpy(np.asarray(pose, np.float64)) * _MIRROR
    if not len(turned):
        return np.zeros((0, 3))
    return roma.rotvec_to_euler("ZYX", turned).numpy()


def _pose(angles: Float[np.ndarray, "frames 3"]) -> Float[np.ndarray, "frames 3"]:
    """Axis-angles in our frame from roll, yaw, pitch."""
    columns = list(torch.from_numpy(np.ascontiguousarray(angles)).unbind(1))
    return (roma.euler_to_rotvec("ZYX", columns) * _MIRROR).numpy().astype(np.float32)


def read_weight_csv(path: str | Path) -> WeightTable:
    """Read either table; which it is, the header says.

    Names get a small first letter, as ARKit writes them. The frame rate is that of the times, 30 for a single
    frame. Rows of Live Link Face that are not at regular times (the app drops frames now and then) are
    interpolated onto regular ones; its angles of the eyes are left out, for the eyeLook weights say the same.

    Raises
    ------
    FileFormatError
        If the file is missing, empty or neither table; a column is unknown, missing or comes twice; a row has
        more or fewer cells than the header; a cell is no finite number; times do not rise.
    """
    path = Path(path)
    try:
        with open(path, newline="", encoding="utf-8-sig") as text:
            rows = [row for row in csv.reader(text) if row]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FileFormatError(f"cannot read {path}: {error}") from error
    if not rows:
        raise FileFormatError(f"{path} is empty: expected a header and a row a frame")
    header, rows = rows[0], rows[1:]
    live_link = header[0].lower() == TIMECODE.lower()
    if not live_link and TIME not in header:
        raise FileFormatError(
            f"{path} holds no weights: its header has neither {TIME} (Audio2Face-3D) nor {TIMECODE} "
            "(Live Link Face)"
        )
    if not rows:
        raise FileFormatError(f"{path} has a header and no frames")
    for number, row in enumerate(rows, start=1):
        if len(row) != len(header):
            raise FileFormatError(f"{path}: frame {number} has {len(row)} cells, the header {len(header)}")
    return _read_live_link(path, header, rows) if live_link else _read_audio2face(path, header, rows)


def _numbers(path: Path, header: list[str], rows: list[list[str]], columns: list[int]) -> np.ndarray:
    try:
        values = np.array([[float(row[at]) for at in columns] for row in rows])
    except ValueError as error:
        raise FileFormatError(f"{path} has a cell that is no number: {error}") from error
    if not np.isfinite(values).all():
        row, column = np.argwhere(~np.isfinite(values))[0]
        raise FileFormatError(f"{path}: {header[columns[column]]} of frame {row + 1} is not finite")
    return values


def _once(path: Path, names: Sequence[str]) -> None:
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise FileFormatError(f"{path} has two columns {', '.join(twice)}")


def _read_audio2face(path: Path, header: list[str], rows: list[list[str]]) -> WeightTable:
    columns = [at for at, name in enumerate(header) if name.startswith(PREFIX)]
    unknown = [name for name in header if name and name != TIME and not name.startswith(PREFIX)]
    if unknown:
        raise FileFormatError(f"{path} has unknown columns {', '.join(unknown)}; expected {PREFIX}NAME")
    if not columns:
        raise FileFormatError(f"{path} has no columns {PREFIX}NAME")
    names = tuple(shape_key(header[at].removeprefix(PREFIX)) for at in columns)
    _once(path, names)
    values = _numbers(path, header, rows, [header.index(TIME), *columns])
    times = values[:, 0]
    step = (times[-1] - times[0]) / (len(times) - 1) if len(times) > 1 else 1 / 30
    if not step > 0:
        raise FileFormatError(f"{path}: times do not rise")
    return WeightTable(names, values[:, 1:], _near_rate(1 / step), np.zeros((len(rows), 3), np.float32))


def _read_live_link(path: Path, header: list[str], rows: list[list[str]]) -> WeightTable:
    # The app has written BlendshapeCount and small first letters too.
    keys = [name[:1].upper() + name[1:] for name in header]
    keys = [COUNT if key.lower() == COUNT.lower() else key for key in keys]
    _once(path, keys[1:])
    expected = (COUNT, *LIVE_LINK_COLUMNS)
    unknown = [key for key in keys[1:] if key not in expected]
    missing = [name for name in expected if name not in keys]
    if unknown or missing:
        told = [f"unknown columns {', '.join(unknown)}"] if unknown else []
        told += [f"no columns {', '.join(missing)}"] if missing else []
        raise FileFormatError(f"{path} is no recording of Live Link Face: {' and '.join(told)}")
    times = np.array([_seconds(path, row[0]) for row in rows])
    times = times - times[0] + 86400.0 * np.cumsum(np.diff(times, prepend=times[0]) < -43200)
    if (np.diff(times) <= 0).any():
        raise FileFormatError(f"{path}: timecodes do not rise at frame {np.argmax(np.diff(times) <= 0) + 2}")
    shapes = [_file_name(name) for name in ARKIT_SHAPES]
    turned = ["HeadRoll", "HeadYaw", "HeadPitch"]
    values = _numbers(path, header, rows, [keys.index(name) for name in (*shapes, *turned)])
    fps = _recorded_rate(times)
    grid = np.arange(round(times[-1] * fps) + 1) / fps
    if len(grid) != len(times) or np.abs(grid - times).max() > GRID:
        values = np.stack([np.interp(grid, times, column) for column in values.T], 1)
    return WeightTable(ARKIT_SHAPES, values[:, :-3], fps, _pose(values[:, -3:]))


def _seconds(path: Path, timecode: str) -> float:
    parts = timecode.split(":")
    try:
        hours, minutes, seconds, frames = (float(part) for part in parts)
    except ValueError as error:
        raise FileFormatError(f"{path}: {timecode!r} is no timecode HH:MM:SS:FF.sss") from error
    if not (0 <= frames < TICKS and 0 <= seconds < 60 and 0 <= minutes < 60 and 0 <= hours < 25):
        raise FileFormatError(f"{path}: {timecode!r} is no timecode with {TICKS} frames a second")
    return hours * 3600 + minutes * 60 + seconds + frames / TICKS


def _recorded_rate(times: Float[np.ndarray, " frames"]) -> float:
    """Frames a second, dropped ones counted."""
    if len(times) < 2:
        return 30.0
    steps = np.diff(times)
    return _near_rate(float(np.round(steps / np.median(steps)).clip(1).sum() / times[-1]))


def _near_rate(fps: float) -> float:
    """The usual rate that a measured one stands for, if it is within 0.04 % of one."""
    nearest = min(RATES, key=lambda rate: abs(rate - fps))
    return nearest if math.isclose(nearest, fps, rel_tol=4e-4) else round(fps, 6)
