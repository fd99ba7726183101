"""Sparse matrices that subdivision rules are put together from."""

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Int

__all__ = ["averages", "incidence", "rows_where", "scaled", "tidy"]


def averages(polygons: Int[np.ndarray, "polygons corners"], n_vertices: int) -> sp.csr_array:
    """(P, V) matrix that averages the corners of each polygon: midpoints of edges, centroids of faces."""
    count, corners = polygons.shape
    rows = np.repeat(np.arange(count), corners)
    data = np.full(polygons.size, 1.0 / corners)
    return sp.csr_array((data, (rows, polygons.ravel())), shape=(count, n_vertices))


def incidence(polygons: Int[np.ndarray, "polygons corners"], size: int) -> sp.csr_array:
    """(size, P) matrix of ones where polygon p has element i among its corners or sides."""
    count, corners = polygons.shape
    columns = np.repeat(np.arange(count), corners)
    return sp.csr_array((np.ones(polygons.size), (polygons.ravel(), columns)), shape=(size, count))


def scaled(weights: Float[np.ndarray, " rows"], matrix: sp.sparray) -> sp.csr_array:
    """The matrix with each row times its weight."""
    return (sp.diags_array(weights) @ matrix).tocsr()


def rows_where(choice: Bool[np.ndarray, " rows"], first: sp.sparray, second: sp.sparray) -> sp.csr_array:
    """Rows of the first matrix where chosen, else of the second."""
    return scaled(choice.astype(float), first) + scaled((~choice).astype(float), second)


def tidy(operator: sp.csr_array) -> sp.csr_array:
    """The same matrix with sorted rows and without explicit zeros."""
    operator.sum_duplicates()
    operator.eliminate_zeros()
    operator.sort_indices()
    return operator
