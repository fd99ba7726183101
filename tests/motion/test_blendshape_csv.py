"""The two tables against what their makers write, character by character where it matters."""

import csv

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meshanim.errors import FileFormatError, OptionError
from meshanim.heads import load_head
from meshanim.motion.blendshape_csv import ARKIT_SHAPES, LIVE_LINK_COLUMNS
from meshanim.motion.blendshape_track import BlendshapeTrack

LIVE_LINK = (
    "Timecode,BlendShapeCount,EyeBlinkLeft,EyeLookDownLeft,EyeLookInLeft,EyeLookOutLeft,EyeLookUpLeft,"
    "EyeSquintLeft,EyeWideLeft,EyeBlinkRight,EyeLookDownRight,EyeLookInRight,EyeLookOutRight,EyeLookUpRight,"
    "EyeSquintRight,EyeWideRight,JawForward,JawRight,JawLeft,JawOpen,MouthClose,MouthFunnel,MouthPucker,"
    "MouthRight,MouthLeft,MouthSmileLeft,MouthSmileRight,MouthFrownLeft,MouthFrownRight,MouthDimpleLeft,"
    "MouthDimpleRight,MouthStretchLeft,MouthStretchRight,MouthRollLower,MouthRollUpper,MouthShrugLower,"
    "MouthShrugUpper,MouthPressLeft,MouthPressRight,MouthLowerDownLeft,MouthLowerDownRight,MouthUpperUpLeft,"
    "MouthUpperUpRight,BrowDownLeft,BrowDownRight,BrowInnerUp,BrowOuterUpLeft,BrowOuterUpRight,CheekPuff,"
    "CheekSquintLeft,CheekSquintRight,NoseSneerLeft,NoseSneerRight,TongueOut,HeadYaw,HeadPitch,HeadRoll,"
    "LeftEyeYaw,LeftEyePitch,LeftEyeRoll,RightEyeYaw,RightEyePitch,RightEyeRoll"
)
AUDIO2FACE = (
    ",timeCode,EyeBlinkLeft,EyeLookDownLeft,EyeLookInLeft,EyeLookOutLeft,EyeLookUpLeft,EyeSquintLeft,"
    "EyeWideLeft,EyeBlinkRight,EyeLookDownRight,EyeLookInRight,EyeLookOutRight,EyeLookUpRight,EyeSquintRight,"
    "EyeWideRight,JawForward,JawLeft,JawRight,JawOpen,MouthClose,MouthFunnel,MouthPucker,MouthLeft,"
    "MouthRight,MouthSmileLeft,MouthSmileRight,MouthFrownLeft,MouthFrownRight,MouthDimpleLeft,"
    "MouthDimpleRight,MouthStretchLeft,MouthStretchRight,MouthRollLower,MouthRollUpper,MouthShrugLower,"
    "MouthShrugUpper,MouthPressLeft,MouthPressRight,MouthLowerDownLeft,MouthLowerDownRight,MouthUpperUpLeft,"
    "MouthUpperUpRight,BrowDownLeft,BrowDownRight,BrowInnerUp,BrowOuterUpLeft,BrowOuterUpRight,CheekPuff,"
    "CheekSquintLeft,CheekSquintRight,NoseSneerLeft,NoseSneerRight,TongueOut"
)


def track(frames=75, fps=30.0, names=ARKIT_SHAPES, seed=0):
    rng = np.random.default_rng(seed)
    pose = rng.normal(0, 0.3, (frames, 3)).astype(np.float32)
    return BlendshapeTrack(tuple(names), rng.uniform(size=(frames, len(names))), fps, pose)


def rows_of(path):
    text = path.read_bytes().decode("ascii")
    assert "\r" not in text
    assert text.endswith("\n")
    return list(csv.reader(text.splitlines()))


def test_the_names_are_the_default_heads():
    assert set(ARKIT_SHAPES) == set(load_head("default").expression_names) - {"lipSeal"}
    assert len(ARKIT_SHAPES) == 52
    assert len(LIVE_LINK_COLUMNS) == 61


