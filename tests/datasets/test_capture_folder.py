"""The plain multi-view folder: exact reading, reduced pictures, one camera, moving cameras, damage."""

import json
import shutil

import numpy as np
import pytest
import small_captures as small
import torch
from PIL import Image

from meshanim.cli import main
from meshanim.datasets import open_capture
from meshanim.errors import FileFormatError, OptionError, ShapeError


@pytest.fixture
def folder(tmp_path):
    small.plain_folder(tmp_path / "ana")
    return tmp_path / "ana"


def test_everything_is_as_written(folder):
    capture = open_capture(folder)
    assert (capture.kind, capture.name, capture.head_name) == ("folder", "ana", "default")
    assert [view.name for view in capture.views][:3] == ["00000_a", "00000_b", "00001_a"]
    assert capture.region_names == ("background", "skin", "eyes")
    assert capture.background == (0.5, 0.5, 0.5)
    assert capture.split("train") == (0, 2)
    assert capture.split("novel_view") == (1,)
    for index, view in enumerate(capture.views):
        number = "ab".index(view.camera)
        picture = capture[index]
        assert np.array_equal(picture.image, small.image(view.timestep, number))
        assert np.array_equal(picture.mask, small.mask(view.timestep, number))
        assert np.array_equal(picture.regions, small.mask(view.timestep, number) % 3)
        assert np.allclose(view.world_to_camera, small.pose(number))
    written = small.parameters()
    chosen = capture.at([2, 0])
    assert np.array_equal(chosen.jaw, written["jaw"][[2, 0]])
    assert np.array_equal(chosen.shape, written["shape"])
    poses, intrinsics, width, height = capture.cameras(capture.split("train"))
    assert poses.shape == (2, 4, 4)
    assert intrinsics.shape == (2, 3, 3)
    assert (width, height) == (12, 8)


def test_half_the_size_averages_areas_and_points_project_alike(folder):
    full, half = open_capture(folder), open_capture(folder, scale=0.5)
    picture = half[3]
    blocks = full[3].image.reshape(4, 2, 6, 2, 3).astype(float).mean((1, 3))
    assert np.abs(picture.image - blocks).max() <= 0.5
    assert picture.mask.shape == picture.regions.shape == (4, 6)
    point = np.array([0.05, -0.02, 0.03, 1.0])
    seen = []
    for capture in (full, half):
        view = capture.views[3]
        pixel = view.intrinsics @ (view.world_to_camera @ point)[:3]
        seen.append(pixel[:2] / pixel[2] / (view.width, view.height))
    assert np.allclose(*seen)


def test_a_third_rounds_each_side_for_itself(folder):
    view = open_capture(folder, scale=0.3).views[0]
    assert (view.width, view.height) == (4, 2)
    assert np.allclose(view.intrinsics[0] * 3, small.INTRINSICS[0])
    assert np.allclose(view.intrinsics[1] * 4, small.INTRINSICS[1])
    for scale in (0, 1.5):
        with pytest.raises(OptionError, match="scale"):
            open_capture(folder, scale=scale)


def test_one_camera_without_masks_regions_splits_or_tracking(tmp_path):
    small.plain_folder(tmp_path, cameras=("a",), regions=False, masks=False, splits=False)
    for path in sorted((tmp_path / "images").iterdir()):
        path.rename(path.with_name(path.name.replace("_a", "")))
    capture = open_capture(tmp_path)
    assert [view.name for view in capture.views] == ["00000", "00001", "00002"]
    assert capture.split("train") == (0, 1, 2)
    assert capture[0].mask is None
    assert capture[0].regions is None
    (tmp_path / "head.npz").unlink()
    untracked = open_capture(tmp_path)
    assert untracked.parameters is None
    assert len(untracked) == 3
    with pytest.raises(OptionError, match="no parameters"):
        untracked.at(0)
    with pytest.raises(OptionError, match="which head"):
        _ = capture.head


def test_opacity_of_the_picture_is_the_mask_where_there_is_no_other(tmp_path):
    small.plain_folder(tmp_path, masks=False)
    plane = small.mask(0, 0)
    rgba = np.concatenate([small.image(0, 0), plane[..., None]], axis=2)
    Image.fromarray(rgba).save(tmp_path / "images" / "00000_a.png")
    picture = open_capture(tmp_path)[0]
    assert np.array_equal(picture.mask, plane)
    assert np.array_equal(picture.image, small.image(0, 0))


def test_a_camera_that_moves_is_named_by_the_picture(folder):
    content = json.loads((folder / "cameras.json").read_text())
    moved = {**content["cameras"]["a"], "world_to_camera": small.pose(7).tolist()}
    content["cameras"]["00001_a"] = moved
    (folder / "cameras.json").write_text(json.dumps(content))
    capture = open_capture(folder)
    poses = {view.name: view.world_to_camera for view in capture.views}
    assert np.allclose(poses["00001_a"], small.pose(7))
    assert np.allclose(poses["00002_a"], small.pose(0))


def test_timesteps_by_number(folder):
    arrays = small.parameters()
    np.savez(folder / "head.npz", **arrays, timesteps=np.array([2, 0, 1]))
    capture = open_capture(folder)
    row = next(view.timestep for view in capture.views if view.name == "00002_a")
    assert np.array_equal(capture.at(row).jaw, arrays["jaw"][:1])


