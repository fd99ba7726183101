"""Repair: each defect goes, sound meshes come back as they were, values follow their vertices."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapes import bow_tie, collapsed, plane, sphere, three_pages, torus, union

from meshanim.errors import MeshError, OptionError
from meshanim.geometry import carry, repair


@pytest.mark.parametrize(
    "mesh", [torus(), plane(4), union(sphere(1), plane(2))], ids=["torus", "plane", "two"]
)
def test_sound_meshes_stay(mesh):
    mended = repair(mesh.vertices, mesh.faces)
    np.testing.assert_array_equal(mended.mesh.vertices, mesh.vertices)
    np.testing.assert_array_equal(mended.mesh.faces, mesh.faces)
    assert mended.changes == {}


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 10**6))
def test_any_damage_ends_in_a_mesh_that_operators_take(seed):
    random = np.random.default_rng(seed)
    mesh = sphere(1)
    vertices = np.concatenate([mesh.vertices, random.standard_normal((3, 3))])
    vertices[random.integers(len(vertices))] = np.nan
    faces = np.concatenate(
        [
            np.delete(mesh.faces, random.integers(80, size=5), axis=0),
            mesh.faces[random.integers(80, size=3)],
            random.integers(0, len(vertices), (4, 3)),
            [[1, 1, 2], [3, 3, 3]],
        ]
    )
    turned = random.integers(len(faces), size=6)
    faces[turned] = faces[turned][:, ::-1]
    mended = repair(vertices, faces)
    assert mended.mesh.is_manifold
    assert not len(mended.mesh.unused_vertices)
    assert not len(mended.mesh.degenerate_faces)
    np.testing.assert_array_equal(mended.mesh.vertices, vertices[mended.vertex])
    assert np.isfinite(mended.mesh.laplacian.data).all()
    values = random.standard_normal((2, len(vertices), 3))
    np.testing.assert_array_equal(carry(mended.operator, values), values[:, mended.vertex])


def test_pages_and_bow_ties_are_taken_apart():
    pages = three_pages()
    split = repair(pages.vertices, pages.faces)
    assert split.mesh.is_manifold
    assert split.mesh.n_faces == 3
    assert split.changes["split vertices"] == 4
    removed = repair(pages.vertices, pages.faces, non_manifold="remove")
    assert removed.mesh.is_manifold
    assert removed.mesh.n_faces == 2
    tie = repair(bow_tie().vertices, bow_tie().faces)
    assert tie.mesh.n_components == 2
    assert sorted(tie.vertex.tolist()) == [0, 0, 1, 2, 3, 4]


def test_flat_triangles_go_without_leaving_a_slit():
    # Vertex 2 lies on the side from 0 to 1: the flat triangle 0 1 2 joins the halves of a square.
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0.5, 0, 0], [0.5, 1, 0], [0.5, -1, 0.0]])
    mended = repair(vertices, np.array([[0, 2, 3], [2, 1, 3], [0, 1, 2], [1, 0, 4]]))
    assert mended.mesh.area == pytest.approx(1)
    assert mended.mesh.n_components == 1
    assert len(mended.mesh.boundary) == 4
    assert repair(collapsed().vertices, collapsed().faces).mesh.n_faces == 1


def test_holes_orientation_and_seams():
    mesh = sphere(2)
    holed = np.delete(mesh.faces, [5, 200], axis=0)
    filled = repair(mesh.vertices, holed, fill_holes=10)
    assert filled.mesh.is_closed
    assert filled.mesh.euler_characteristic == 2
    assert not repair(mesh.vertices, holed).mesh.is_closed
    turned = mesh.faces.copy()
    turned[10:40] = turned[10:40, ::-1]
    mended = repair(mesh.vertices, turned)
    assert mended.mesh.is_oriented
    assert mended.changes == {"turned faces": 30}
    assert not repair(mesh.vertices, turned, orient=False).mesh.is_oriented
    halves = union(plane(2), plane(2).with_vertices(plane(2).vertices + [1, 0, 0]))  # noqa: RUF005
    assert repair(halves.vertices, halves.faces).mesh.n_components == 2
    joined = repair(halves.vertices, halves.faces, merge_distance=0.0)
    assert joined.mesh.n_components == 1
    assert joined.changes == {"merged vertices": 3}


def test_refusals():
    mesh = sphere(1)
    with pytest.raises(MeshError, match="there are 42"):
        repair(mesh.vertices, mesh.faces + 1)
    with pytest.raises(MeshError, match="no usable triangle"):
        repair(np.full((3, 3), np.nan), np.array([[0, 1, 2]]))
    with pytest.raises(MeshError, match="merge_distance"):
        repair(mesh.vertices, mesh.faces, merge_distance=10.0)
    with pytest.raises(OptionError, match="non_manifold"):
        repair(mesh.vertices, mesh.faces, non_manifold="weld")
    with pytest.raises(OptionError, match="negative"):
        repair(mesh.vertices, mesh.faces, merge_distance=-1.0)