def test_audio2face_table(tmp_path):
    given = track(names=("mouthLeft", "jawOpen", "lipSeal"))
    given.save(tmp_path / "a.csv")
    header, *rows = rows_of(tmp_path / "a.csv")
    first, time, *shapes = AUDIO2FACE.split(",")
    assert header == [first, time, *(f"blendShapes.{name}" for name in (*shapes, "LipSeal"))]
    assert [row[0] for row in rows] == [str(frame) for frame in range(75)]
    assert rows[31][1] == repr(31 / 30)
    for name, column in zip(("MouthLeft", "JawOpen", "LipSeal"), given.weights.T):
        at = header.index(f"blendShapes.{name}")
        assert [float(row[at]) for row in rows] == column.tolist()
    assert {row[header.index("blendShapes.MouthRight")] for row in rows} == {"0.0"}


def test_live_link_table(tmp_path):
    given = track()
    given.save(tmp_path / "a.csv", "livelink")
    header, *rows = rows_of(tmp_path / "a.csv")
    assert header == LIVE_LINK.split(",")
    assert [rows[at][0] for at in (0, 1, 29, 30, 74)] == [
        "00:00:00:00.000",
        "00:00:00:02.000",
        "00:00:00:58.000",
        "00:00:01:00.000",
        "00:00:02:28.000",
    ]
    assert {row[1] for row in rows} == {"61"}
    for name, column in zip(given.names, given.weights.T):
        at = header.index(name[0].upper() + name[1:])
        assert [row[at] for row in rows] == [f"{value:.10f}" for value in column]


def test_live_link_rotations(tmp_path):
    """Nodding, turning left, tilting to the left shoulder, one at a time, then all at once."""
    names = ("eyeLookDownLeft", "eyeLookInLeft", "eyeLookOutRight")
    pose = np.array([[0.2, 0, 0], [0, 0.3, 0], [0, 0, 0.1], [0.2, 0.3, 0.1]], np.float32)
    weights = np.tile([0.5, 1.0, 1.0], (4, 1))
    BlendshapeTrack(names, weights, 24.0, pose).save(tmp_path / "a.csv", "livelink")
    with open(tmp_path / "a.csv", newline="") as text:
        rows = list(csv.DictReader(text))
    angles = np.array([[float(row[f"Head{axis}"]) for axis in ("Roll", "Yaw", "Pitch")] for row in rows])
    np.testing.assert_allclose(angles[:3], [[0, 0, 0.2], [0, -0.3, 0], [-0.1, 0, 0]], atol=1e-7)
    mirror = np.diag([-1.0, 1.0, 1.0])
    ours = mirror @ Rotation.from_euler("ZYX", angles).as_matrix() @ mirror
    np.testing.assert_allclose(ours, Rotation.from_rotvec(pose).as_matrix(), atol=1e-6)
    # Both eyes look down and to the subject's right: positive, as in recordings.
    for side, pitch in (("Left", 0.085), ("Right", 0.0)):
        assert float(rows[0][f"{side}EyePitch"]) == pytest.approx(pitch)
        assert float(rows[0][f"{side}EyeYaw"]) == pytest.approx(0.235)
        assert rows[0][f"{side}EyeRoll"] == "0.0000000000"


@pytest.mark.parametrize("fps", [24.0, 25.0, 30000 / 1001, 30.0, 59.94, 60.0, 12.5])
def test_live_link_round_trip(tmp_path, fps):
    given = track(200, fps)
    given.save(tmp_path / "a.csv", "livelink")
    back = BlendshapeTrack.load(tmp_path / "a.csv")
    assert back.fps == pytest.approx(fps, rel=1e-5)
    assert back.names == ARKIT_SHAPES
    np.testing.assert_allclose(back.weights, given.weights, atol=1e-10)
    np.testing.assert_allclose(back.pose, given.pose, atol=1e-6)


def recording(tmp_path, change=lambda rows: rows, name="take.csv", frames=90):
    """As the app writes one: the clock of the day, some jitter, a dropped frame; weights tell the time."""
    times = [k / 30 for k in range(frames) if k != 40]
    rows = [LIVE_LINK.split(",")]
    for time in times:
        ticks = round((time + 86399.0) * 60000) + (round(time * 30) % 3 - 1)  # jitter, past midnight
        frame, part = divmod(ticks, 1000)
        second, frame = divmod(frame, 60)
        clock = f"{second // 3600 % 24:02d}:{second // 60 % 60:02d}:{second % 60:02d}:{frame:02d}.{part:03d}"
        rows.append([clock, "61", *[f"{time / 3:.10f}"] * 61])
    path = tmp_path / name
    path.write_text("".join(",".join(row) + "\n" for row in change(rows)), encoding="utf-8")
    return path


