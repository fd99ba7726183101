"""VHAP's exports: OpenGL cameras, parameters by file, combined sequences, splits, damage, writing."""

import json

import numpy as np
import pytest
import small_captures as small
import torch

from meshanim.cli import main
from meshanim.datasets import open_capture
from meshanim.datasets.vhap import write_vhap
from meshanim.errors import FileFormatError, OptionError, ShapeError


def test_a_single_export(tmp_path):
    small.vhap_export(tmp_path)
    capture = open_capture(tmp_path)
    assert (capture.kind, len(capture)) == ("vhap", 9)
    assert capture.splits == {"train": tuple(range(9))}
    written = small.parameters(300, 100)
    for index, view in enumerate(capture.views):
        camera = int(view.camera)
        picture = capture[index]
        assert np.array_equal(picture.image, small.image(view.timestep, camera))
        assert np.array_equal(picture.mask, small.mask(view.timestep, camera))
        assert np.allclose(view.world_to_camera, small.pose(camera))
        assert np.allclose(view.intrinsics, small.INTRINSICS)
    params = capture.parameters
    assert params.shape.shape == (1, 300)
    for name in ("expression", "rotation", "neck", "jaw", "eyes", "translation"):
        assert np.array_equal(getattr(params, name), written[name]), name
    assert capture.static_offset.shape == (5, 3)


def test_combined_sequences_and_their_splits(tmp_path):
    """Nine pictures of each of three sequences: camera 2 is `val`, the third sequence `test`."""
    small.combined_vhap(tmp_path)
    capture = open_capture(tmp_path / "UNION")
    assert {name: len(rows) for name, rows in capture.splits.items()} == {"train": 12, "val": 6, "test": 9}
    assert capture.timesteps == tuple(f"{number:05d}" for number in range(9))
    for split, rows in capture.splits.items():
        for index in rows:
            view = capture.views[index]
            assert (view.camera == "02") == (split == "val") or split == "test"
            assert (view.timestep >= 6) == (split == "test")
            assert np.array_equal(capture[index].image, small.image(view.timestep, int(view.camera)))
    moved = capture.parameters.translation[3:6] - capture.parameters.translation[:3]
    assert torch.allclose(moved, torch.full((3, 3), 3.0), atol=1e-6)


def test_sequences_that_were_tracked_apart_have_the_first_ones_identity(tmp_path):
    """Each sequence of a union was tracked for itself; GaussianAvatars takes the identity of timestep 0."""
    small.combined_vhap(tmp_path)
    with np.load(tmp_path / "074_EMO-1" / "flame_param" / "00000.npz") as first:
        shape, offset = first["shape"], first["static_offset"]
    for number, sequence in enumerate(("074_EXP-2", "074_FREE"), start=1):
        for path in (tmp_path / sequence / "flame_param").iterdir():
            with np.load(path) as archive:
                arrays = dict(archive)
            arrays["shape"] = arrays["shape"] + np.float32(number)
            arrays["static_offset"] = arrays["static_offset"] * np.float32(2)
            np.savez(path, **arrays)
    capture = open_capture(tmp_path / "UNION")
    assert np.array_equal(capture.parameters.shape, shape[None])
    assert np.array_equal(capture.static_offset, offset[0])


def test_a_monocular_union_has_no_validation_camera(tmp_path):
    small.combined_vhap(tmp_path)
    path = tmp_path / "UNION" / "transforms_val.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"frames": [], "camera_indices": []}))
    assert {name: len(rows) for name, rows in open_capture(path.parent).splits.items()} == {
        "train": 12, "val": 0, "test": 9,
    }  # fmt: skip


def test_shared_and_angular_intrinsics(tmp_path):
    content = small.vhap_export(tmp_path)
    for frame in content["frames"]:
        for key in ("cx", "cy", "fl_x", "fl_y", "w", "h"):
            del frame[key]
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    assert np.allclose(open_capture(tmp_path).views[0].intrinsics, small.INTRINSICS)
    for key in ("fl_x", "fl_y", "cx", "cy"):
        del content[key]
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    intrinsics = open_capture(tmp_path).views[0].intrinsics
    assert np.allclose(np.diag(intrinsics), np.diag(small.INTRINSICS))
    assert np.allclose(intrinsics[:2, 2], (small.WIDTH / 2, small.HEIGHT / 2))


