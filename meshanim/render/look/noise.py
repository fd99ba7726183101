"""Smooth periodic noise in space: a function of position, so texture seams do not show."""

from functools import cache

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import gaussian_filter, map_coordinates

from meshanim.render.rasterizer import native_available

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
    weight = 0.55 ** np.arange(octaves)
    weight = (weight / np.linalg.norm(weight)).astype(np.float32)
    scale = np.outer(2.0 ** np.arange(octaves) / cell, stretch).astype(np.float32)
    shift = np.random.default_rng(seed).uniform(0, SIZE, (octaves, 3)).astype(np.float32)
    points = np.ascontiguousarray(positions, np.float32)
    evaluate = _native if native_available() else _reference
    return evaluate(points, scale, shift, weight)


def _native(points: np.ndarray, scale: np.ndarray, shift: np.ndarray, weight: np.ndarray) -> np.ndarray:
    from meshanim import _native as kernels

    total = np.empty(len(points), np.float32)
    kernels.value_noise(points, lattice(), scale, shift, weight, total, torch.get_num_threads())
    return total


def _reference(points: np.ndarray, scale: np.ndarray, shift: np.ndarray, weight: np.ndarray) -> np.ndarray:
    total = np.zeros(len(points), np.float32)
    for octave in range(len(weight)):
        at = points * scale[octave] + shift[octave]
        total += weight[octave] * map_coordinates(lattice(), at.T, order=1, mode="grid-wrap")
    return total