def test_copies_are_equal(folder, tmp_path):
    assert main(["data", "convert", str(folder), str(tmp_path / "copy"), "--format", "folder"]) == 0
    old, new = open_capture(folder), open_capture(tmp_path / "copy")
    assert [view.name for view in old.views] == [view.name for view in new.views]
    assert old.splits == new.splits
    assert old.region_names == new.region_names
    for index in range(len(old)):
        assert np.array_equal(old[index].image, new[index].image)
        assert np.array_equal(old[index].regions, new[index].regions)
    assert torch.equal(old.parameters.eyes, new.parameters.eyes)


def corrupt_json(path):
    path.write_text(path.read_text()[:-20])


def change_camera(path, **values):
    content = json.loads(path.read_text())
    content["cameras"]["b"].update(values)
    path.write_text(json.dumps(content))


OPENING = {
    "no pictures": (lambda d: [p.unlink() for p in (d / "images").iterdir()], "images has no pictures"),
    "a cut cameras.json": (lambda d: corrupt_json(d / "cameras.json"), r"cameras\.json"),
    "a cut capture.json": (lambda d: corrupt_json(d / "capture.json"), r"capture\.json"),
    "a cut head.npz": (
        lambda d: (d / "head.npz").write_bytes((d / "head.npz").read_bytes()[:-300]),
        r"head\.npz",
    ),
    "NaN in a pose": (
        lambda d: change_camera(d / "cameras.json", world_to_camera=[[float("nan")] * 4] * 4),
        "camera b has numbers that are not finite",
    ),
    "no rotation": (
        lambda d: change_camera(d / "cameras.json", world_to_camera=np.diag([2, 1, 1, 1]).tolist()),
        "camera b: its pose is no rotation",
    ),
    "no focal length": (
        lambda d: change_camera(d / "cameras.json", intrinsics=np.zeros((3, 3)).tolist()),
        "camera b has no intrinsics",
    ),
    "a ragged matrix": (lambda d: change_camera(d / "cameras.json", intrinsics=[[1], [2, 3]]), "camera b"),
    "a picture of no camera": (
        lambda d: shutil.copy(d / "images" / "00000_a.png", d / "images" / "00000_c.png"),
        "no camera 'c'",
    ),
    "a picture of no timestep": (
        lambda d: shutil.copy(d / "images" / "00000_a.png", d / "images" / "00007_a.png"),
        "no parameters for timestep 7",
    ),
    "a name without number": (
        lambda d: shutil.copy(d / "images" / "00000_a.png", d / "images" / "first_a.png"),
        "does not start with a timestep",
    ),
    "a mask less": (lambda d: (d / "masks" / "00001_b.png").unlink(), "masks lacks 1 of 6"),
    "a picture less than a split has": (
        lambda d: (d / "images" / "00001_a.png").unlink(),
        "split train names 1 pictures",
    ),
    "NaN in a parameter": (
        lambda d: np.savez(d / "head.npz", jaw=np.full((3, 3), np.nan)),
        "jaw has numbers that are not finite",
    ),
    "too few rows": (
        lambda d: np.savez(d / "head.npz", jaw=np.zeros((3, 3)), eyes=np.zeros((2, 6))),
        "eyes is",
    ),
    "another width": (lambda d: np.savez(d / "head.npz", eyes=np.zeros((3, 3))), "eyes is"),
    "an unknown name": (lambda d: np.savez(d / "head.npz", expr=np.zeros((3, 3))), "holds expr"),
}


@pytest.mark.parametrize("damage", OPENING)
def test_damage_is_named_on_opening(folder, damage):
    harm, message = OPENING[damage]
    harm(folder)
    with pytest.raises(FileFormatError, match=message):
        open_capture(folder)


def test_damaged_pictures_are_named_by_check_and_when_read(folder, capsys):
    path = folder / "images" / "00000_b.png"
    path.write_bytes(path.read_bytes()[:80])
    small.write_png(folder / "images" / "00001_a.png", np.zeros((4, 4, 3), np.uint8))
    (folder / "masks" / "00002_b.png").write_bytes(b"no picture")
    capture = open_capture(folder)
    with pytest.raises(FileFormatError, match=r"00000_b\.png"):
        capture[1]
    with pytest.raises(FileFormatError, match=r"00001_a\.png has 4 x 4 pixels, its camera 12 x 8"):
        capture[2]
    assert main(["data", "check", str(folder)]) == 1
    said = capsys.readouterr()
    assert "3 defects" in said.out
    assert all(name in said.err for name in ("00000_b.png", "00001_a.png", "masks/00002_b.png"))


def test_other_errors_of_opening(folder, tmp_path):
    with pytest.raises(FileFormatError, match="holds 1 captures: choose one"):
        open_capture(tmp_path)
    with pytest.raises(FileFormatError, match="looked for folder"):
        open_capture(folder / "images")
    with pytest.raises(FileFormatError, match="is no folder"):
        open_capture(tmp_path / "none")
    with pytest.raises(OptionError, match="folder, vhap, nersemble"):
        open_capture(folder, "colmap")
    with pytest.raises(OptionError, match="there are train, novel_view"):
        open_capture(folder).split("test")


def test_pictures_of_two_sizes_have_no_common_cameras(folder):
    change_camera(folder / "cameras.json", width=6, height=4)
    with pytest.raises(ShapeError, match="2 sizes"):
        open_capture(folder).cameras()


def test_info(folder, capsys, tmp_path):
    assert main(["data", "info", str(folder), "--json", str(tmp_path / "info.json")]) == 0
    assert "6 pictures of 12 x 8 (2 train, 1 novel_view)" in capsys.readouterr().out
    about = json.loads((tmp_path / "info.json").read_text())
    assert about["camera_positions"] == 2
    assert about["timesteps"] == 3
    assert about["tracked"]
