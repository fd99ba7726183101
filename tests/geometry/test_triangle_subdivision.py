"""Triangle subdivision: shapes kept, Loop against trimesh and the sphere, no hanging vertices."""

import igl
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from shapes import bow_tie, collapsed, moved, plane, sphere, three_pages, torus, union

from meshanim.errors import OptionError, ShapeError
from meshanim.geometry import TriangleMesh, carry, split_faces, subdivide

CHILDREN = {"midpoint": 4, "loop": 4, "centroid": 3, "barycentric": 6}


@pytest.mark.parametrize("method", CHILDREN)
@pytest.mark.parametrize(
    "mesh", [torus(), plane(4, 0.3), union(sphere(1), plane(2))], ids=["torus", "plane", "two"]
)
def test_counts_topology_and_partition_of_unity(mesh, method):
    fine = subdivide(mesh, method)
    assert fine.mesh.n_faces == CHILDREN[method] * mesh.n_faces
    assert fine.mesh.euler_characteristic == mesh.euler_characteristic
    assert fine.mesh.n_components == mesh.n_components
    assert fine.mesh.is_manifold
    assert fine.mesh.is_oriented
    np.testing.assert_allclose(fine.operator.sum(1), 1)
    assert (fine.operator.data > 0).all()
    np.testing.assert_allclose(fine.operator @ mesh.vertices, fine.mesh.vertices)
    np.testing.assert_array_equal(fine.parent, np.repeat(np.arange(mesh.n_faces), CHILDREN[method]))


@pytest.mark.parametrize("method", ["midpoint", "centroid", "barycentric"])
def test_linear_methods_keep_the_surface(method):
    mesh = torus()
    fine = subdivide(mesh, method, steps=2)
    np.testing.assert_allclose(np.bincount(fine.parent, fine.mesh.face_areas), mesh.face_areas)
    np.testing.assert_allclose(fine.mesh.face_normals, mesh.face_normals[fine.parent], atol=1e-9)


def assert_same_points(a: np.ndarray, b: np.ndarray):
    assert len(a) == len(b)
    assert cKDTree(a).query(b)[0].max() < 1e-9
    assert cKDTree(b).query(a)[0].max() < 1e-9


@pytest.mark.parametrize("mesh", [torus(), sphere(1)], ids=["torus", "sphere"])
def test_loop_matches_trimesh_on_closed_meshes(mesh):
    vertices, _ = trimesh.remesh.subdivide_loop(mesh.vertices, mesh.faces, iterations=2)
    assert_same_points(subdivide(mesh, "loop", 2).mesh.vertices, vertices)


def test_loop_matches_libigl_on_a_regular_mesh_with_boundary():
    # libigl weighs vertices of other than six neighbours after Warren, we after Loop; here there are none.
    mesh = plane(4, 0.2)
    vertices, _ = igl.loop(mesh.vertices, mesh.faces, 2)
    assert_same_points(subdivide(mesh, "loop", 2).mesh.vertices, vertices)


def test_loop_rounds_an_octahedron():
    octahedron = TriangleMesh(
        [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1.0]],
        [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]],
    )
    radius = np.linalg.norm(subdivide(octahedron, "loop", 4).mesh.vertices, axis=1)
    assert radius.max() / radius.min() < 1.12
    assert np.linalg.norm(subdivide(octahedron, "midpoint", 4).mesh.vertices, axis=1).min() < 0.6


def test_loop_commutes_with_affine_maps_and_carries_frames():
    mesh = plane(4, 0.2)
    random = np.random.default_rng(0)
    linear, offset = random.standard_normal((3, 3)), random.standard_normal(3)
    fine = subdivide(mesh, "loop", 2)
    moved_first = subdivide(mesh.with_vertices(mesh.vertices @ linear + offset), "loop", 2)
    np.testing.assert_allclose(moved_first.mesh.vertices, fine.mesh.vertices @ linear + offset)
    frames = random.standard_normal((5, mesh.n_vertices, 3))
    np.testing.assert_allclose(carry(fine.operator, frames)[3], fine.operator @ frames[3])


