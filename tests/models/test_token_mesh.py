import numpy as np
import pytest
import torch
from conftest_gava import sphere

from meshanim.errors import OptionError
from meshanim.geometry import TriangleMesh
from meshanim.models.gava_parts import SparseRows
from meshanim.models.token_mesh import choose_tokens


def two_sheets():
    """Two flat grids one millimetre apart: neighbours in space that are none on the surface."""
    side = 12
    x, y = np.meshgrid(np.arange(side), np.arange(side), indexing="ij")
    grid = np.stack([x, y, 0 * x], -1).reshape(-1, 3) * 0.01
    k = np.arange(side * side).reshape(side, side)
    quads = np.stack([k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:]], -1).reshape(-1, 4)
    faces = quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
    return TriangleMesh(
        np.concatenate([grid, grid + np.array([0, 0, 0.001])]), np.concatenate([faces, faces + side**2])
    )


def test_affine_motion_is_carried_exactly():
    mesh = sphere(3)
    tokens = choose_tokens(mesh, 80)
    assert len(tokens.vertices) == 80
    matrix = np.random.default_rng(0).normal(size=(3, 3))
    moved = mesh.vertices @ matrix + np.array([1, 2, 3])
    carried = tokens.prolongation @ moved[tokens.vertices]
    np.testing.assert_allclose(carried, moved, atol=3e-3)
    np.testing.assert_array_equal(carried[tokens.vertices], moved[tokens.vertices])
    np.testing.assert_allclose(tokens.prolongation.sum(1), 1)


def test_sheets_that_nearly_touch_do_not_mix():
    mesh = two_sheets()
    tokens = choose_tokens(mesh, 40)
    half = mesh.n_vertices // 2
    upper = (tokens.vertices >= half).astype(float)
    np.testing.assert_allclose(tokens.prolongation @ upper, np.arange(mesh.n_vertices) >= half, atol=1e-12)
    assert (np.abs(np.diff(upper[tokens.edges], axis=1)) == 0).all()


def test_motion_draws_the_tokens_to_itself():
    mesh = sphere(3)
    bump = np.exp(-np.square((mesh.vertices - mesh.vertices[0]) / 0.02).sum(1))
    motion = (bump[:, None] * [0, 0.01, 0])[None]
    plain, drawn = choose_tokens(mesh, 100), choose_tokens(mesh, 100, motion)
    missed = [np.abs(t.prolongation @ motion[0, t.vertices] - motion[0]).max() for t in (plain, drawn)]
    assert missed[1] < 0.3 * missed[0]
    assert len(np.unique(drawn.vertices)) == 100


def test_all_vertices_as_tokens_is_the_mesh_itself():
    mesh = sphere(1)
    tokens = choose_tokens(mesh, mesh.n_vertices)
    np.testing.assert_array_equal(tokens.edges, mesh.edges)
    np.testing.assert_array_equal(tokens.prolongation.toarray(), np.eye(mesh.n_vertices))
    for count in (3, mesh.n_vertices + 1):
        with pytest.raises(OptionError, match="4 to 42"):
            choose_tokens(mesh, count)


def test_sparse_rows_are_the_matrix_and_its_gradient():
    generator = torch.Generator().manual_seed(0)
    dense = torch.rand(7, 5, generator=generator, dtype=torch.float64)
    dense = torch.where(dense > 0.5, dense.float().double(), 0)  # row and column may be empty
    rows, columns = dense.nonzero(as_tuple=True)
    carrier = SparseRows(rows, columns, dense[rows, columns].float(), (7, 5))
    x = torch.randn(2, 5, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    torch.testing.assert_close(carrier(x), dense @ x)
    assert torch.autograd.gradcheck(carrier, x)
