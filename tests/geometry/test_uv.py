"""UV rasterisation: coverage equals area, barycentrics give the texel back, edges belong to one triangle."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from meshanim.errors import MeshError, OptionError
from meshanim.geometry import TriangleMesh, rasterize_uv, uv


def square(n: int, rotation: float = 0.0) -> TriangleMesh:
    """An n x n grid of the square [0.2, 0.8]^2 of the texture, rotated about its centre."""
    y, x = np.mgrid[0 : n + 1, 0 : n + 1] / n
    layout = 0.2 + 0.6 * np.stack([x.ravel(), y.ravel()], axis=1)
    turn = np.array([[np.cos(rotation), -np.sin(rotation)], [np.sin(rotation), np.cos(rotation)]])
    layout = (layout - 0.5) @ turn.T + 0.5
    i = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, 1:].ravel(), i[1:, :-1].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return TriangleMesh(np.pad(layout, ((0, 0), (0, 1))), faces, uv=layout)


def centres(height: int, width: int) -> np.ndarray:
    v, u = np.mgrid[0:height, 0:width]
    return np.stack([(u + 0.5) / width, 1 - (v + 0.5) / height], axis=2)


@settings(deadline=None, max_examples=25)
@given(st.integers(1, 7), st.floats(-3.0, 3.0), st.integers(8, 60), st.integers(8, 60))
def test_barycentrics_return_the_texel(n, rotation, height, width):
    mesh = square(n, rotation)
    face, weights = rasterize_uv(mesh, (height, width))
    hit = face >= 0
    np.testing.assert_allclose(weights[hit].sum(1), 1)
    assert (weights >= 0).all()
    assert not weights[~hit].any()
    back = (mesh.uv[mesh.uv_faces[face[hit]]] * weights[hit][:, :, None]).sum(1)
    np.testing.assert_allclose(back, centres(height, width)[hit], atol=1e-8)


@settings(deadline=None, max_examples=25)
@given(st.integers(1, 7), st.floats(-3.0, 3.0))
def test_cover_is_the_square_without_holes(n, rotation):
    face, _ = rasterize_uv(square(n, rotation), 50)
    turn = np.array([[np.cos(rotation), -np.sin(rotation)], [np.sin(rotation), np.cos(rotation)]])
    distance = np.abs((centres(50, 50) - 0.5) @ turn).max(2) - 0.3
    assert (face[distance < -1e-6] >= 0).all()
    assert (face[distance > 1e-6] < 0).all()


def test_row_zero_is_the_top():
    mesh = TriangleMesh(np.eye(3), [[0, 1, 2]], uv=[[0.0, 1.0], [0.0, 0.5], [0.5, 1.0]])
    face, _ = rasterize_uv(mesh, 4)
    assert face.tolist() == [[0, 0, -1, -1], [0, -1, -1, -1], [-1] * 4, [-1] * 4]


def test_overlap_goes_to_the_first_face_and_passes_do_not_matter(monkeypatch):
    mesh = square(6, 0.3)
    twice = TriangleMesh(mesh.vertices, np.concatenate([mesh.faces, mesh.faces]), uv=mesh.uv)
    whole = rasterize_uv(twice, 40)
    assert whole[0].max() < mesh.n_faces
    monkeypatch.setattr(uv, "CANDIDATES_AT_ONCE", 7)
    in_passes = rasterize_uv(twice, 40)
    np.testing.assert_array_equal(whole[0], in_passes[0])
    np.testing.assert_array_equal(whole[1], in_passes[1])


def test_outside_and_degenerate_layouts():
    vertices = np.eye(3)
    away = TriangleMesh(vertices, [[0, 1, 2]], uv=[[2.0, 2.0], [3.0, 2.0], [2.0, 3.0]])
    assert (rasterize_uv(away, 8)[0] == -1).all()
    line = TriangleMesh(vertices, [[0, 1, 2]], uv=[[0.0, 0.5], [0.5, 0.5], [1.0, 0.5]])
    assert (rasterize_uv(line, 9)[0] == -1).all()
    covering = TriangleMesh(vertices, [[0, 1, 2]], uv=[[-5.0, -5.0], [9.0, -5.0], [-5.0, 9.0]])
    assert (rasterize_uv(covering, (3, 5))[0] == 0).all()


def test_refusals():
    with pytest.raises(MeshError, match="texture coordinates"):
        rasterize_uv(TriangleMesh(np.eye(3), [[0, 1, 2]]), 8)
    with pytest.raises(OptionError, match="size"):
        rasterize_uv(square(1), 0)
