"""The NeRSemble benchmark: videos frame by frame, tracking by Euler angles and scale, splits, damage."""

import json
import shutil

import av
import numpy as np
import pytest
import small_captures as small
from PIL import Image
from scipy.spatial.transform import Rotation

from meshanim.datasets import open_capture
from meshanim.datasets.nersemble import MONO_TRAIN_CAMERA, hidden_views
from meshanim.errors import FileFormatError

WIDTH, HEIGHT, FRAMES, SCALE = 32, 16, 40, 1.7
SERIALS = ("222200037", "222200046", "220700191", "222200039", "222200042")


def shade(frame: int, kind: int = 0) -> int:
    """The grey of a frame's picture: videos keep that, not the single pixels."""
    return (frame * 5 + kind * 90 + 20) % 236 + 10


def write_video(path, frames: int, kind: int = 0) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=24, options={"crf": "14", "g": "12"})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for frame in range(frames):
            grey = Image.new("RGB", (WIDTH, HEIGHT), (shade(frame, kind),) * 3)
            container.mux(stream.encode(av.VideoFrame.from_image(grey)))
        container.mux(stream.encode())


def tracking(seed: int, frames: int = FRAMES) -> dict[str, np.ndarray]:
    generator = np.random.default_rng(seed)
    columns = {"expression": 100, "rotation": 3, "translation": 3, "jaw": 3, "neck": 3, "eyes": 6}
    arrays = {name: generator.normal(size=(frames, size)) * 0.3 for name, size in columns.items()}
    return {
        **{name: array.astype(np.float32) for name, array in arrays.items()},
        "rotation_matrices": Rotation.from_euler("XYZ", arrays["rotation"]).as_matrix().astype(np.float32),
        "frames": np.arange(frames),
        "shape": generator.normal(size=(1, 300)).astype(np.float32),
        "scale": np.full((1, 1), SCALE, np.float32),
    }


def write_calibration(directory) -> None:
    (directory / "calibration").mkdir(parents=True)
    content = {
        "world_2_cam": {serial: small.pose(index).tolist() for index, serial in enumerate(SERIALS)},
        "intrinsics": {serial: small.INTRINSICS.tolist() for serial in SERIALS},
    }
    (directory / "calibration" / "camera_params.json").write_text(json.dumps(content))


@pytest.fixture(scope="module")
def mono_once(tmp_path_factory):
    """Two training sequences of one camera, and a test sequence with its tracking alone."""
    directory = tmp_path_factory.mktemp("benchmark") / "mono_flame_avatar" / "393"
    write_calibration(directory)
    for seed, name in enumerate(("EXP-1-head", "FREE", "SEN-01-cramp_small_danger")):
        folder = directory / "sequences" / name
        (folder / "tracking").mkdir(parents=True)
        np.savez(folder / "tracking" / "flame2023_tracking.npz", **tracking(seed))
        if name != "FREE":
            write_video(folder / "images" / f"cam_{MONO_TRAIN_CAMERA}.mp4", FRAMES)
            write_video(folder / "alpha_maps" / f"cam_{MONO_TRAIN_CAMERA}.mp4", FRAMES, 1)
    return directory


@pytest.fixture
def mono(mono_once, tmp_path):
    return shutil.copytree(mono_once, tmp_path / "393")


def test_splits_and_parameters(mono):
    capture = open_capture(mono)
    assert (capture.kind, capture.name) == ("nersemble", "393")
    assert {name: len(rows) for name, rows in capture.splits.items()} == {"train": 2 * FRAMES, "test": 0}
    assert len(capture.timesteps) == 3 * FRAMES  # those of the test sequence too
    view = capture.views[FRAMES + 7]
    assert view.name == f"SEN-01-cramp_small_danger/00007_{MONO_TRAIN_CAMERA}"
    written = tracking(2)
    chosen = capture.at(view.timestep)
    assert np.array_equal(chosen.expression[0], written["expression"][7])
    assert np.array_equal(chosen.eyes[0], written["eyes"][7])
    assert np.array_equal(chosen.shape[0], written["shape"][0])
    assert chosen.rotation is None
    assert chosen.translation is None


