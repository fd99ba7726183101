"""Binding: equivariant, invertible, differentiable, and never an empty triangle."""

from dataclasses import replace

import numpy as np
import pytest
import roma
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from meshanim.errors import MeshError, OptionError, ShapeError
from meshanim.gaussians import Gaussians, bind
from meshanim.gaussians.binding import Binding
from meshanim.gaussians.harmonics import harmonics
from meshanim.geometry import TriangleMesh, split_faces, subdivide, surface_correspondence, triangle_frames

MESH = TriangleMesh(
    [[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1.2, 0.9, 0.4]],
    [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 4], [2, 3, 4]],
)


def random_gaussians(seed: int, count: int, dtype=torch.float64, sh_degree: int | None = None) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, dtype=torch.float64, generator=generator).to(dtype)

    color = normal(count, 3).sigmoid()
    return Gaussians(
        normal(count, 3),
        normal(count, 4),
        (0.5 * normal(count, 3)).exp(),
        normal(count).sigmoid(),
        color if sh_degree is None else None,
        None if sh_degree is None else normal(count, (sh_degree + 1) ** 2, 3),
    )


def random_pose(seed: int, *batch: int, dtype=torch.float64) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(*batch, MESH.n_vertices, 3, dtype=torch.float64, generator=generator)
    return (torch.from_numpy(MESH.vertices) + 0.2 * noise).to(dtype)


def covariances(gaussians: Gaussians) -> torch.Tensor:
    unit = torch.nn.functional.normalize(gaussians.quaternions, dim=-1)
    axes = roma.unitquat_to_rotmat(roma.quat_wxyz_to_xyzw(unit)) * gaussians.scales[..., None, :]
    return axes @ axes.mT


def assert_same_world(one: Gaussians, other: Gaussians, tolerance: float = 1e-9) -> None:
    torch.testing.assert_close(one.means, other.means, atol=tolerance, rtol=tolerance)
    torch.testing.assert_close(covariances(one), covariances(other), atol=tolerance, rtol=tolerance)
    torch.testing.assert_close(one.scales, other.scales, atol=tolerance, rtol=tolerance)
    assert torch.equal(one.opacities, other.opacities)


def test_a_known_triangle():
    mesh = TriangleMesh([[0.0, 0, 0], [2, 0, 0], [1, 3, 0]], [[0, 1, 2]])
    local = Gaussians(
        torch.tensor([[1.0, 0.5, 0.0]]),
        torch.tensor([[2.0, 0.0, 0.0, 0.0]]),
        torch.tensor([[0.4, 0.1, 0.2]]),
        torch.tensor([0.7]),
        torch.tensor([[0.1, 0.2, 0.3]]),
    )
    world = bind(mesh).to_world(local, torch.tensor(mesh.vertices, dtype=torch.float32))
    # k = (2 + 3) / 2; local x runs along the first side, local y along the normal z.
    torch.testing.assert_close(world.means, torch.tensor([[1 + 2.5, 1, 1.25]]))
    torch.testing.assert_close(world.scales, torch.tensor([[1.0, 0.25, 0.5]]))
    torch.testing.assert_close(covariances(world)[0], torch.diag(torch.tensor([1.0, 0.25, 0.0625])))
    assert world.opacities is local.opacities
    assert world.colors is local.colors


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 10**6), st.floats(1e-3, 1e3), st.booleans())
def test_gaussians_follow_a_similarity(seed, size, rotate_sh):
    binding = bind(MESH, per_face=2)
    local, vertices = random_gaussians(seed, len(binding), sh_degree=3), random_pose(seed, 2)
    generator = torch.Generator().manual_seed(seed)
    turn = roma.special_gramschmidt(torch.randn(3, 3, dtype=torch.float64, generator=generator))
    offset = torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    before = binding.to_world(local, vertices, rotate_sh)
    after = binding.to_world(local, size * vertices @ turn.mT + offset, rotate_sh)
    torch.testing.assert_close(after.means, size * before.means @ turn.mT + offset, atol=1e-7, rtol=1e-7)
    torch.testing.assert_close(
        covariances(after), size**2 * turn @ covariances(before) @ turn.mT, atol=1e-6 * size**2, rtol=1e-6
    )
    torch.testing.assert_close(after.scales, size * before.scales)
    if not rotate_sh:
        assert after.sh is local.sh
        return
    directions = torch.nn.functional.normalize(
        torch.randn(7, 3, dtype=torch.float64, generator=generator), dim=-1
    )
    seen = harmonics(directions @ turn.mT, 3) @ after.sh
    torch.testing.assert_close(seen, harmonics(directions, 3) @ before.sh, atol=1e-6, rtol=0)


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 10**6), st.booleans())
def test_to_local_inverts_to_world(seed, rotate_sh):
    binding = bind(MESH, per_face=3)
    local, vertices = random_gaussians(seed, len(binding), sh_degree=2), random_pose(seed)
    back = binding.to_local(binding.to_world(local, vertices, rotate_sh), vertices, rotate_sh)
    assert_same_world(back, local)
    torch.testing.assert_close(back.sh, local.sh)
    again = binding.to_world(binding.to_local(local, vertices, rotate_sh), vertices, rotate_sh)
    assert_same_world(again, local)


