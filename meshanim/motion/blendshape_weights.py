"""Expression weights of a head from its vertices alone, by one matrix: enough to drive wrinkles."""

import numpy as np
from jaxtyping import Float

from meshanim.errors import OptionError, ShapeError

__all__ = ["BlendshapeWeights"]


class BlendshapeWeights:
    """Ridge least squares from displacements to expression weights, clipped to [0, 1].

    The weights minimise |D w - d|^2 + ridge * sum_k |D_k|^2 w_k^2 for the expression directions D_k (metres
    for each unit) and a displacement d, so that small shapes are found as well as large ones. Clipping comes
    after the solve, so weights of shapes that cancel each other are approximate; a constrained solver is the
    exact tool.

    Parameters
    ----------
    directions : (E, V, 3) float
        Displacement of each expression at weight 1, metres.
    ridge : float
        Share of each direction's squared norm that is added to the diagonal of D's Gram matrix.

    Raises
    ------
    ShapeError
        If `directions` is not (E, V, 3).
    OptionError
        If `ridge` is not positive.
    """

    def __init__(self, directions: Float[np.ndarray, "expressions vertices 3"], ridge: float = 0.01):
        if directions.ndim != 3 or directions.shape[2] != 3:
            raise ShapeError(f"directions must be (expressions, vertices, 3), not {directions.shape}")
        if not ridge > 0:
            raise OptionError(f"ridge must be positive, not {ridge}")
        matrix = directions.reshape(len(directions), -1).astype(np.float64)
        gram = matrix @ matrix.T
        penalty = np.diag(ridge * np.diag(gram) + 1e-12 * np.trace(gram))
        self._map = np.linalg.solve(gram + penalty, matrix).astype(np.float32)
        self.n_vertices = directions.shape[1]

    def __call__(
        self, displacements: Float[np.ndarray, "*frames vertices 3"]
    ) -> Float[np.ndarray, "*frames expressions"]:
        """Weights in [0, 1] of displacements from the neutral in the zero pose, metres.

        Raises
        ------
        ShapeError
            If the displacements have another number of vertices.
        """
        if displacements.shape[-2:] != (self.n_vertices, 3):
            raise ShapeError(f"displacements must be (..., {self.n_vertices}, 3), not {displacements.shape}")
        flat = displacements.reshape(*displacements.shape[:-2], -1).astype(np.float32)
        return np.clip(flat @ self._map.T, 0, 1)