def test_loop_keeps_odd_edges_as_curves():
    fine = subdivide(three_pages(), "loop")
    spine = fine.operator[[0, 1]].toarray()
    np.testing.assert_allclose(spine[:, [0, 1]].sum(1), 1)
    assert np.isfinite(subdivide(bow_tie(), "loop").mesh.vertices).all()
    assert subdivide(collapsed(), "midpoint").mesh.degenerate_faces.tolist() == [4, 5, 6, 7]


@pytest.mark.parametrize("method", CHILDREN)
def test_texture_seams_survive(method):
    # A seam: the two halves of the square have separate texture coordinates.
    mesh = plane(2)
    uv_faces = np.arange(3 * mesh.n_faces).reshape(-1, 3)
    textured = TriangleMesh(
        mesh.vertices, mesh.faces, mesh.vertices[mesh.faces].reshape(-1, 3)[:, :2], uv_faces
    )
    fine = subdivide(textured, method, 2).mesh
    if method != "loop":
        np.testing.assert_allclose(fine.uv[fine.uv_faces], fine.vertices[fine.faces][..., :2], atol=1e-12)
    assert fine.uv_faces.shape == fine.faces.shape


@settings(deadline=None, max_examples=40)
@given(st.sets(st.integers(0, 31), max_size=12), st.booleans())
def test_split_faces_keeps_the_surface_and_conforms(selected, conforming):
    mesh = plane(4, 0.2)
    textured = TriangleMesh(mesh.vertices, mesh.faces, uv=mesh.vertices[:, :2])
    chosen = np.array(sorted(selected), np.int64)
    fine = split_faces(textured, chosen, conforming)
    np.testing.assert_allclose(np.bincount(fine.parent, fine.mesh.face_areas), mesh.face_areas)
    assert (fine.mesh.face_normals[:, 2] > 0.999).all()
    assert (np.bincount(fine.parent)[chosen] == 4).all()
    np.testing.assert_allclose(fine.operator.sum(1), 1)
    np.testing.assert_allclose(
        fine.mesh.uv[fine.mesh.uv_faces], fine.mesh.vertices[fine.mesh.faces][..., :2], atol=1e-12
    )
    if conforming:
        assert fine.mesh.is_manifold
        assert fine.mesh.euler_characteristic == 1
        np.testing.assert_allclose(
            np.bincount(np.unique(fine.mesh.boundary[:, 0])).sum(), len(fine.mesh.boundary)
        )
    else:
        assert fine.mesh.n_faces == mesh.n_faces + 3 * len(chosen)


def test_whole_components_need_no_neighbours():
    # The teeth of GaussianSpeech: a part of E edges and F faces gains E vertices and 3 F faces.
    teeth = moved(sphere(1), (3, 0, 0))
    mesh = union(torus(), teeth)
    for conforming in (True, False):
        fine = split_faces(mesh, mesh.components[mesh.faces[:, 0]] == 1, conforming).mesh
        assert fine.n_vertices == mesh.n_vertices + len(teeth.edges)
        assert fine.n_faces == mesh.n_faces + 3 * teeth.n_faces
        np.testing.assert_array_equal(fine.faces[: torus().n_faces], mesh.faces[: torus().n_faces])


def test_one_face_of_a_closed_mesh_is_ringed_by_halves():
    fine = split_faces(sphere(2), np.array([5]))
    assert fine.mesh.n_faces == 320 + 3 + 3
    assert fine.mesh.is_closed
    assert fine.mesh.euler_characteristic == 2


def test_refusals():
    with pytest.raises(OptionError, match="midpoint, loop"):
        subdivide(plane(1), "butterfly")
    with pytest.raises(OptionError, match="steps"):
        subdivide(plane(1), steps=-1)
    with pytest.raises(OptionError, match="selected names faces"):
        split_faces(plane(1), np.array([2]))
    with pytest.raises(ShapeError, match="3 entries"):
        split_faces(plane(1), np.ones(3, bool))
    assert subdivide(plane(1), steps=0).mesh.n_faces == 2