def test_the_second_version_of_the_tracking_goes_before_the_first(mono):
    """Submissions are judged by it; sequences of different versions are not mixed."""
    folders = sorted((mono / "sequences").iterdir())
    first = open_capture(mono).parameters.expression
    for seed, folder in enumerate(folders):
        np.savez(folder / "tracking" / "flame2023_tracking_v2.npz", **tracking(seed + 10))
    second = open_capture(mono).parameters.expression
    assert np.array_equal(second[:FRAMES], tracking(10)["expression"])
    for folder in folders:
        (folder / "tracking" / "flame2023_tracking.npz").unlink()
    assert np.array_equal(open_capture(mono).parameters.expression, second)
    assert not np.array_equal(first, second)
    folder = folders[2] / "tracking"
    (folder / "flame2023_tracking_v2.npz").rename(folder / "flame2023_tracking.npz")
    with pytest.raises(FileFormatError, match="has no tracking like the others"):
        open_capture(mono)


def test_the_tracking_s_matrices_are_what_its_angles_are_read_as(mono):
    capture, written = open_capture(mono), tracking(0)
    turned = np.linalg.inv(small.pose(0)) @ capture.views[5].world_to_camera
    np.testing.assert_allclose(turned[:3, :3], written["rotation_matrices"][5], atol=1e-6)


def test_points_of_the_tracked_head_project_as_the_benchmark_does_it(mono):
    """world = scale R x + t by intrinsic XYZ angles, then the calibrated camera."""
    capture, written = open_capture(mono), tracking(0)
    point = np.array([0.03, -0.05, 0.08])
    for frame in (0, 11):
        view = capture.views[frame]
        rotation = Rotation.from_euler("XYZ", written["rotation"][frame]).as_matrix()
        world = SCALE * rotation @ point + written["translation"][frame]
        camera = small.pose(0) @ np.append(world, 1)
        expected = small.INTRINSICS @ camera[:3]
        seen = view.intrinsics @ (view.world_to_camera @ np.append(point, 1))[:3]
        np.testing.assert_allclose(seen[:2] / seen[2], expected[:2] / expected[2], rtol=1e-6)


def test_frames_in_any_order(mono):
    capture = open_capture(mono)
    order = np.random.default_rng(0).permutation(2 * FRAMES)[:40]
    for index in (*range(5), *order.tolist(), 39, 38, 0):
        frame = int(capture.views[index].name.split("/")[1][:5])
        picture = capture[index]
        assert picture.image.shape == (HEIGHT, WIDTH, 3)
        assert abs(picture.image.mean() - shade(frame)) < 2.5, frame
        assert abs(picture.mask.mean() - shade(frame, 1)) < 2.5, frame


def test_what_is_to_be_submitted(mono):
    views = hidden_views(mono)
    assert len(views) == 4 * FRAMES
    assert {view.camera for view in views} == {"222200037", "222200046", "220700191", "222200039"}
    capture = open_capture(mono)
    assert {capture.timesteps[view.timestep].split("/")[0] for view in views} == {"FREE"}
    assert np.array_equal(capture.at(views[3].timestep).jaw[0], tracking(1)["jaw"][3])


def test_unpacked_to_a_plain_folder(mono, tmp_path):
    from meshanim.datasets.capture_folder import write_capture

    shutil.rmtree(mono / "sequences" / "SEN-01-cramp_small_danger")
    capture = open_capture(mono)
    again = open_capture(write_capture(capture, tmp_path / "plain"))
    assert len(again) == FRAMES
    for index in (0, 17):
        assert np.array_equal(again[index].image, capture[index].image)
        assert np.allclose(again.views[index].world_to_camera, capture.views[index].world_to_camera)
    assert np.array_equal(again.parameters.neck, capture.parameters.neck)


def test_novel_views_are_untracked(tmp_path):
    directory = tmp_path / "388"
    write_calibration(directory)
    for serial in SERIALS[-2:]:
        write_video(directory / "sequences" / "GLASSES" / "images" / f"cam_{serial}.mp4", 5)
    capture = open_capture(directory)
    assert capture.parameters is None
    assert {name: len(rows) for name, rows in capture.splits.items()} == {"train": 5, "test": 5}
    assert all(np.allclose(capture.views[i].world_to_camera, small.pose(4)) for i in capture.split("train"))
    assert capture[0].mask is None


