"""Cameras of a video: the head stays in the picture, at one distance; files of captures are read."""

import json

import numpy as np
import pytest
import torch

from meshanim.errors import FileFormatError, OptionError
from meshanim.gaussians.camera_paths import camera_path, read_camera_path

HEAD = np.random.default_rng(0).uniform(-1, 1, (400, 3)) * [0.08, 0.14, 0.1] + [0.01, 1.6, 0.02]


def pixels(cameras, points: np.ndarray) -> torch.Tensor:
    """(T, V, 2)"""
    homogeneous = torch.from_numpy(np.concatenate([points, np.ones((len(points), 1))], 1)).float()
    camera = homogeneous @ cameras.world_to_camera[:, 0].mT
    image = camera[..., :3] @ cameras.intrinsics[:, 0].mT
    return image[..., :2] / image[..., 2:]


@pytest.mark.parametrize("name", ["front", "orbit"])
@pytest.mark.parametrize(("width", "height"), [(64, 64), (96, 64)])
def test_the_head_is_in_every_picture(name, width, height):
    cameras = camera_path(name, HEAD, 40, 5.0, width, height)
    assert cameras.world_to_camera.shape == (40, 1, 4, 4)
    seen = pixels(cameras, HEAD)
    assert seen.min() > 0
    assert seen[..., 0].max() < width
    assert seen[..., 1].max() < height
    # Its height fills most of the picture.
    assert np.ptp(seen[0, :, 1].numpy()) > 0.7 * height


def test_the_orbit_swings_at_one_distance_and_comes_back():
    cameras = camera_path("orbit", HEAD, 41, 5.0, 64, 64)
    offsets = cameras.positions[:, 0].numpy() - (HEAD.min(0) + HEAD.max(0)) / 2
    distance = np.linalg.norm(offsets, axis=1)
    np.testing.assert_allclose(distance, distance[0], rtol=1e-5)
    azimuth = np.degrees(np.arctan2(offsets[:, 0], offsets[:, 2]))
    assert azimuth[10] == pytest.approx(40, abs=0.01)
    assert azimuth[30] == pytest.approx(-40, abs=0.01)
    np.testing.assert_allclose(offsets[40], offsets[0], atol=1e-5)
    assert offsets[5, 1] == pytest.approx(distance[0] * np.sin(np.radians(8)), rel=1e-4)


def test_the_front_stands_still_without_copies():
    cameras = camera_path("front", HEAD, 1000, 30.0, 64, 64)
    assert cameras.world_to_camera.stride(0) == 0


def written(path, count: int) -> dict:
    cameras = camera_path("orbit", HEAD, count, 5.0, 80, 64)
    entries = {
        f"{index:05d}": {
            "world_to_camera": cameras.world_to_camera[index, 0].tolist(),
            "intrinsics": cameras.intrinsics[index, 0].tolist(),
            "width": 80,
            "height": 64,
        }
        for index in range(count)
    }
    path.write_text(json.dumps({"cameras": entries}))
    return entries


def test_files_with_one_camera_one_a_frame_or_one_by_name(tmp_path):
    path = tmp_path / "cameras.json"
    entries = written(path, 7)
    read = read_camera_path(path, 7)
    assert (read.width, read.height, read.world_to_camera.shape) == (80, 64, (7, 1, 4, 4))
    named = read_camera_path(f"{path}:00003", 20)
    assert named.world_to_camera.shape == (20, 1, 4, 4)
    torch.testing.assert_close(named.world_to_camera[11], read.world_to_camera[3])
    path.write_text(json.dumps({"cameras": {"only": entries["00003"]}}))
    torch.testing.assert_close(read_camera_path(path, 20).world_to_camera[5], read.world_to_camera[3])


@pytest.mark.parametrize(
    ("change", "error"),
    [
        (lambda text: text[:-3], "cannot read"),
        (lambda text: "[]", "holds no cameras"),
        (lambda text: '{"cameras": {}}', "holds no cameras"),
        (lambda text: '{"views": {}}', "no 'cameras'"),
        (lambda text: text.replace("intrinsics", "K", 1), "no 'intrinsics'"),
        (lambda text: text.replace('"width": 80', '"width": 81', 1), "one image size"),
        (lambda text: text.replace('"height": 64', '"height": "tall"', 1), "holds no cameras"),
        (lambda text: text.replace("0.0, 0.0, 0.0, 1.0", "0.0, 0.0, 1.0", 1), "holds no cameras"),
    ],
)
def test_damaged_files_are_named(tmp_path, change, error):
    path = tmp_path / "cameras.json"
    written(path, 3)
    path.write_text(change(path.read_text()))
    with pytest.raises(FileFormatError, match=error):
        read_camera_path(path, 3)


def test_what_does_not_fit_is_named(tmp_path):
    path = tmp_path / "cameras.json"
    written(path, 3)
    with pytest.raises(FileFormatError, match="3 cameras for 4 frames"):
        read_camera_path(path, 4)
    with pytest.raises(FileFormatError, match="no 'left'"):
        read_camera_path(f"{path}:left", 4)
    with pytest.raises(FileFormatError, match="cannot read"):
        read_camera_path(tmp_path / "none.json", 4)
    with pytest.raises(OptionError, match="front, orbit or a"):
        camera_path("above", HEAD, 4, 30.0, 64, 64)
