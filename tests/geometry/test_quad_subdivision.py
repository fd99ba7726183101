"""Catmull-Clark and bilinear operators against identities, limit masks and hand-computed stencils."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshanim.errors import MeshError
from meshanim.geometry import bilinear_operator, catmull_clark_operator

CUBE = np.array(
    [[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1], [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1.0]]
)
CUBE_QUADS = np.array([[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]])


def grid(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[: rows + 1, : columns + 1]
    index = np.arange((rows + 1) * (columns + 1)).reshape(rows + 1, columns + 1)
    quads = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], axis=2).reshape(-1, 4)
    return np.stack([x.ravel(), y.ravel()], axis=1).astype(float), quads


def signed_areas(points: np.ndarray, quads: np.ndarray) -> np.ndarray:
    x, y = points[quads].transpose(2, 0, 1)
    return 0.5 * (x * np.roll(y, -1, 1) - y * np.roll(x, -1, 1)).sum(1)


@given(st.integers(1, 5), st.integers(1, 5))
def test_rows_sum_to_one_and_counts_are_eulers(rows, columns):
    points, quads = grid(rows, columns)
    for make in (catmull_clark_operator, bilinear_operator):
        operator, new_quads = make(quads, len(points))
        np.testing.assert_allclose(operator.sum(1), 1)
        assert (operator.data > 0).all()
        assert operator.shape[0] == (2 * rows + 1) * (2 * columns + 1)
        assert len(np.unique(new_quads)) == operator.shape[0]
        again, _ = make(new_quads, operator.shape[0])
        assert again.shape[0] == (4 * rows + 1) * (4 * columns + 1)


@given(st.integers(3, 6), st.integers(3, 6))
def test_linear_functions_are_reproduced_inside_a_grid(rows, columns):
    points, quads = grid(rows, columns)
    operator, _ = catmull_clark_operator(quads, len(points))
    inside = ((points > 0) & (points < [columns, rows])).all(1)
    np.testing.assert_allclose((operator @ points)[: len(points)][inside], points[inside], atol=1e-12)


def test_bilinear_keeps_area_orientation_and_parents():
    points, quads = grid(3, 4)
    operator, new_quads = bilinear_operator(quads, len(points))
    np.testing.assert_allclose(signed_areas(operator @ points, new_quads), 0.25)
    parents = np.repeat(quads, 4, axis=0)
    centres = (operator @ points)[new_quads].mean(1)
    assert (np.abs(centres - points[parents].mean(1)) < 0.5).all()
    np.testing.assert_array_equal(new_quads[:, 0], quads.ravel())


def test_cube_stencils():
    # Corner of valence 3: F/3 + 2R/3 + 0; edge: mean of two ends and two face points.
    operator, new_quads = catmull_clark_operator(CUBE_QUADS, 8)
    new = operator @ CUBE
    np.testing.assert_allclose(np.abs(new[:8]), 1 / 3 * 1 / 3 + 2 / 3 * 2 / 3)
    np.testing.assert_allclose(np.sort(np.abs(new[8:20]), axis=1), [[0, 0.75, 0.75]] * 12)
    np.testing.assert_allclose(np.abs(new[20:]).max(1), 1)
    assert len(new_quads) == 24
    normals = np.cross(
        new[new_quads[:, 1]] - new[new_quads[:, 0]], new[new_quads[:, 3]] - new[new_quads[:, 0]]
    )
    assert ((normals * new[new_quads].mean(1)).sum(1) > 0).all()


def test_cube_converges_to_a_fixed_smooth_shape():
    points, quads = CUBE, CUBE_QUADS
    for _ in range(4):
        operator, quads = catmull_clark_operator(quads, len(points))
        points = operator @ points
    # Limit mask of a regular or extraordinary vertex: (n^2 P + 4 sum of edges + sum of faces) / (n (n + 5)).
    # For the first cube's corner P: n = 3, three edge neighbours and three opposite corners.
    limit = (9 + 4 * (3 - 2) + (-1 - 1 + 1)) / (3 * 8)
    np.testing.assert_allclose(points[6], limit, atol=1e-2)


def test_boundary_is_a_cubic_b_spline():
    points, quads = grid(1, 4)
    operator, _ = catmull_clark_operator(quads, len(points))
    row = operator[[2]].toarray()[0]  # bottom boundary, two steps from each end
    np.testing.assert_allclose(row[[1, 2, 3]], [0.125, 0.75, 0.125])
    assert np.count_nonzero(row) == 3


def test_crease_keeps_its_edge_sharp():
    crease = np.array([[4, 5], [5, 6], [6, 7], [7, 4]])
    operator, _ = catmull_clark_operator(CUBE_QUADS, 8, creases=crease)
    new = operator @ CUBE
    np.testing.assert_allclose(new[4:8, 2], 1)
    np.testing.assert_allclose(np.abs(new[4:8, :2]), 0.75)
    with pytest.raises(MeshError, match="crease"):
        catmull_clark_operator(CUBE_QUADS, 8, creases=np.array([[0, 6]]))


def test_unused_vertices_stay():
    points, quads = grid(2, 2)
    operator, _ = catmull_clark_operator(quads, len(points) + 1)
    assert operator[[len(points)]].toarray()[0].tolist() == [0.0] * len(points) + [1.0]


def test_bad_quads_are_refused():
    with pytest.raises(MeshError, match="twice"):
        catmull_clark_operator(np.array([[0, 1, 2, 2]]), 3)
    with pytest.raises(MeshError, match="there are 3"):
        bilinear_operator(np.array([[0, 1, 2, 3]]), 3)