@pytest.mark.parametrize("batch", [(4,), (2, 3)])
def test_a_batch_of_frames_matches_one_by_one(batch):
    binding = bind(MESH)
    local, vertices = (
        random_gaussians(1, len(binding), torch.float32),
        random_pose(1, *batch, dtype=torch.float32),
    )
    world = binding.to_world(local, vertices)
    assert world.means.shape == (*batch, len(binding), 3)
    assert world.colors is local.colors
    assert world.opacities is local.opacities
    for index in np.ndindex(*batch):
        single = binding.to_world(local, vertices[index])
        for name in ("means", "quaternions", "scales"):
            torch.testing.assert_close(getattr(world, name)[index], getattr(single, name))


def test_local_gaussians_may_differ_from_frame_to_frame():
    binding, vertices = bind(MESH), random_pose(2, 3)
    local = random_gaussians(2, len(binding))
    moving = replace(local, means=local.means + torch.arange(3.0).double()[:, None, None])
    world = binding.to_world(moving, vertices)
    single = binding.to_world(replace(local, means=moving.means[2]), vertices[2])
    torch.testing.assert_close(world.means[2], single.means)
    still = binding.to_world(moving, vertices[2])
    torch.testing.assert_close(still.means[2], single.means)


@pytest.mark.parametrize("rotate_sh", [False, True])
def test_gradients_match_finite_differences(rotate_sh):
    binding = Binding(MESH, torch.tensor([0, 2, 2, 4]))
    local, vertices = random_gaussians(3, 4, sh_degree=1), random_pose(3, 2).requires_grad_()
    fields = [local.means, local.quaternions, local.scales, local.sh]
    fields = [field.clone().requires_grad_() for field in fields]

    def world(means, quaternions, scales, sh, vertices):
        given = Gaussians(means, quaternions, scales, local.opacities, sh=sh)
        moved = binding.to_world(given, vertices, rotate_sh)
        return moved.means, moved.quaternions, moved.scales, moved.sh

    assert torch.autograd.gradcheck(world, (*fields, vertices))


DEGENERATE = {
    "point": [[1.0, 2, 3]] * 3,
    "first side missing": [[1.0, 2, 3], [1, 2, 3], [0, 5, 1]],
    "second side missing": [[1.0, 2, 3], [0, 5, 1], [1, 2, 3]],
    "on a line": [[0.0, 0, 0], [1, 2, 3], [-2, -4, -6]],
}


@pytest.mark.parametrize("name", DEGENERATE)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_triangles_without_area_give_finite_gaussians_and_gradients(name, dtype):
    binding = bind(TriangleMesh([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]), per_face=2)
    local = random_gaussians(4, 2, dtype, sh_degree=3).map(lambda field: field.requires_grad_())
    vertices = torch.tensor(DEGENERATE[name], dtype=dtype, requires_grad=True)
    world = binding.to_world(local, vertices, rotate_sh=True)
    parts = [world.means, world.quaternions, world.scales, world.sh]
    sum((part * torch.rand_like(part)).sum() for part in parts).backward()
    for tensor in [
        *parts,
        *(t.grad for t in (vertices, local.means, local.quaternions, local.scales, local.sh)),
    ]:
        assert torch.isfinite(tensor).all()
    torch.testing.assert_close(world.quaternions.norm(dim=-1), torch.ones(2, dtype=dtype))


