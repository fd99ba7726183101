"""Lashes: strands on the lid's own triangles, so that they turn with the lids when the eyes shut."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from meshanim.render.look.eyes import fit_sphere
from meshanim.render.look.groom import Ground, make_strands, unit
from meshanim.render.look.person import PersonParameters, srgb_to_linear
from meshanim.render.look.strands import Strands

__all__ = ["LashGuide", "lash_guide", "lash_strands"]


@dataclass(frozen=True)
class LashGuide:
    """Where the lashes of one lid grow on the mean head, in paint space (millimetres).

    Parameters
    ----------
    side : int
        1 left, -1 right.
    upper : bool
    root, tip : (4, 5) float
        Polynomials (coefficients of x, y, z; highest power first) of the lash line and of the tips' line over
        |x|; row 0 is |x| itself and unused by `at`.
    inner, outer : float
        |x| where the line begins and ends.
    """

    side: int
    upper: bool
    root: Float[np.ndarray, "3 5"]
    tip: Float[np.ndarray, "3 5"]
    inner: float
    outer: float

    def at(self, across: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Root and tip (n, 3) at |x| = `across`."""
        lines = (
            np.stack([np.polyval(row, across) for row in line], axis=1) for line in (self.root, self.tip)
        )
        root, tip = lines
        return root * [self.side, 1, 1], tip * [self.side, 1, 1]


def lash_guide(
    strip: Float[np.ndarray, "strip 3"], eye: Float[np.ndarray, "eye 3"], side: int, upper: bool
) -> LashGuide:
    """Measure the lash line on the head's own lash strip: its points near the eyeball and far from it.

    Parameters
    ----------
    strip, eye : (n, 3), (m, 3) float
        Vertices of the strip and of the eyeball, metres.
    side : int
        1 left, -1 right.
    upper : bool
    """
    points = np.asarray(strip, float) * [1000 * side, 1000, 1000]
    center = fit_sphere(np.asarray(eye, float) * [1000 * side, 1000, 1000])[0]
    distance = np.linalg.norm(points - center, axis=1)
    across = points[:, 0]
    inner, outer = across.min(), across.max()
    near: list[int] = []
    far: list[int] = []
    for left, right in zip(np.linspace(inner, outer, 11)[:-1], np.linspace(inner, outer, 11)[1:]):
        window = np.flatnonzero((across >= left - 1e-6) & (across <= right + 1e-6))
        if len(window):
            ranked = window[np.argsort(distance[window], kind="stable")]
            near.extend(ranked[: max(1, int(0.3 * len(ranked)))])
            far.extend(ranked[int(0.7 * len(ranked)) :])
    root, tip = (
        np.stack([np.polyfit(across[rows], points[rows, axis], 4) for axis in range(3)])
        for rows in (np.unique(near), np.unique(far))
    )
    return LashGuide(side, upper, root, tip, float(inner), float(outer))


def lash_strands(
    ground: Ground, guides: tuple[LashGuide, ...], person: PersonParameters, draws: np.random.Generator
) -> list[Strands]:
    """Lashes of all lids: longest in the outer middle, fanned outwards, curled up (down on the lower lid)."""
    lid = np.flatnonzero((ground.atlas.masks["eyelids"] > 0.3) & (ground.atlas.island == 0))
    tree = cKDTree(ground.points[lid])
    thick, long = 1.15 - 0.4 * person.masculinity, 1.15 - 0.35 * person.masculinity
    color = np.minimum(srgb_to_linear(person.hair_color) * 0.35, 0.03) + 0.004
    groups = []
    for guide in guides:
        count = round((84 if guide.upper else 42) * thick)
        along = np.sort(draws.uniform(0.05, 0.93, count))
        root, tip = guide.at(guide.inner + along * (guide.outer - guide.inner))
        texel = lid[tree.query(root)[1]]
        direction = unit(tip - root)
        direction[:, 0] += guide.side * 0.75 * (along - 0.45) + draws.normal(0, 0.08, count)
        direction = unit(direction)
        swell = 0.55 + 0.45 * np.sin(np.pi * np.clip(0.8 * along + 0.15, 0, 1))
        length = (7.5 if guide.upper else 4.2) * long * swell * draws.uniform(0.75, 1.1, count)
        curl = np.array([0.0, 0.42 if guide.upper else -0.25, 0.0])
        shares = np.array([0.3, 0.65, 1.0])[None, :, None]
        path = (direction[:, None] * shares * (1 - 0.08 * shares) + curl * shares**2) * length[:, None, None]
        normals = np.tile(np.array([0.0, 0.2, 1.0]) / np.hypot(0.2, 1), (count, 4, 1))
        light = np.ones((count, 4))
        groups.append(
            make_strands("lash", ground, texel, path, normals, light, 0.13e-3, np.tile(color, (count, 1)))
        )
    return groups
