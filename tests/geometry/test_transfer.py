"""Closest points and what is carried by them."""

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from shapes import collapsed, plane, sphere, torus

from meshanim.errors import MeshError, ShapeError
from meshanim.geometry import SparseOperator, TriangleMesh, carry, closest_points, transfer_operator
from meshanim.geometry.closest_points import barycentric_coordinates


@pytest.mark.parametrize("mesh", [torus(), plane(5, 0.3)], ids=["torus", "plane"])
def test_closest_points_match_trimesh_on_every_face(mesh):
    points = np.random.default_rng(0).uniform(-1.5, 1.5, (100, 3))
    found = closest_points(mesh, points)
    triangles = np.tile(mesh.vertices[mesh.faces], (len(points), 1, 1))
    all_points = np.repeat(points, mesh.n_faces, axis=0)
    feet = trimesh.triangles.closest_point(triangles, all_points).reshape(len(points), -1, 3)
    distance = np.linalg.norm(feet - points[:, None], axis=2)
    np.testing.assert_allclose(found.distance, distance.min(1), atol=1e-9)
    np.testing.assert_allclose(found.position, feet[np.arange(len(points)), distance.argmin(1)], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(found.position - points, axis=1), found.distance, atol=1e-9)
    assert (found.barycentric >= 0).all()
    np.testing.assert_allclose(found.barycentric.sum(1), 1)


@settings(deadline=None, max_examples=100)
@given(st.integers(0, 10**9), st.sampled_from([1e-6, 1.0, 1e4]), st.integers(0, 3))
def test_barycentric_coordinates_give_the_closest_point_of_any_triangle(seed, size, kind):
    random = np.random.default_rng(seed)
    corners = size * random.standard_normal((1, 3, 3))
    if kind == 1:
        corners[0, 2] = corners[0, 0] + 0.3 * (corners[0, 1] - corners[0, 0])
    elif kind == 2:
        corners[0, 1] = corners[0, 0]
    elif kind == 3:
        corners[:] = corners[0, 0]
    point = 2 * size * random.standard_normal((1, 3))
    weights = barycentric_coordinates(point, corners)
    assert (weights >= 0).all()
    assert weights.sum() == pytest.approx(1)
    # No point of a fine grid of the triangle is closer.
    a, b = np.meshgrid(np.linspace(0, 1, 21), np.linspace(0, 1, 21))
    grid = np.stack([a[a + b <= 1], b[a + b <= 1]], axis=1)
    grid = np.concatenate([grid, 1 - grid.sum(1, keepdims=True)], axis=1) @ corners[0]
    closest = np.linalg.norm(weights @ corners[0] - point)
    assert closest <= np.linalg.norm(grid - point, axis=1).min() + 1e-9 * size


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 1000))
def test_transfer_reproduces_linear_functions_on_the_surface(seed):
    random = np.random.default_rng(seed)
    mesh, other = plane(6, 0.2, seed), plane(9, 0.2, seed + 1)
    operator = transfer_operator(mesh, other.vertices)
    np.testing.assert_allclose(operator.sum(1), 1)
    values, offset = random.standard_normal((3, 4)), random.standard_normal(4)
    np.testing.assert_allclose(
        operator @ (mesh.vertices @ values + offset), other.vertices @ values + offset, atol=1e-9
    )


def test_transfer_to_itself_is_the_identity():
    mesh = torus()
    operator = transfer_operator(mesh, mesh.vertices)
    np.testing.assert_allclose(operator.toarray(), np.eye(mesh.n_vertices), atol=1e-12)


def test_carry_takes_scalars_animations_and_blendshapes():
    mesh = sphere(2)
    points = np.random.default_rng(1).standard_normal((7, 3))
    operator = transfer_operator(mesh, points)
    frames = np.random.default_rng(2).standard_normal((4, 5, mesh.n_vertices, 3)).astype(np.float32)
    carried = carry(operator, frames)
    assert carried.shape == (4, 5, 7, 3)
    assert carried.dtype == np.float32
    np.testing.assert_allclose(carried[2, 3], operator @ frames[2, 3], atol=1e-6)
    np.testing.assert_allclose(carry(operator, mesh.vertices[:, 0]), operator @ mesh.vertices[:, 0])
    with pytest.raises(ShapeError, match="axis 1"):
        carry(operator, np.zeros((4, 3, 3)))


def test_sparse_operator_is_the_matrix_and_has_gradients():
    mesh = sphere(1)
    matrix = transfer_operator(mesh, np.random.default_rng(0).standard_normal((9, 3)))
    module = SparseOperator(matrix)
    values = torch.randn(2, mesh.n_vertices, 3, dtype=torch.float64, requires_grad=True)
    expected = torch.from_numpy(matrix.toarray().astype(np.float32)).double() @ values
    torch.testing.assert_close(module(values), expected)
    assert torch.autograd.gradcheck(module, values)
    assert not module.state_dict()
    assert module(values.detach().bfloat16()).dtype == torch.bfloat16
    with pytest.raises(ShapeError, match="42 vertices"):
        module(torch.zeros(41, 3))


def test_degenerate_meshes():
    mesh = collapsed()
    found = closest_points(mesh, np.array([[1.5, 1.0, 0.0], [0.2, 0.2, 1.0]]))
    np.testing.assert_allclose(found.position[1], [0.2, 0.2, 0])
    assert np.isfinite(found.barycentric).all()
    with pytest.raises(MeshError, match="no faces"):
        closest_points(TriangleMesh(np.eye(3), np.zeros((0, 3), int)), np.zeros((1, 3)))
    with pytest.raises(ShapeError, match="NaN"):
        closest_points(mesh, np.full((1, 3), np.nan))
    assert transfer_operator(mesh, np.zeros((0, 3))).shape == (0, 4)