def test_nothing_has_a_place_in_the_frame_of_a_point():
    binding = bind(MESH)
    with pytest.raises(MeshError, match="5 triangles with Gaussians are points, the first is face 0"):
        binding.to_local(random_gaussians(5, 5), torch.zeros(MESH.n_vertices, 3, dtype=torch.float64))


@pytest.mark.parametrize("per_face", [1, 4])
def test_initial_gaussians_lie_in_their_triangles(per_face):
    binding = bind(MESH, per_face)
    local = binding.initial_gaussians(color=(0.2, 0.4, 0.6))
    assert local.means.dtype == torch.float32
    assert torch.equal(binding.count, torch.full((MESH.n_faces,), per_face))
    world = binding.to_world(local, binding.rest.float())
    corners = MESH.vertices[MESH.faces[binding.face.numpy()]]
    sides = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], -1)
    for point, corner, side in zip(world.means.numpy(), corners[:, 0], sides):
        weights, residual, *_ = np.linalg.lstsq(side, point - corner, rcond=None)
        assert (weights > 0).all()
        assert weights.sum() < 1
        assert residual < 1e-10
    if per_face == 1:
        np.testing.assert_allclose(world.means, corners.mean(1), atol=1e-6)
    assert len(torch.unique(local.means.round(decimals=4), dim=0)) >= per_face
    torch.testing.assert_close(local.scales[0], torch.tensor([0.5, 0.12, 0.5]) / per_face**0.5)
    assert local.colors[0].tolist() == pytest.approx([0.2, 0.4, 0.6])


def test_initial_harmonics_show_the_colour_from_everywhere():
    local = bind(MESH).initial_gaussians(color=(0.2, 0.4, 0.6), sh_degree=2)
    shade = (harmonics(torch.tensor([0.0, 0.6, 0.8]), 2)[:, None] * local.sh).sum(1) + 0.5
    torch.testing.assert_close(shade, torch.tensor([[0.2, 0.4, 0.6]]).expand(5, 3))


def test_some_faces_and_numbers_of_each():
    assert bind(MESH, faces=np.array([4, 1])).face.tolist() == [4, 1]
    assert bind(MESH, 2, faces=np.array([False, True, False, False, True])).face.tolist() == [1, 1, 4, 4]
    assert bind(MESH, np.array([0, 3, 0, 1, 0])).face.tolist() == [1, 1, 1, 3]


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        ({"faces": np.array([5])}, "names 5..5, but there are 5 triangles"),
        ({"faces": np.array([-1])}, "names -1..-1"),
        ({"faces": np.array([2, 2])}, "twice"),
        ({"faces": np.array([True])}, "1 entries, the mesh 5"),
        ({"faces": np.zeros(5, bool)}, "some triangle a Gaussian"),
        ({"per_face": 0}, "some triangle a Gaussian"),
        ({"per_face": -1}, "some triangle a Gaussian"),
        ({"per_face": np.array([1, 2])}, "2 entries, the mesh 5"),
    ],
)
def test_impossible_bindings_are_named(arguments, error):
    with pytest.raises((OptionError, ShapeError), match=error):
        bind(MESH, **arguments)


def test_wrong_input_is_named(unchecked):
    binding, local = bind(MESH), random_gaussians(6, 5)
    with pytest.raises(ShapeError, match="5, 3"):
        binding.to_world(local, torch.zeros(4, 3, dtype=torch.float64))
    with pytest.raises(ShapeError, match="float32"):
        binding.to_world(local, torch.zeros(5, 3))
    with pytest.raises(ShapeError, match="4 Gaussians given, 5 are bound"):
        binding.to_world(random_gaussians(6, 4), torch.zeros(5, 3, dtype=torch.float64))
    with pytest.raises(OptionError, match=r"5\.\.5"):
        Binding(MESH, torch.tensor([5]))
    with pytest.raises(ShapeError, match="int64"):
        Binding(MESH, torch.tensor([1], dtype=torch.int32))
    with pytest.raises(OptionError, match="count"):
        binding.split(local, torch.tensor([0]), count=1)
    with pytest.raises(OptionError, match="positive"):
        binding.initial_gaussians(scales=(1.0, 0.0, 1.0))
    with pytest.raises(OptionError, match="sh_degree"):
        binding.initial_gaussians(sh_degree=4)