def test_offsets_of_another_head(tmp_path):
    small.vhap_export(tmp_path)
    with pytest.raises(OptionError, match="which head"):
        _ = open_capture(tmp_path).head
    with pytest.raises(ShapeError, match="offsets of 5 vertices"):
        _ = open_capture(tmp_path, head="default").head


@pytest.fixture
def tracked(tmp_path):
    """A plain folder on the default head, with an offset."""
    folder = tmp_path / "plain"
    small.plain_folder(folder, cameras=("00", "03"), splits=False)
    names = {"train": [0, 1], "novel_view": [2], "novel_expression": [3], "novel_expression_known_view": [4]}
    capture = open_capture(folder, head="default")
    splits = {split: [capture.views[index].name for index in rows] for split, rows in names.items()}
    (folder / "capture.json").write_text(json.dumps({"head": "default", "splits": splits}))
    offset = np.zeros((capture.head.n_vertices, 3), np.float32)
    offset[7] = (0.001, 0.002, 0.003)
    np.savez(folder / "offset.npz", static_offset=offset)
    return open_capture(folder)


def test_what_is_written_reads_back(tracked, tmp_path):
    target = write_vhap(tracked, tmp_path / "export")
    with np.load(target / "flame_param" / "00001.npz") as arrays:
        shapes = {name: arrays[name].shape for name in arrays.files}
        assert all(arrays[name].dtype == np.float32 for name in arrays.files)
    count = tracked.head.n_vertices
    assert shapes == {
        "translation": (1, 3), "rotation": (1, 3), "neck_pose": (1, 3), "jaw_pose": (1, 3),
        "eyes_pose": (1, 6), "shape": (len(tracked.head.shape_names),),
        "expr": (1, len(tracked.head.expression_names)),
        "static_offset": (1, count, 3),
    }  # fmt: skip
    with np.load(target / "canonical_flame_param.npz") as arrays:
        assert np.allclose(arrays["jaw_pose"], [[0.3, 0, 0]])
        assert not arrays["expr"].any()
    again = open_capture(target)
    assert {name: len(rows) for name, rows in again.splits.items()} == {"train": 2, "val": 1, "test": 2}
    by_name = {view.name: index for index, view in enumerate(tracked.views)}
    for index, view in enumerate(again.views):
        old = tracked.views[by_name[view.name]]
        assert np.allclose(view.world_to_camera, old.world_to_camera, atol=1e-12)
        assert np.array_equal(again[index].mask, tracked[by_name[view.name]].mask)
        assert np.array_equal(again[index].image, tracked[by_name[view.name]].image)
        assert torch.allclose(again.vertices(view.timestep), tracked.vertices(old.timestep), atol=1e-6)


def test_exported_names_are_those_of_vhap(tracked, tmp_path):
    content = small.vhap_export(tmp_path / "theirs")
    write_vhap(tracked, tmp_path / "ours")
    ours = json.loads((tmp_path / "ours" / "transforms.json").read_text())
    assert set(ours["frames"][0]) == set(content["frames"][0])
    assert set(ours) == {*content, "head"}
    theirs = {path.relative_to(tmp_path / "theirs").parts[0] for path in (tmp_path / "theirs").rglob("*.*")}
    assert theirs - {path.name for path in (tmp_path / "ours").iterdir()} == {
        "transforms_backup.json", "transforms_backup_flame.json",
    }  # fmt: skip


def test_half_size_from_the_command_line(tracked, tmp_path):
    words = [str(tracked.directory), str(tmp_path / "half"), "--format", "vhap", "--image-scale", "0.5"]
    assert main(["data", "convert", *words]) == 0
    view = open_capture(tmp_path / "half").views[0]
    assert (view.width, view.height) == (6, 4)
    assert np.allclose(view.intrinsics[:2], small.INTRINSICS[:2] / 2)


def test_an_untracked_capture_cannot_be_written(tracked, tmp_path):
    (tracked.directory / "head.npz").unlink()
    (tracked.directory / "offset.npz").unlink()
    with pytest.raises(OptionError, match="no parameters"):
        write_vhap(open_capture(tracked.directory), tmp_path / "export")


