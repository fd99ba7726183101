"""Decimation and prolongation: counts, components, partition of unity, what is carried."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapes import bow_tie, collapsed, moved, plane, sphere, three_pages, torus, union

from meshanim.errors import MeshError, OptionError
from meshanim.geometry import (
    TriangleMesh,
    carry,
    closest_points,
    decimate,
    prolongation,
    rasterize_uv,
    transfer_operator,
)
from meshanim.heads import load_head

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
    apart = decimate(
        TriangleMesh(mesh.vertices, mesh.faces, mesh.vertices[:, :2], mesh.faces.copy()), 60
    ).mesh
    assert len(apart.uv) == apart.n_vertices
    corners = apart.vertices[apart.faces][:, :, :2]
    np.testing.assert_allclose(apart.uv[apart.uv_faces], corners, atol=1e-8)


def unrolled_torus(around=48, across=24):
    """A torus whose layout is the unit square, cut open once around and once across."""
    i, j = np.meshgrid(np.arange(around), np.arange(across), indexing="ij")
    turn, roll = 2 * np.pi * i / around, 2 * np.pi * j / across
    ring = 1 + 0.4 * np.cos(roll)
    vertices = np.stack([ring * np.cos(turn), ring * np.sin(turn), 0.4 * np.sin(roll)], axis=-1)

    def triangles(rows, columns):
        def index(di, dj):
            return ((i + di) % rows * columns + (j + dj) % columns).ravel()

        a, b, c, d = index(0, 0), index(1, 0), index(1, 1), index(0, 1)
        return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])

    u, v = np.meshgrid(np.arange(around + 1) / around, np.arange(across + 1) / across, indexing="ij")
    uv = np.stack([u.ravel(), v.ravel()], axis=1)
    return TriangleMesh(
        vertices.reshape(-1, 3), triangles(around, across), uv, triangles(around + 1, across + 1)
    )


def layout_areas(mesh):
    a, b, c = mesh.uv[mesh.uv_faces].transpose(1, 0, 2)
    return 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])


@pytest.mark.parametrize("n_faces", [2304, 1500, 600, 250])
def test_texture_keeps_to_one_side_of_a_seam(n_faces):
    small = decimate(unrolled_torus(), n_faces).mesh
    uv = small.uv[small.uv_faces]
    assert np.ptp(uv, axis=1).max() < 0.5
    x, y, z = small.vertices[small.faces].transpose(2, 0, 1)
    angles = np.stack([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y) - 1)], axis=-1) / (2 * np.pi)
    error = np.abs((uv - angles + 0.5) % 1 - 0.5)
    # A triangle across the seam takes what its side has of it: its far corner lies on the cut.
    assert np.quantile(error, 0.9) < 0.01
    assert error.max() < 0.15
    areas = layout_areas(small)
    assert (areas > -1e-3).all()
    assert 1 - 25 / n_faces - 0.03 < areas.sum() < 1.01  # less what lies across the seams


def test_texture_of_the_default_head_follows():
    from meshanim.geometry.topology import vertex_components

    mesh = load_head("default").mesh
    small = decimate(mesh, 3000).mesh
    charts = vertex_components(mesh.uv_faces, len(mesh.uv)).max() + 1
    assert vertex_components(small.uv_faces, len(small.uv)).max() + 1 >= charts
    face, weights = rasterize_uv(mesh, 128)
    small_face, small_weights = rasterize_uv(small, 128)
    both = (face >= 0) & (small_face >= 0)
    assert both.sum() > 0.93 * (face >= 0).sum()
    assert ((small_face >= 0) & (face < 0)).sum() < 0.03 * (face >= 0).sum()
    old = np.einsum("nk,nkd->nd", weights[both], mesh.vertices[mesh.faces[face[both]]])
    new = np.einsum("nk,nkd->nd", small_weights[both], small.vertices[small.faces[small_face[both]]])
    distance = np.linalg.norm(old - new, axis=1)
    assert np.median(distance) < 1e-3
    assert np.quantile(distance, 0.99) < 8e-3


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
