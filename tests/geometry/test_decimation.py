"""Decimation and prolongation: counts, components, partition of unity, what is carried."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapes import bow_tie, collapsed, moved, plane, sphere, three_pages, torus, union

from meshanim.errors import MeshError, OptionError
from meshanim.geometry import TriangleMesh, carry, closest_points, decimate, prolongation, transfer_operator

PARTS = union(sphere(3), moved(sphere(2, 0.2), (0.75, 0, 0)), moved(torus(), (4, 0, 0)))


@settings(deadline=None, max_examples=12)
@given(st.integers(20, 1280))
def test_sphere_stays_a_sphere(n_faces):
    mesh = sphere(3)
    small = decimate(mesh, n_faces)
    assert n_faces - 2 <= small.mesh.n_faces <= n_faces
    assert small.mesh.euler_characteristic == 2
    assert small.mesh.is_manifold
    assert small.mesh.is_closed
    np.testing.assert_allclose(small.operator.sum(1), 1)
    assert (small.operator.data > 0).all()
    np.testing.assert_allclose(closest_points(mesh, small.mesh.vertices).distance, 0, atol=1e-9)


def test_values_follow_rigidly_and_linearly():
    mesh = sphere(3)
    small = decimate(mesh, 300)
    frames = np.stack([mesh.vertices * s + s for s in (0.5, 1.0, 2.0)])
    expected = np.stack([small.mesh.vertices * s + s for s in (0.5, 1.0, 2.0)])
    np.testing.assert_allclose(carry(small.operator, frames), expected, atol=1e-12)


def test_components_keep_their_share_and_do_not_mix():
    small = decimate(PARTS, PARTS.n_faces // 4)
    assert small.mesh.n_components == 3
    part = PARTS.components.astype(float)
    carried = small.operator @ part
    np.testing.assert_allclose(carried, np.round(carried), atol=1e-12)
    np.testing.assert_array_equal(part[small.cluster == 0], part[small.cluster == 0][0])
    tiny = decimate(PARTS, 12)
    assert tiny.mesh.n_components == 3
    assert tiny.mesh.n_faces <= 24


def test_two_sheets_that_nearly_touch_keep_apart():
    # Like lips: the two walls of a bowl, joined at its rim, nearer to each other than a triangle sags.
    outer = sphere(3)
    bowl = outer.faces[(outer.vertices[outer.faces][:, :, 2] < 0.01).all(1)]
    rim = np.zeros(outer.n_vertices, bool)
    rim[TriangleMesh(outer.vertices, bowl).boundary] = True
    index = np.where(rim, np.arange(outer.n_vertices), outer.n_vertices + np.arange(outer.n_vertices))
    faces = np.concatenate([bowl, index[bowl][:, ::-1]])
    used, faces = np.unique(faces, return_inverse=True)
    mesh = TriangleMesh(np.concatenate([outer.vertices, 0.998 * outer.vertices])[used], faces.reshape(-1, 3))
    label = np.where(rim[used % outer.n_vertices], 0.5, used // outer.n_vertices)
    tokens = prolongation(mesh, 200)
    back = tokens.operator @ (tokens.restriction @ label)
    far = mesh.vertices[:, 2] < -0.7
    np.testing.assert_allclose(back[far], label[far], atol=1e-9)
    by_distance = transfer_operator(tokens.mesh, mesh.vertices) @ (tokens.restriction @ label)
    assert np.abs(by_distance - label)[far].max() > 0.9


def test_texture_follows_where_each_vertex_has_one():
    mesh = plane(10)
    textured = TriangleMesh(mesh.vertices, mesh.faces, uv=mesh.vertices[:, :2])
    small = decimate(textured, 60).mesh
    np.testing.assert_allclose(small.uv, small.vertices[:, :2], atol=1e-12)
    assert (
        decimate(TriangleMesh(mesh.vertices, mesh.faces, mesh.vertices[:, :2], mesh.faces.copy()), 60).mesh.uv
        is None
    )


@pytest.mark.parametrize("method", ["barycentric", "biharmonic"])
@pytest.mark.parametrize("count", [642, 400, 100])
def test_prolongation_sums_to_one_and_is_close(method, count):
    mesh = sphere(3)
    tokens = prolongation(mesh, count, method)
    assert abs(tokens.mesh.n_vertices - count) <= 2
    assert tokens.operator.shape == (mesh.n_vertices, tokens.mesh.n_vertices)
    assert tokens.restriction.shape == tokens.operator.shape[::-1]
    np.testing.assert_allclose(tokens.operator.sum(1), 1)
    np.testing.assert_allclose(tokens.restriction.sum(1), 1)
    height = mesh.vertices[:, 2]
    np.testing.assert_allclose(tokens.operator @ (tokens.restriction @ height), height, atol=40 / count)
    if count == 642:
        np.testing.assert_allclose((tokens.operator @ tokens.restriction).toarray(), np.eye(642), atol=1e-6)


@pytest.mark.parametrize("method", ["barycentric", "biharmonic"])
def test_every_component_keeps_tokens_of_its_own(method):
    tokens = prolongation(PARTS, 100, method)
    assert tokens.mesh.n_components == 3
    label = PARTS.components.astype(float)
    np.testing.assert_allclose(tokens.operator @ (tokens.restriction @ label), label, atol=1e-9)


def test_refusals_and_odd_meshes():
    with pytest.raises(OptionError, match="n_faces must be 1"):
        decimate(sphere(1), 81)
    with pytest.raises(MeshError, match="no area"):
        decimate(collapsed(), 1)
    with pytest.raises(OptionError, match="count must be 4"):
        prolongation(sphere(1), 3)
    with pytest.raises(OptionError, match="method"):
        prolongation(sphere(1), 20, "linear")
    lonely = TriangleMesh(np.vstack([sphere(1).vertices, [[9.0, 9, 9]]]), sphere(1).faces)
    with pytest.raises(MeshError, match="belong to no face"):
        prolongation(lonely, 20)
    assert decimate(lonely, 40).cluster[-1] == -1
    for odd in (bow_tie(), three_pages()):
        same = decimate(odd, 1)
        assert same.mesh.n_faces == odd.n_faces