def test_children_of_a_triangle_of_millimetres_spread_by_the_local_deviation():
    mesh = TriangleMesh(0.003 * np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), [[0, 1, 2]])
    binding = bind(mesh)
    local = binding.initial_gaussians(scales=(0.8, 0.2, 0.4), dtype=torch.float64)
    turn = torch.nn.functional.normalize(torch.tensor([[1.0, 0.3, -0.2, 0.5]], dtype=torch.float64), dim=-1)
    local = replace(local, quaternions=turn)
    refined = binding.split(local, torch.tensor([0]), 20_000, torch.Generator().manual_seed(0))
    world = refined.binding.to_world(refined.gaussians, binding.rest)
    wanted = covariances(binding.to_world(local, binding.rest))[0]
    found = torch.cov(world.means.T)
    assert (found - wanted).abs().max() < 0.03 * wanted.abs().max()
    k = triangle_frames(binding.rest, binding.faces).scale[0]
    assert found.diagonal().sum().sqrt() > 0.5 * k  # and not k times that
    torch.testing.assert_close(refined.gaussians.scales[0], local.scales[0] / 16_000)


def test_split_replaces_parents_by_children_that_inherit():
    binding = bind(MESH, per_face=2)
    local = random_gaussians(7, 10, sh_degree=1)
    which = torch.tensor([1, 6])
    refined = binding.split(local, which, generator=torch.Generator().manual_seed(1))
    assert refined.parent.tolist() == [0, 2, 3, 4, 5, 7, 8, 9, 1, 6, 1, 6]
    assert refined.fresh.tolist() == [False] * 8 + [True] * 4
    assert torch.equal(refined.binding.face, binding.face[refined.parent])
    for name in ("quaternions", "opacities", "sh"):
        assert torch.equal(getattr(refined.gaussians, name), getattr(local, name)[refined.parent])
    old = ~refined.fresh
    assert torch.equal(refined.gaussians.means[old], local.means[refined.parent[old]])
    torch.testing.assert_close(refined.gaussians.scales[~old], local.scales[refined.parent[~old]] / 1.6)
    mask = torch.zeros(10, dtype=torch.bool)
    mask[which] = True
    again = binding.split(local, mask, generator=torch.Generator().manual_seed(1))
    assert torch.equal(again.gaussians.means, refined.gaussians.means)
    nobody = binding.split(local, torch.zeros(10, dtype=torch.bool))
    assert torch.equal(nobody.gaussians.means, local.means)


def test_clones_come_last_on_the_same_triangle():
    binding, local = bind(MESH), random_gaussians(8, 5)
    refined = binding.clone(local, torch.tensor([3, 0]))
    assert refined.binding.face.tolist() == [0, 1, 2, 3, 4, 3, 0]
    assert refined.parent.tolist() == [0, 1, 2, 3, 4, 3, 0]
    assert refined.fresh.tolist() == [False] * 5 + [True] * 2
    assert torch.equal(refined.gaussians.means, local.means[refined.parent])


@settings(deadline=None, max_examples=50)
@given(st.lists(st.tuples(st.integers(0, 4), st.booleans(), st.integers(0, 3)), min_size=1, max_size=30))
def test_pruning_never_empties_a_triangle(entries):
    face = torch.tensor([entry[0] for entry in entries])
    keep = torch.tensor([entry[1] for entry in entries])
    binding = Binding(MESH, face)
    opacities = torch.tensor([entry[2] / 4 for entry in entries], dtype=torch.float64)
    local = replace(random_gaussians(9, len(face)), opacities=opacities)
    refined = binding.prune(local, keep)
    assert torch.equal(refined.binding.count > 0, binding.count > 0)
    kept = torch.zeros_like(keep)
    kept[refined.parent] = True
    assert (kept | ~keep).all()
    for saved in (kept & ~keep).nonzero()[:, 0].tolist():
        on_same = face == face[saved]
        assert not (keep & on_same).any()
        assert int((kept & on_same).sum()) == 1
        assert opacities[saved] == opacities[on_same].max()
        assert saved == int((on_same & (opacities == opacities[saved])).nonzero()[0, 0])