def spoil(path, **values):
    with np.load(path) as archive:
        arrays = dict(archive)
    np.savez(path, **{name: value for name, value in {**arrays, **values}.items() if value is not None})


def spoil_pose(path):
    content = json.loads(path.read_text())
    content["world_2_cam"]["222200037"][1][2] = float("nan")
    path.write_text(json.dumps(content))


def spoil_intrinsics(path):
    content = json.loads(path.read_text())
    del content["intrinsics"]["222200037"]
    path.write_text(json.dumps(content))


TRACK = "sequences/EXP-1-head/tracking/flame2023_tracking.npz"
CALIBRATION = "calibration/camera_params.json"
VIDEO = f"sequences/EXP-1-head/images/cam_{MONO_TRAIN_CAMERA}.mp4"
DAMAGE = {
    "a cut calibration": (
        lambda d: (d / CALIBRATION).write_text((d / CALIBRATION).read_text()[:-9]),
        r"camera_params\.json",
    ),
    "another calibration": (lambda d: (d / CALIBRATION).write_text("[1]"), "no calibration"),
    "NaN in a pose": (
        lambda d: spoil_pose(d / CALIBRATION),
        "camera 222200037 has numbers that are not finite",
    ),
    "a camera less": (
        lambda d: (d / CALIBRATION).write_text((d / CALIBRATION).read_text().replace(SERIALS[0], "1")),
        "lacks camera 222200037",
    ),
    "no scale": (lambda d: spoil(d / TRACK, scale=None), "lacks scale"),
    "NaN in tracking": (lambda d: spoil(d / TRACK, jaw=np.full((FRAMES, 3), np.nan)), "jaw has numbers"),
    "rows too few": (lambda d: spoil(d / TRACK, eyes=np.zeros((3, 6))), r"eyes is \(3, 6\)"),
    "a cut tracking": (
        lambda d: (d / TRACK).write_bytes((d / TRACK).read_bytes()[:-500]),
        r"flame2023_tracking\.npz",
    ),
    "an untracked sequence": (lambda d: (d / TRACK).unlink(), "EXP-1-head has no tracking"),
    "a video of other length": (lambda d: write_video(d / VIDEO, 7), "has 7 frames"),
    "a video cut short": (
        lambda d: (d / VIDEO).write_bytes((d / VIDEO).read_bytes()[:-300]),
        r"cam_222200037\.mp4",
    ),
    "one alpha map less": (
        lambda d: (d / VIDEO.replace("images", "alpha_maps")).unlink(),
        "is missing; other videos have alpha maps",
    ),
    "no intrinsics": (lambda d: spoil_intrinsics(d / CALIBRATION), "lacks camera 222200037"),
    "no video": (lambda d: (d / VIDEO).write_bytes(b"none"), r"cam_222200037\.mp4"),
    "an empty sequence": (lambda d: (d / "sequences" / "X").mkdir(), "has neither tracking"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damage_is_named_on_opening(mono, damage):
    harm, message = DAMAGE[damage]
    harm(mono)
    with pytest.raises(FileFormatError, match=message):
        open_capture(mono)


def test_a_mask_video_that_ends_early_is_named(mono):
    path = mono / VIDEO.replace("images", "alpha_maps")
    write_video(path, FRAMES - 3, 1)
    with pytest.raises(FileFormatError, match=f"ends before frame {FRAMES - 1}"):
        open_capture(mono)[FRAMES - 1]


def test_masks_of_another_size_are_named(mono):
    capture = open_capture(mono)
    with av.open(str(mono / VIDEO.replace("images", "alpha_maps")), "w") as container:
        stream = container.add_stream("libx264", rate=24)
        stream.width, stream.height, stream.pix_fmt = 16, 16, "yuv420p"
        container.mux(stream.encode(av.VideoFrame.from_image(Image.new("RGB", (16, 16)))))
        container.mux(stream.encode())
    with pytest.raises(FileFormatError, match="16 x 16 pixels, the images 32 x 16"):
        capture[0]