def change(directory, **values):
    path = directory / "transforms.json"
    content = json.loads(path.read_text())
    content["frames"][4].update(values)
    path.write_text(json.dumps(content))


def drop(directory, key):
    """Remove it from a frame and from what all frames share."""
    path = directory / "transforms.json"
    content = json.loads(path.read_text())
    content.pop(key, None)
    content["frames"][4].pop(key)
    path.write_text(json.dumps(content))


def change_parameters(directory, **values):
    path = directory / "flame_param" / "00001.npz"
    with np.load(path) as archive:
        arrays = dict(archive)
    np.savez(path, **{key: value for key, value in {**arrays, **values}.items() if value is not None})


def cut(path, count):
    path.write_bytes(path.read_bytes()[:-count])


DAMAGE = {
    "a cut table": (lambda d: cut(d / "transforms.json", 30), r"transforms\.json"),
    "no frames": (lambda d: (d / "transforms.json").write_text("{}"), "holds no frames"),
    "an empty table": (lambda d: (d / "transforms.json").write_text('{"frames": []}'), "no frames"),
    "NaN in a pose": (
        lambda d: change(d, transform_matrix=[[float("nan")] * 4] * 4),
        "00001_01.png: transform_matrix is no finite",
    ),
    "a singular pose": (lambda d: change(d, transform_matrix=np.zeros((4, 4)).tolist()), "no inverse"),
    "no timestep": (lambda d: change(d, timestep_index=None), "no timestep_index"),
    "a negative focal length": (lambda d: change(d, fl_x=-1.0), "no intrinsics"),
    "a picture twice": (lambda d: change(d, file_path="images/00000_00.png"), "twice"),
    "parameters cut": (lambda d: cut(d / "flame_param" / "00001.npz", 100), r"00001\.npz"),
    "parameters gone": (lambda d: (d / "flame_param" / "00001.npz").unlink(), r"00001\.npz"),
    "no expression": (lambda d: change_parameters(d, expr=None), "lacks expr"),
    "NaN in the jaw": (lambda d: change_parameters(d, jaw_pose=np.full((1, 3), np.nan)), "jaw_pose"),
    "another length": (lambda d: change_parameters(d, expr=np.zeros((1, 50))), "expr has 50"),
    "another offset": (
        lambda d: change_parameters(d, static_offset=np.zeros((1, 5, 3))),
        "not that of the other",
    ),
    "another shape": (lambda d: change_parameters(d, shape=np.zeros(300)), "not that of the other"),
    "an offset of two frames": (
        lambda d: change_parameters(d, static_offset=np.zeros((2, 5, 3))),
        r"static_offset is \(2, 5, 3\)",
    ),
    "no camera": (lambda d: drop(d, "transform_matrix"), "00001_01.png lacks 'transform_matrix'"),
    "no size": (lambda d: drop(d, "w"), "00001_01.png lacks 'w'"),
    "one mask less": (lambda d: drop(d, "fg_mask_path"), "others, such as 00001_01, none"),
    "parameters of some": (lambda d: drop(d, "flame_param_path"), "some frames have flame_param_path"),
    "a timestep too many": (lambda d: change(d, timestep_index=7), "timestep 7, which timestep_indices"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damage_is_named_on_opening(tmp_path, damage):
    small.vhap_export(tmp_path)
    harm, message = DAMAGE[damage]
    harm(tmp_path)
    with pytest.raises(FileFormatError, match=message):
        open_capture(tmp_path)


def test_pictures_gone_are_named_when_read(tmp_path):
    small.vhap_export(tmp_path)
    (tmp_path / "images" / "00000_01.png").unlink()
    (tmp_path / "fg_masks" / "00000_02.png").unlink()
    small.write_png(tmp_path / "images" / "00001_00.png", np.zeros((2, 2, 3), np.uint8))
    cut(tmp_path / "images" / "00001_01.png", 120)
    cut(tmp_path / "fg_masks" / "00001_02.png", 120)
    defects = open_capture(tmp_path).check()
    assert len(defects) == 5
    expected = ("images/00000_01.png", "fg_masks/00000_02.png", "2 x 2 pixels")
    expected += ("images/00001_01.png", "fg_masks/00001_02.png")
    assert all(part in line for part, line in zip(expected, defects))
