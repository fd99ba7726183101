"""Where hair grows: hairline, beard and brows on the mean head, in paint space (millimetres)."""

import numpy as np
from jaxtyping import Float

from meshanim.render.look.paint import smoothstep

__all__ = ["beard_mask", "brow_curve", "brow_halfwidth", "hairline"]

Points = Float[np.ndarray, "points 3"]
Mask = Float[np.ndarray, " points"]


def hairline(points: Points, baldness: float = 0.0, sideburns: float = 0.5) -> Mask:
    """Signed distance in about millimetres, positive where scalp hair grows.

    The union of the top of the head above a frontal arc, the side behind the temple, the sideburn and the
    back down to the nape.

    Parameters
    ----------
    points : (n, 3) float
        Paint space, millimetres.
    baldness, sideburns : float
        0 to 1: recession of the arc; width and length of the sideburns and depth of the temples.
    """
    x, y, z = np.abs(points[:, 0]), points[:, 1], points[:, 2]
    arc = 95 - 0.2 * x + (4 + 6 * sideburns) * np.exp(-(((x - 45) / (18 - 6 * sideburns)) ** 2))
    arc = arc + baldness * (20 + 30 * np.exp(-((x / 30) ** 2)))
    top = np.minimum(y - arc - 0.1 * np.clip(z - 22, 0, None), 3 * (28 - z) + 50)
    side = np.minimum(0.9 * (-z - 8) + 0.25 * (y - 50), y - 22)
    burn = np.minimum(3 + 6 * sideburns - np.abs(z + 17 - 0.05 * (y - 20)), y + 4 - 14 * (1 - sideburns))
    burn = np.where(x > 60, burn, -1000)
    back = np.minimum(-z - 62, y + 38 - 0.3 * np.clip(z + 130, 0, None))
    return np.maximum.reduce([top, side, burn, back])


def beard_mask(points: Points) -> Mask:
    """Density of the beard in [0, 1]: jaw, chin, under the chin, moustache; the upper cheek stays free."""
    x, y, z = np.abs(points[:, 0]), points[:, 1], points[:, 2]
    jaw = smoothstep(-8, -38, y - 0.55 * np.clip(x - 45, 0, None))
    jaw = jaw * smoothstep(-115, -85, y) * smoothstep(-45, -20, z)
    cheek = smoothstep(0, 12, (x - 30) + 0.6 * (-15 - y)) * smoothstep(-4, -20, y)
    below = smoothstep(-47, -54, y)
    moustache = np.exp(-(((y + 23) / 5.5) ** 2)) * smoothstep(34, 26, x) * (z > 40)
    return np.clip(np.maximum(moustache, jaw * np.maximum(cheek, below)), 0, 1)


def brow_curve(along: np.ndarray, arch: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Middle line (x, y) of the left brow, millimetres, from its inner end (0) to its tail (1)."""
    x = np.interp(along, [0, 0.25, 0.55, 0.8, 1], [10.5, 21, 36, 46.5, 54.5])
    y = np.interp(along, [0, 0.25, 0.55, 0.72, 1], [50.0, 52.8, 56.0, 55.6, 49.5])
    return x, 51 + (y - 51) * np.where(along < 0.9, 0.5 + 0.5 * arch, 1)


def brow_halfwidth(along: np.ndarray) -> np.ndarray:
    """Half the height of an average brow along its curve, millimetres."""
    return np.interp(along, [0, 0.12, 0.5, 0.8, 1], [2.8, 4.0, 3.8, 2.4, 0.9])
