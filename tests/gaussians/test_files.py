"""Gaussians in files: what was written comes back, others read it too, and damage is named."""

import gzip
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from meshanim.errors import FileFormatError, OptionError, ShapeError
from meshanim.gaussians import Gaussians, bind, read_gaussians, write_gaussians
from meshanim.gaussians.ply import read_bound_ply, read_ply, write_ply
from meshanim.gaussians.spz import _four_of, _smallest_three, read_spz
from meshanim.geometry import TriangleMesh

DATA = Path(__file__).parent / "data"
MESH = TriangleMesh(
    [[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
)


def cloud(count: int, sh_degree: int | None = 0, seed: int = 0) -> Gaussians:
    """Gaussians of a head's size, none of whose values a format clips."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> torch.Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator)

    sh = None
    if sh_degree is not None:
        sh = uniform(-0.9, 0.9, count, (sh_degree + 1) ** 2, 3)
    return Gaussians(
        uniform(-0.3, 0.3, count, 3),
        torch.randn(count, 4, generator=generator),
        uniform(-8, -3, count, 3).exp(),
        uniform(0.01, 0.99, count),
        uniform(0, 1, count, 3) if sh is None else None,
        sh,
    )


def same_turns(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    """Absolute cosines between quaternions: 1 where they are one rotation."""
    unit = torch.nn.functional.normalize
    return (unit(one, dim=-1) * unit(other, dim=-1)).sum(1).abs()


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_ply_comes_back_as_it_was(tmp_path, sh_degree):
    written = cloud(50, sh_degree)
    write_gaussians(tmp_path / "a.ply", written)
    back = read_gaussians(tmp_path / "a.ply")
    assert torch.equal(back.means, written.means)
    assert torch.equal(back.sh, written.sh)
    assert (same_turns(back.quaternions, written.quaternions) > 1 - 1e-6).all()
    torch.testing.assert_close(back.scales, written.scales, rtol=1e-5, atol=0)
    torch.testing.assert_close(back.opacities, written.opacities, rtol=0, atol=1e-6)
    write_gaussians(tmp_path / "b.ply", back)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.ply", "b.ply"]


def test_ply_has_the_layout_of_gaussian_splatting(tmp_path):
    written = cloud(7, 1)
    write_ply(tmp_path / "a.ply", written)
    raw = (tmp_path / "a.ply").read_bytes()
    head, body = raw.split(b"end_header\n", 1)
    lines = head.decode().split("\n")
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 7"]
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{index}" for index in range(9)]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert lines[3:-1] == [f"property float {name}" for name in names]
    rows = np.frombuffer(body, "<f4").reshape(7, len(names))
    column = dict(zip(names, rows.T))
    sh = written.sh.numpy()
    np.testing.assert_array_equal(column["f_dc_1"], sh[:, 0, 1])
    # All three coefficients of red, then those of green, then those of blue.
    np.testing.assert_array_equal(column["f_rest_1"], sh[:, 2, 0])
    np.testing.assert_array_equal(column["f_rest_3"], sh[:, 1, 1])
    np.testing.assert_array_equal(column["f_rest_8"], sh[:, 3, 2])
    opacity = written.opacities.double().numpy()
    np.testing.assert_allclose(column["opacity"], np.log(opacity / (1 - opacity)), rtol=1e-5)
    np.testing.assert_allclose(column["scale_2"], written.scales[:, 2].double().log(), rtol=1e-6)
    unit = torch.nn.functional.normalize(written.quaternions, dim=-1).numpy()
    np.testing.assert_allclose(column["rot_0"], unit[:, 0], atol=1e-7)


def test_another_library_reads_our_ply(tmp_path):
    written = cloud(9, 2)
    write_ply(tmp_path / "a.ply", written)
    read = trimesh.load(tmp_path / "a.ply", process=False)
    np.testing.assert_array_equal(read.vertices, written.means.numpy())
    data = read.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(np.ravel(data["f_rest_8"]), written.sh[:, 1, 1].numpy())


def test_ply_of_others_is_read_in_any_order_and_in_ascii(tmp_path):
    names = "rot_0 rot_1 rot_2 rot_3 opacity f_dc_0 f_dc_1 f_dc_2 scale_0 scale_1 scale_2 z y x confidence"
    header = "\n".join(["ply", "format ascii 1.0", "comment made by hand", "element vertex 1"])
    properties = "\n".join(
        f"property {'double' if name == 'x' else 'float'} {name}" for name in names.split()
    )
    row = "2 0 0 0 0 1 2 3 0 -1 -2 0.3 0.2 0.1 9"
    (tmp_path / "a.ply").write_text(f"{header}\n{properties}\nend_header\n{row}\n")
    read = read_ply(tmp_path / "a.ply")
    torch.testing.assert_close(read.means, torch.tensor([[0.1, 0.2, 0.3]]))
    assert read.quaternions.tolist() == [[2, 0, 0, 0]]
    assert read.opacities.tolist() == [0.5]
    assert read.sh.tolist() == [[[1, 2, 3]]]
    torch.testing.assert_close(read.scales, torch.tensor([[0.0, -1, -2]]).exp())


def test_bound_ply_keeps_triangles_and_local_coordinates(tmp_path):
    binding = bind(MESH, per_face=2)
    local = replace(cloud(8, 1), means=torch.randn(8, 3))
    write_ply(tmp_path / "a.ply", local, binding)
    new, back = read_bound_ply(tmp_path / "a.ply", MESH)
    assert torch.equal(new.face, binding.face)
    assert torch.equal(back.means, local.means)
    raw = trimesh.load(tmp_path / "a.ply", process=False).metadata["_ply_raw"]["vertex"]
    assert list(raw["properties"])[-1] == "binding_0"
    with pytest.raises(FileFormatError, match="read_bound_ply"):
        read_gaussians(tmp_path / "a.ply")
    other = TriangleMesh(MESH.vertices, MESH.faces[:3])
    with pytest.raises(FileFormatError, match=r"another mesh.*0\.\.3, but there are 3"):
        read_bound_ply(tmp_path / "a.ply", other)
    write_ply(tmp_path / "b.ply", local)
    with pytest.raises(FileFormatError, match="no binding_0"):
        read_bound_ply(tmp_path / "b.ply", MESH)
    with pytest.raises(ShapeError, match="7 Gaussians given, 8 are bound"):
        write_ply(tmp_path / "c.ply", local.select(torch.arange(7)), binding)


def test_colours_become_harmonics_and_extremes_stay_finite(tmp_path):
    colored = cloud(3, None)
    colored = replace(
        colored, opacities=torch.tensor([0.0, 1.0, 0.5]), scales=torch.tensor([[0.0, 1e-3, 1.0]] * 3)
    )
    for ending in ("ply", "spz", "splat"):
        write_gaussians(tmp_path / f"a.{ending}", colored)
        back = read_gaussians(tmp_path / f"a.{ending}")
        order = torch.argsort(back.opacities) if ending == "splat" else torch.tensor([0, 2, 1])
        shown = (back.sh[order, 0] * 0.28209479 + 0.5).clamp(0, 1)
        torch.testing.assert_close(shown, colored.colors[[0, 2, 1]], atol=0.008, rtol=0)
        torch.testing.assert_close(back.opacities[order], torch.tensor([0.0, 0.5, 1.0]), atol=0.003, rtol=0)
        assert torch.isfinite(back.scales).all()


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_spz_comes_back_within_its_steps(tmp_path, sh_degree):
    written = cloud(200, sh_degree)
    write_gaussians(tmp_path / "a.spz", written)
    back = read_gaussians(tmp_path / "a.spz")
    assert (back.means - written.means).abs().max() < 0.51 / 2**20
    assert ((back.sh[:, 1:] - written.sh[:, 1:]).abs() < 0.51 / 128).all()
    assert (back.sh[:, 0] - written.sh[:, 0]).abs().max() < 0.51 / (255 * 0.15)
    assert (back.scales / written.scales).log().abs().max() < 0.51 / 16
    assert (back.opacities - written.opacities).abs().max() < 0.51 / 255
    assert same_turns(back.quaternions, written.quaternions).min() > 1 - 1e-5
    write_gaussians(tmp_path / "a.ply", written)
    if sh_degree == 3:
        assert (tmp_path / "a.spz").stat().st_size < 0.35 * (tmp_path / "a.ply").stat().st_size


def test_spz_of_a_large_scene_trades_fraction_for_reach(tmp_path):
    far = replace(cloud(10), means=torch.linspace(-3000, 3000, 30).reshape(10, 3))
    write_gaussians(tmp_path / "a.spz", far)
    assert (read_gaussians(tmp_path / "a.spz").means - far.means).abs().max() < 0.51 / 2**11


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 10**6))
def test_smallest_three_keeps_rotations(seed):
    quaternions = np.random.default_rng(seed).standard_normal((20, 4))
    quaternions[:4] = np.eye(4)  # one part only
    quaternions[4:6, :] = [[1, 1, 1, 1], [-1, 1, -1, 1]]  # no part larger than another
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    back = _four_of(_smallest_three(quaternions).view(np.uint8).reshape(-1, 4))
    assert (np.abs((quaternions * back).sum(1)) > 1 - 1e-5).all()


@pytest.mark.parametrize("version", [2, 3])
def test_spz_of_another_writer_is_read(version):
    """Files that gsply 0.4.6 (version 3) and a byte-by-byte encoding of the format (version 2) made."""
    truth = np.load(DATA / "cloud.npz")
    read = read_spz(DATA / f"cloud_v{version}.spz")
    assert read.sh_degree == 1
    np.testing.assert_allclose(read.means, truth["means"], atol=0.6 / 2**12)
    np.testing.assert_allclose(read.opacities, truth["opacities"], atol=0.6 / 255)
    np.testing.assert_allclose(read.scales.log(), np.log(truth["scales"]), atol=0.6 / 16)
    np.testing.assert_allclose(read.sh[:, 0], truth["sh"][:, 0], atol=0.6 / (255 * 0.15))
    np.testing.assert_allclose(read.sh[:, 1:], truth["sh"][:, 1:], atol=0.05)
    turns = same_turns(read.quaternions, torch.from_numpy(truth["quaternions"]))
    assert turns.min() > (1 - 3e-4 if version == 2 else 1 - 1e-5)


def test_splat_comes_back_with_the_largest_first(tmp_path):
    written = cloud(40)
    write_gaussians(tmp_path / "a.splat", written)
    assert (tmp_path / "a.splat").stat().st_size == 40 * 32
    back = read_gaussians(tmp_path / "a.splat")
    order = torch.argsort(written.scales.prod(1) * written.opacities, descending=True)
    written = written.select(order)
    assert torch.equal(back.means, written.means)
    assert torch.equal(back.scales, written.scales)
    assert (back.opacities - written.opacities).abs().max() < 0.51 / 255
    assert same_turns(back.quaternions, written.quaternions).min() > 1 - 3e-4
    shown = (0.5 + 0.28209479 * written.sh).clamp(0, 1)
    assert (0.5 + 0.28209479 * back.sh - shown).abs().max() < 0.51 / 255


@pytest.mark.parametrize("ending", ["ply", "spz", "splat"])
def test_no_gaussians_are_a_file_too(tmp_path, ending):
    write_gaussians(tmp_path / f"a.{ending}", cloud(0))
    assert len(read_gaussians(tmp_path / f"a.{ending}")) == 0


@pytest.mark.parametrize("ending", ["ply", "spz", "splat"])
def test_cut_off_files_are_named(tmp_path, ending):
    path = tmp_path / f"a.{ending}"
    write_gaussians(path, cloud(30, 1))
    whole = path.read_bytes()
    for size in (len(whole) - 1, len(whole) // 2 + 1, 40):
        path.write_bytes(whole[:size])
        with pytest.raises(FileFormatError, match=str(path)):
            read_gaussians(path)
    with pytest.raises(FileFormatError, match="cannot read"):
        read_gaussians(tmp_path / f"none.{ending}")


def test_other_spz_contents_are_named(tmp_path):
    path = tmp_path / "a.spz"
    write_gaussians(path, cloud(30, 1))
    content = bytearray(gzip.decompress(path.read_bytes()))
    path.write_bytes(gzip.compress(bytes(content[:-1])))
    with pytest.raises(FileFormatError, match="cut off"):
        read_gaussians(path)
    path.write_bytes(gzip.compress(b"a quite different file"))
    with pytest.raises(FileFormatError, match=r"no \.spz inside"):
        read_gaussians(path)
    content[4] = 1
    path.write_bytes(gzip.compress(bytes(content)))
    with pytest.raises(FileFormatError, match="version 1"):
        read_gaussians(path)
    path.write_bytes(b"NGSP" + (4).to_bytes(4, "little") + bytes(24))
    with pytest.raises(FileFormatError, match="version 4"):
        read_gaussians(path)


def damaged(tmp_path, change) -> Path:
    path = tmp_path / "a.ply"
    write_ply(path, cloud(5, 1))
    path.write_bytes(change(path.read_bytes()))
    return path


@pytest.mark.parametrize(
    ("change", "error"),
    [
        (lambda raw: raw.replace(b"property float opacity", b"property float opaqueness"), "lacks opacity"),
        (lambda raw: raw.replace(b"float rot_3", b"float rot_9"), "lacks rot_3"),
        (lambda raw: raw.replace(b"float f_rest_8", b"float g_rest_8"), "8 f_rest"),
        (lambda raw: raw.replace(b"element vertex", b"element point"), "no vertices"),
        (lambda raw: raw[:-4] + np.float32(np.nan).tobytes(), "1 Gaussians have NaN.*rot_0.*first is 4"),
        (lambda raw: raw[:-16] + bytes(16), "rotation of zero, the first is 4"),
        (lambda raw: raw.replace(b"ply\n", b"plx\n", 1), "no whole"),
        (lambda raw: b"", "no whole"),
    ],
)
def test_damaged_ply_is_named(tmp_path, change, error):
    with pytest.raises(FileFormatError, match=error):
        read_ply(damaged(tmp_path, change))


def test_what_no_file_holds_is_named(tmp_path):
    with pytest.raises(OptionError, match=r"\.ply, \.spz or \.splat"):
        write_gaussians(tmp_path / "a.obj", cloud(2))
    bad = replace(cloud(3), scales=torch.tensor([[1.0, 1, 1], [1, np.inf, 1], [1, 1, 1]]))
    with pytest.raises(ShapeError, match="scales: 1 Gaussians are NaN or infinite, the first is 1"):
        write_gaussians(tmp_path / "a.ply", bad)
    batch = cloud(3).map(lambda field: field[None])
    with pytest.raises(ShapeError, match="choose a frame"):
        write_gaussians(tmp_path / "a.spz", batch)
    with pytest.raises(ShapeError, match="not 5 channels"):
        write_gaussians(tmp_path / "a.splat", replace(cloud(3, None), colors=torch.rand(3, 5)))
    assert not list(tmp_path.iterdir())
    (tmp_path / "a.splat").write_bytes(np.full(8, np.nan, np.float32).tobytes())
    with pytest.raises(FileFormatError, match="1 records are NaN"):
        read_gaussians(tmp_path / "a.splat")
