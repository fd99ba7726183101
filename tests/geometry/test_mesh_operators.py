"""Topology, Laplacian, eigenbasis, geodesics, normals: closed forms, identities, second implementations."""

import igl
import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from shapes import (
    bow_tie,
    collapsed,
    from_trimesh,
    moved,
    plane,
    rotations,
    sphere,
    three_pages,
    torus,
    union,
)

from meshanim.errors import MeshError, OptionError
from meshanim.geometry import TriangleMesh, face_normals, vertex_normals

SPHERE, TORUS = sphere(3), torus()
SHAPES = {
    "sphere": (SPHERE, 2),
    "torus": (TORUS, 0),
    "plane": (plane(5, 0.3), 1),
    "two": (union(SPHERE, plane()), 3),
}


@pytest.mark.parametrize("name", SHAPES)
def test_gauss_bonnet_and_euler(name):
    mesh, characteristic = SHAPES[name]
    assert mesh.euler_characteristic == characteristic
    assert mesh.angle_defects.sum() == pytest.approx(2 * np.pi * characteristic)


def test_topology_of_known_shapes():
    assert SPHERE.is_manifold
    assert SPHERE.is_closed
    assert SPHERE.is_oriented
    assert SPHERE.n_components == 1
    open_mesh = plane(4)
    assert open_mesh.is_manifold
    assert not open_mesh.is_closed
    (loop,) = open_mesh.boundary_loops
    assert len(loop) == 16
    # Counter-clockwise around the surface: the shoelace area of the loop is the area of the square.
    x, y = open_mesh.vertices[loop, :2].T
    assert 0.5 * (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() == pytest.approx(1)
    two = union(plane(3), moved(SPHERE, (5, 0, 0)), plane(2))
    assert two.n_components == 3
    assert [len(loop) for loop in two.boundary_loops] == [12, 8]
    assert two.components.tolist() == [0] * 16 + [1] * SPHERE.n_vertices + [2] * 9


def test_non_manifold_meshes_are_told():
    assert not bow_tie().is_manifold
    assert bow_tie().manifold_vertices.tolist() == [False, True, True, True, True]
    with pytest.raises(MeshError, match="simple loops"):
        _ = bow_tie().boundary_loops
    pages = three_pages()
    assert pages.manifold_vertices.tolist() == [False, False, True, True, True]
    assert not pages.is_oriented
    flipped = SPHERE.faces.copy()
    flipped[7] = flipped[7][::-1]
    assert not TriangleMesh(SPHERE.vertices, flipped).is_oriented


def test_unused_vertices_and_empty_meshes():
    lonely = TriangleMesh(np.vstack([SPHERE.vertices, [[9.0, 9, 9]]]), SPHERE.faces)
    assert lonely.unused_vertices.tolist() == [SPHERE.n_vertices]
    assert lonely.is_manifold
    assert lonely.n_components == 2
    assert lonely.euler_characteristic == 2
    assert lonely.mass.shape == lonely.laplacian.shape == (lonely.n_vertices, lonely.n_vertices)
    assert not lonely.vertex_normals[-1].any()
    with pytest.raises(MeshError, match="belong to no face"):
        lonely.eigenbasis(3)
    empty = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    assert empty.n_components == 0
    assert empty.boundary_loops == []
    assert empty.edges.shape == (0, 2)
    assert empty.is_manifold


def test_area_and_volume_match_trimesh():
    for mesh in (SPHERE, TORUS):
        other = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        assert mesh.area == pytest.approx(other.area)
        assert mesh.volume == pytest.approx(other.volume)
        np.testing.assert_allclose(mesh.face_normals, other.face_normals, atol=1e-12)
    with pytest.raises(MeshError, match="closed"):
        _ = plane().volume


def test_vertex_normals_match_libigl_and_the_sphere():
    weighting = igl.PER_VERTEX_NORMALS_WEIGHTING_TYPE_AREA
    for mesh in (TORUS, plane(5, 0.3)):
        expected = igl.per_vertex_normals(mesh.vertices, mesh.faces, weighting)
        np.testing.assert_allclose(mesh.vertex_normals, expected, atol=1e-10)
    np.testing.assert_allclose(SPHERE.vertex_normals, SPHERE.vertices, atol=0.02)


@settings(deadline=None, max_examples=15)
@given(rotations(), st.floats(0.01, 100))
def test_normals_turn_with_the_mesh(rotation, scale):
    turned = TORUS.with_vertices(scale * TORUS.vertices @ rotation.T)
    np.testing.assert_allclose(turned.vertex_normals, TORUS.vertex_normals @ rotation.T, atol=1e-10)
    np.testing.assert_allclose(turned.face_normals, TORUS.face_normals @ rotation.T, atol=1e-10)


def test_normals_have_gradients_also_on_degenerate_faces():
    generator = torch.Generator().manual_seed(0)
    vertices = torch.randn(2, 5, 3, dtype=torch.float64, generator=generator, requires_grad=True)
    faces = torch.tensor([[0, 1, 2], [1, 3, 2], [2, 3, 4]])
    for function in (face_normals, vertex_normals):
        assert torch.autograd.gradcheck(lambda x, f=function: f(x, faces), vertices)
        flat = torch.zeros(1, 5, 3, requires_grad=True)
        out = function(flat, faces)
        out.sum().backward()
        assert not out.any()
        assert torch.isfinite(flat.grad).all()


def test_laplacian_is_semi_definite_and_matches_a_sum_over_cotangents():
    mesh = plane(4, 0.2, seed=3)
    dense = np.zeros((mesh.n_vertices, mesh.n_vertices))
    for face in mesh.faces:
        for k in range(3):
            i, j, o = face[k], face[(k + 1) % 3], face[(k + 2) % 3]
            u, v = mesh.vertices[i] - mesh.vertices[o], mesh.vertices[j] - mesh.vertices[o]
            weight = 0.5 * (u @ v) / np.linalg.norm(np.cross(u, v))
            dense[[i, j, i, j], [j, i, i, j]] += weight * np.array([-1, -1, 1, 1])
    np.testing.assert_allclose(mesh.laplacian.toarray(), dense, atol=1e-12)
    assert np.linalg.eigvalsh(dense).min() > -1e-12
    assert mesh.mass.sum() == pytest.approx(1)


@given(st.integers(0, 1000), st.tuples(st.floats(-2, 2), st.floats(-2, 2)))
@settings(deadline=None, max_examples=20)
def test_dirichlet_energy_of_a_linear_function(seed, slope):
    mesh = plane(5, 0.2, seed=seed)
    x = mesh.vertices[:, :2] @ np.array(slope)
    assert x @ mesh.laplacian @ x == pytest.approx(slope[0] ** 2 + slope[1] ** 2)
    inside = ((mesh.vertices[:, :2] > 0) & (mesh.vertices[:, :2] < 1)).all(1)
    np.testing.assert_allclose((mesh.laplacian @ x)[inside], 0, atol=1e-9)


def test_sphere_eigenvalues_are_l_l_plus_one():
    mesh = sphere(4)
    values, vectors = mesh.eigenbasis(25)
    expected = np.concatenate([[degree * (degree + 1)] * (2 * degree + 1) for degree in range(5)])
    np.testing.assert_allclose(values, expected, rtol=0.01, atol=1e-6)
    np.testing.assert_allclose(vectors.T @ mesh.mass @ vectors, np.eye(25), atol=1e-8)
    np.testing.assert_allclose(mesh.laplacian @ vectors, mesh.mass @ vectors * values, atol=1e-7)
    # The three functions of l = 1 span the coordinates.
    linear = vectors[:, 1:4]
    np.testing.assert_allclose(linear @ (linear.T @ mesh.mass @ mesh.vertices), mesh.vertices, atol=5e-3)


def test_eigenbasis_sparse_equals_dense_counts_components_and_is_kept():
    mesh = union(SPHERE, moved(plane(6), (4, 0, 0)))
    values, vectors = mesh.eigenbasis(12)
    root = 1 / np.sqrt(mesh.mass.diagonal())
    dense = np.linalg.eigvalsh(root[:, None] * mesh.laplacian.toarray() * root)
    np.testing.assert_allclose(values, dense[:12], atol=1e-8)
    assert (values < 1e-8).sum() == 2
    fewer_values, fewer = mesh.eigenbasis(5)
    assert fewer.base is not None
    np.testing.assert_array_equal(fewer, vectors[:, :5])
    np.testing.assert_array_equal(fewer_values, values[:5])
    all_values, _ = plane(3).eigenbasis(16)
    assert len(all_values) == 16
    for k in (0, 17):
        with pytest.raises(OptionError, match="k must be 1"):
            plane(3).eigenbasis(k)


@pytest.mark.parametrize("jitter", [0.0, 0.2])
def test_geodesic_on_a_plane_is_euclidean(jitter):
    mesh = plane(40, jitter)
    source = 41 * 20 + 20
    straight = np.linalg.norm(mesh.vertices - mesh.vertices[source], axis=1)
    distance = mesh.geodesic(source)
    np.testing.assert_allclose(distance, straight, atol=0.035)
    np.testing.assert_allclose(distance[straight < 0.45], straight[straight < 0.45], atol=0.012)


def test_geodesic_matches_the_exact_polyhedral_distance():
    mesh = from_trimesh(trimesh.creation.torus(1, 0.4, major_sections=64, minor_sections=32))
    none = np.zeros(0, np.int64)
    exact = igl.exact_geodesic(
        mesh.vertices, mesh.faces, np.array([0]), none, np.arange(mesh.n_vertices), none
    )
    np.testing.assert_allclose(mesh.geodesic(0), exact, atol=0.06 * exact.max())


def test_geodesic_from_several_sources_is_to_the_nearest():
    mesh = sphere(4)
    angle = np.arccos(np.clip(mesh.vertices @ mesh.vertices[[0, 100]].T, -1, 1)).min(1)
    np.testing.assert_allclose(mesh.geodesic([0, 100]), angle, atol=0.05)
    assert mesh.geodesic([0, 100])[[0, 100]].tolist() == [0, 0]


def test_geodesic_does_not_leave_its_component():
    mesh = union(SPHERE, moved(SPHERE, (2.5, 0, 0)), TriangleMesh([[9, 9, 9.0]], np.zeros((0, 3), int)))
    distance = mesh.geodesic([3])
    n = SPHERE.n_vertices
    np.testing.assert_allclose(distance[:n], sphere(3).geodesic(3))
    assert np.isinf(distance[n:]).all()
    both = mesh.geodesic([3, n + 3, 2 * n])
    np.testing.assert_allclose(both[n : 2 * n], both[:n], atol=1e-6)
    assert both[-1] == 0
    for bad in ([], [-1], [2 * n + 1]):
        with pytest.raises(OptionError, match="vertex indices"):
            mesh.geodesic(bad)


def test_geodesic_on_non_manifold_meshes_is_finite():
    for mesh in (three_pages(), bow_tie()):
        distance = mesh.geodesic(0)
        assert np.isfinite(distance).all()
        assert (distance[1:] > 0).all()


def test_triangles_without_area_are_refused_by_name():
    mesh = collapsed()
    assert mesh.degenerate_faces.tolist() == [1]
    for operator in (lambda: mesh.laplacian, lambda: mesh.mass, lambda: mesh.geodesic(0)):
        with pytest.raises(MeshError, match="no area, the first is face 1"):
            operator()
    assert not mesh.face_normals[1].any()
    assert mesh.face_areas.tolist() == [0.5, 0.0]
