"""Smooth periodic noise in space: a function of position, so texture seams do not show."""

from functools import cache

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter, map_coordinates

__all__ = ["lattice", "value_noise"]

SIZE = 64


@cache
def lattice() -> Float[np.ndarray, "size size size"]:
    """The one periodic random volume (64, 64, 64) float32: zero mean, standard deviation 0.35."""
    volume = np.random.default_rng(0).normal(size=(SIZE,) * 3).astype(np.float32)
    volume = gaussian_filter(volume, 0.8, mode="wrap")
    volume *= np.float32(0.35) / volume.std()
    volume.setflags(write=False)
    return volume


def value_noise(
    positions: Float[np.ndarray, "points 3"],
    cell: float,
    seed: int,
    octaves: int = 1,
    stretch: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> Float[np.ndarray, " points"]:
    """Noise in about [-1, 1] (standard deviation about 0.35), trilinear in a periodic random volume.

    Parameters
    ----------
    positions : (n, 3) float32
        In any length unit.
    cell : float
        Size of a noise cell in that unit; each further octave halves it at 0.55 of the weight. The
        pattern repeats after 64 cells.
    seed : int
        Moves the window into the volume.
    octaves : int
    stretch : (3,) float
        Scales the positions first: less than 1 makes the pattern longer along that axis.

    Returns
    -------
    (n,) float32
    """
    shifts = np.random.default_rng(seed).uniform(0, SIZE, (octaves, 3)).astype(np.float32)
    total = np.zeros(len(positions), np.float32)
    weight, power = 1.0, 0.0
    for octave in range(octaves):
        scale = np.asarray(stretch, np.float32) * np.float32(2**octave / cell)
        points = positions.astype(np.float32, copy=False) * scale + shifts[octave]
        total += np.float32(weight) * map_coordinates(lattice(), points.T, order=1, mode="grid-wrap")
        power += weight * weight
        weight *= 0.55
    return total / np.float32(np.sqrt(power))
