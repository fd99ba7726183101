"""Paint space and the brushes: product coordinates in millimetres, of the mean head at rest."""

import numpy as np
from jaxtyping import Float

__all__ = ["blob", "smoothstep"]


def smoothstep(low: float, high: float, value) -> np.ndarray:
    """0 below `low`, 1 above `high`, 3 t^2 - 2 t^3 between; falls instead where `low` exceeds `high`."""
    t = np.clip((value - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def blob(
    points: Float[np.ndarray, "points 3"],
    center: tuple[float, float, float],
    spread: tuple[float, float, float],
) -> Float[np.ndarray, " points"]:
    """A Gaussian blob and its mirror image at -x: exp(-d^2 / 2), d in units of `spread` along each axis.

    Parameters
    ----------
    points : (n, 3) float32
        Paint space, millimetres.
    center, spread : (3,) float
        Millimetres; `center` with x >= 0.
    """
    squares = np.zeros(len(points), np.float32)
    for axis in range(3):
        along = np.abs(points[:, 0]) if axis == 0 else points[:, axis]
        squares += ((along - np.float32(center[axis])) * np.float32(1 / spread[axis])) ** 2
    return np.exp(np.float32(-0.5) * squares)