@pytest.mark.parametrize("rotate_sh", [False, True])
@pytest.mark.parametrize("kind", ["midpoint", "selective", "centroid", "loop"])
def test_subdivision_changes_nothing_at_rest(kind, rotate_sh):
    if kind == "selective":
        finer = split_faces(MESH, np.array([1, 3]), conforming=False)
    else:
        finer = subdivide(MESH, kind, 2 if kind == "midpoint" else 1)
    binding = bind(MESH, per_face=6)
    local = replace(
        binding.initial_gaussians(dtype=torch.float64, sh_degree=2),
        sh=random_gaussians(1, 30, sh_degree=2).sh,
    )
    new, moved = binding.to_mesh(local, finer, rotate_sh)
    assert new.mesh is finer.mesh
    assert torch.equal(torch.from_numpy(finer.parent)[new.face], binding.face)
    before = binding.to_world(local, binding.rest, rotate_sh)
    after = new.to_world(moved, new.rest, rotate_sh)
    assert_same_world(after, before)
    torch.testing.assert_close(after.sh, before.sh)
    if kind != "loop":  # the children lie in their parents: each Gaussian is inside the one it went to
        corners = finer.mesh.vertices[finer.mesh.faces[new.face.numpy()]]
        sides = corners[:, 1:] - corners[:, :1]
        weights = np.stack(
            [
                np.linalg.lstsq(s.T, m - c[0], rcond=None)[0]
                for s, m, c in zip(sides, before.means.numpy(), corners)
            ]
        )
        assert weights.min() > -1e-9
        assert weights.sum(1).max() < 1 + 1e-9


def test_single_precision_survives_subdivision():
    binding = bind(MESH, per_face=3)
    local = binding.initial_gaussians()
    new, moved = binding.to_mesh(local, subdivide(MESH))
    assert moved.means.dtype == torch.float32
    assert_same_world(
        new.to_world(moved, new.rest.float()), binding.to_world(local, binding.rest.float()), 1e-5
    )


def test_facing_sheets_stay_apart_on_another_topology():
    flat = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    lifted = flat + np.array([0, 0, 1e-4])
    sheets = TriangleMesh(np.concatenate([flat, lifted]), [[0, 1, 2], [1, 3, 2], [6, 5, 4], [6, 7, 5]])
    finer = subdivide(sheets, steps=2).mesh
    binding = bind(sheets, per_face=8)
    local = binding.initial_gaussians(dtype=torch.float64)
    new, moved = binding.to_mesh(local, finer)
    assert_same_world(new.to_world(moved, new.rest), binding.to_world(local, binding.rest))
    facing = np.sign(sheets.face_normals[binding.face.numpy(), 2])
    np.testing.assert_array_equal(np.sign(finer.face_normals[new.face.numpy(), 2]), facing)


def test_a_correspondence_carries_gaussians_onto_another_shape():
    ball, ellipsoid = trimesh.creation.icosphere(3, 0.1), trimesh.creation.uv_sphere(0.1, count=[24, 24])
    source = TriangleMesh(np.array(ball.vertices), np.array(ball.faces))
    target = TriangleMesh(np.array(ellipsoid.vertices) * [1.0, 1.15, 0.95], np.array(ellipsoid.faces))
    binding = bind(source)
    local = binding.initial_gaussians()
    correspondence = surface_correspondence(source, target)
    new, moved = binding.to_mesh(local, correspondence)
    assert new.mesh is target
    world = new.to_world(moved, new.rest.float())
    carried = torch.from_numpy(correspondence.registered[source.faces].mean(1)).float()
    torch.testing.assert_close(world.means, carried, atol=1e-6, rtol=0)
    off = np.linalg.norm(world.means.numpy() / [1.0, 1.15, 0.95], axis=1) - 0.1
    assert np.median(np.abs(off)) < 0.001
    spread = world.scales.amax(1) / binding.to_world(local, binding.rest.float()).scales.amax(1)
    assert 0.7 < spread.min() < spread.max() < 1.5
    with pytest.raises(ShapeError, match="correspondence is from"):
        bind(target).to_mesh(bind(target).initial_gaussians(), correspondence)


def test_a_subdivision_of_another_mesh_is_named():
    other = subdivide(TriangleMesh(MESH.vertices, MESH.faces[:3]))
    with pytest.raises(ShapeError, match="of 3 triangles"):
        bind(MESH).to_mesh(random_gaussians(1, 5), other)
