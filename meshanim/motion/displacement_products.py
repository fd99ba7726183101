"""D' (v - v0): the products of displacements with blendshapes, and the Gram matrix D' D."""

from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32, Int32

from meshanim.motion.vertex_sampling import VertexSampling

try:
    from meshanim import _native
except ImportError:  # the extension is optional; the solver then has no native backend
    _native = None

__all__ = ["DisplacementProducts"]

TILE, STRIP = 64, 256
"""Floats; as in native/boxqp/boxqp.h."""
FRAMES_AT_ONCE = 128


class _Tiles(NamedTuple):
    """Tiles of a matrix that are not zero, strip by strip."""

    values: Float32[np.ndarray, "tiles 64"]
    column: Int32[np.ndarray, " tiles"]
    place: Int32[np.ndarray, " tiles"]
    offsets: Int32[np.ndarray, " strips1"]


class DisplacementProducts:
    """Weighted products with shapes: sum_i m_i D_i' (v_i - v0_i) / unit², the weights m summing to one.

    Parameters
    ----------
    neutral : (V, 3) float64
    deltas : (E, V, 3) float
    sampling : VertexSampling
    unit : float
        Length that displacements are measured in.
    backend : "native" or "reference"
        native multiplies float32 vertices in float32, in sums of a few hundred terms that are then added in
        float64, and reads only the parts of shapes that move something. float64 vertices, and all of the
        reference, are multiplied in float64.
    """

    def __init__(
        self,
        neutral: Float[np.ndarray, "vertices 3"],
        deltas: Float[np.ndarray, "shapes vertices2 3"],
        sampling: VertexSampling,
        unit: float,
        backend: Literal["native", "reference"],
    ):
        order = np.argsort(sampling.vertices)  # as they lie in memory
        self._vertices = sampling.vertices[order]
        self._neutral = neutral[self._vertices]
        weight = sampling.weights[order] / sampling.weights.sum()
        shapes = deltas[:, self._vertices].astype(np.float64) / unit
        self._matrix = (weight[:, None] / unit * shapes).reshape(len(deltas), -1)
        self.gram = unit * self._matrix @ shapes.reshape(len(deltas), -1).T
        self._tiles = _tiles(self._matrix) if backend == "native" else None
        self._indices = self._vertices.astype(np.int32)
        self._neutral32 = self._neutral.astype(np.float32)
        rounding = self._neutral32.astype(np.float64) - self._neutral
        self._rounding = self._matrix @ rounding.reshape(-1)

    def __call__(
        self, vertices: Float[np.ndarray, "frames vertices 3"]
    ) -> Float[np.ndarray, "frames shapes"]:
        products = np.empty((len(vertices), len(self._matrix)))
        if self._tiles is not None and vertices.dtype == np.float32:
            frames = np.ascontiguousarray(vertices)
            _native.project_frames(
                *self._tiles, frames, self._indices, self._neutral32, products, torch.get_num_threads()
            )
            return products + self._rounding
        for start in range(0, len(vertices), FRAMES_AT_ONCE):
            at = slice(start, start + FRAMES_AT_ONCE)
            moved = vertices[at, self._vertices].astype(np.float64) - self._neutral
            products[at] = moved.reshape(len(moved), -1) @ self._matrix.T
        return products


def _tiles(matrix: np.ndarray) -> _Tiles:
    strips = -(-matrix.shape[1] // STRIP)
    padded = np.zeros((len(matrix), strips * STRIP), np.float32)
    padded[:, : matrix.shape[1]] = matrix
    cut = padded.reshape(len(matrix), strips, STRIP // TILE, TILE).transpose(1, 0, 2, 3)
    strip, column, place = np.nonzero(cut.any(3))
    offsets = np.searchsorted(strip, np.arange(strips + 1))
    return _Tiles(
        np.ascontiguousarray(cut[strip, column, place]),
        column.astype(np.int32),
        place.astype(np.int32),
        offsets.astype(np.int32),
    )