def test_a_recording_with_jitter_and_a_dropped_frame(tmp_path):
    back = BlendshapeTrack.load(recording(tmp_path))
    assert len(back) == 90
    assert back.fps == 30
    np.testing.assert_allclose(back.weights[:, 0], np.arange(90) / 90, atol=1e-4)


def test_headers_of_other_versions_of_the_app(tmp_path):
    def older(rows):
        return [
            ["timecode", "BlendshapeCount", *(name[0].lower() + name[1:] for name in rows[0][2:])],
            *rows[1:],
        ]

    back = BlendshapeTrack.load(recording(tmp_path, older))
    assert back.names == ARKIT_SHAPES


def replaced(row, column, cell):
    def change(rows):
        rows[row][column] = cell
        return rows

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rows: [], "empty"),
        (lambda rows: rows[:1], "no frames"),
        (lambda rows: [row[:-1] for row in rows], "no columns RightEyeRoll"),
        (lambda rows: [[*row, "1"] for row in rows], "unknown columns 1"),
        (replaced(0, 5, "EyeLookSideways"), "unknown columns EyeLookSideways and no columns EyeLookOutLeft"),
        (replaced(0, 5, "EyeBlinkLeft"), "two columns EyeBlinkLeft"),
        (lambda rows: [*rows[:5], rows[5][:-1], *rows[6:]], "frame 5 has 62 cells"),
        (lambda rows: [*rows[:-1], rows[-1][:20]], "frame 89 has 20 cells"),
        (replaced(3, 7, "nan"), "EyeSquintLeft of frame 3 is not finite"),
        (replaced(3, 7, ""), "no number"),
        (replaced(3, 0, "10:11:12"), "no timecode"),
        (replaced(3, 0, "10:11:12:60.000"), "no timecode"),
        (lambda rows: [*rows[:4], rows[3], *rows[4:]], "do not rise at frame 4"),
    ],
)
def test_damaged_recordings(tmp_path, change, message):
    path = recording(tmp_path, change, "damaged.csv")
    with pytest.raises(FileFormatError, match=message) as caught:
        BlendshapeTrack.load(path)
    assert "damaged.csv" in str(caught.value)


def test_damaged_audio2face_tables(tmp_path):
    head = ",timeCode,blendShapes.A,blendShapes.B\n"
    for name, text, message in (
        ("none", None, "cannot read"),
        ("empty", "", "empty"),
        ("other", "a,b\n1,2\n", "neither"),
        ("rows", head, "no frames"),
        ("bare", ",timeCode\n0,0.0\n", "no columns blendShapes.NAME"),
        ("unknown", ",timeCode,blendShapes.A,brow\n0,0,1,1\n", "unknown columns brow"),
        ("cell", head + "0,0,1,x\n", "no number"),
        ("short", head + "0,0,1,1\n1,0.1,1\n", "frame 2 has 3 cells"),
        ("nan", head + "0,0,1,1\n1,0.1,nan,1\n", "blendShapes.A of frame 2"),
        ("time", head + "0,0.1,1,1\n1,0,1,1\n", "do not rise"),
        ("twice", ",timeCode,blendShapes.A,blendShapes.a\n0,0,1,1\n", "two columns a"),
        ("binary", b"\xff\xfe\x00timeCode", "cannot read"),
    ):
        path = tmp_path / f"{name}.csv"
        if isinstance(text, bytes):
            path.write_bytes(text)
        elif text is not None:
            path.write_text(text)
        with pytest.raises(FileFormatError, match=message) as caught:
            BlendshapeTrack.load(path)
        assert f"{name}.csv" in str(caught.value)


def test_what_live_link_cannot_hold(tmp_path):
    with pytest.raises(OptionError, match="lipSeal"):
        track(names=("jawOpen", "lipSeal")).save(tmp_path / "a.csv", "livelink")
    assert list(tmp_path.iterdir()) == []
