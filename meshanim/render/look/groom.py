"""The ground that hair grows on, and what all hair shares: roots, colour, light that gets through."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial import cKDTree

from meshanim.render.look.atlas import Atlas
from meshanim.render.look.person import PersonParameters, srgb_to_linear
from meshanim.render.look.strands import Strands, attach
from meshanim.render.look.surface import Surface, vertex_normals

__all__ = [
    "GREY",
    "Ground",
    "HairShade",
    "hair_colors",
    "make_strands",
    "skin_shade",
    "strand_occlusion",
    "unit",
]

GREY = np.array([1.0, 0.94, 0.82])
"""Tint of hair without pigment; keratin is yellowish, and the sky's light is blue."""
VOXEL = 4.0
"""Edge of the cells that hair density is counted in, millimetres."""


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) at length one."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)


@dataclass(frozen=True)
class Ground:
    """The mean head at rest as hair sees it. All positions in paint space (millimetres).

    Parameters
    ----------
    atlas : Atlas
    surface : Surface
        The skin.
    vertices : (N, 3) float32
        The skin surface's vertices, metres.
    ears : (N,) float32
        The ears' mask on them; hair passes over the ears at a distance rather than along their folds.
    """

    atlas: Atlas
    surface: Surface
    vertices: Float[np.ndarray, "vertices 3"]
    ears: Float[np.ndarray, " vertices"]

    @cached_property
    def texel_area(self) -> Float[np.ndarray, " texels"]:
        """Skin area under each texel up to a factor; zero on the padding's repeats is not needed."""
        corners = self.vertices[self.surface.faces].astype(float)
        solid = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        side = self.surface.corner_uv[:, 1:] - self.surface.corner_uv[:, :1]
        flat = np.abs(side[:, 0, 0] * side[:, 1, 1] - side[:, 0, 1] * side[:, 1, 0])
        return (solid / np.maximum(flat, 1e-12))[self.atlas.triangle]

    @cached_property
    def points(self) -> Float[np.ndarray, "texels 3"]:
        return self.atlas.position * np.float32(1000)

    @cached_property
    def _skull(self) -> tuple[cKDTree, np.ndarray, np.ndarray]:
        keep = self.ears < 0.2
        normals = vertex_normals(self.vertices, self.surface.faces)[keep]
        points = self.vertices[keep].astype(float) * 1000
        return cKDTree(points), points, normals

    def nearest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Normals of the closest skin (n, 3) and signed heights over it (n,), the ears left out."""
        tree, on_skin, normals = self._skull
        index = tree.query(points)[1]
        normal = normals[index]
        return normal, ((points - on_skin[index]) * normal).sum(1)

    def sample(
        self, density: Float[np.ndarray, " texels"], count: int, draws: np.random.Generator
    ) -> Int[np.ndarray, " roots"]:
        """Texels of `count` roots drawn with a density per skin area."""
        weight = np.cumsum(density * self.texel_area)
        return np.searchsorted(weight, draws.uniform(0, weight[-1], count)).clip(max=len(weight) - 1)


@dataclass(frozen=True)
class HairShade:
    """Blocked area per volume of the scalp hair, to darken the skin under it.

    Parameters
    ----------
    density : (X, Y, Z) float32
        1 / mm in cells of `VOXEL`.
    origin : (3,) float
        Centre of the first cell, paint space.
    """

    density: Float[np.ndarray, "x y z"]
    origin: Float[np.ndarray, " 3"]


def hair_colors(
    person: PersonParameters, count: int, draws: np.random.Generator, color=None, darken: float = 1.0
) -> Float[np.ndarray, "strands 3"]:
    """Linear colours of single hairs: the person's, varied, with their share of grey ones."""
    pigment = srgb_to_linear(person.hair_color if color is None else color) * darken
    colors = pigment * draws.uniform(0.72, 1.28, (count, 1)) * draws.uniform(0.94, 1.06, (count, 3))
    grey = draws.uniform(size=count) < person.hair_grey
    colors[grey] = draws.uniform(0.12, 0.62, (grey.sum(), 1)) * GREY
    return colors


def make_strands(
    kind: str,
    ground: Ground,
    texels: np.ndarray,
    paths: np.ndarray,
    normals: np.ndarray,
    occlusion: np.ndarray,
    width: float | np.ndarray,
    color: np.ndarray,
) -> Strands:
    """Strands from paths (n, k, 3) in millimetres relative to their roots, at the mean head's rest."""
    atlas = ground.atlas
    count = len(texels)
    return attach(
        kind,
        ground.vertices,
        ground.surface.faces,
        atlas.triangle[texels],
        atlas.barycentric[texels],
        paths * 1e-3,
        normals,
        occlusion,
        np.broadcast_to(width, count),
        color,
    )


def strand_occlusion(
    points: Float[np.ndarray, "strands points 3"],
    normals: Float[np.ndarray, "strands points 3"],
    width: float,
) -> tuple[Float[np.ndarray, "strands points"], HairShade]:
    """Light that reaches each strand point through the others.

    Parameters
    ----------
    points, normals : (n, k, 3) float
        Paint space, roots included.
    width : float
        Millimetres.

    Returns
    -------
    occlusion : (n, k) float
        Mean transmittance towards the outside and the sky, in [0, 1].
    shade : HairShade
        The density it was computed in.
    """
    origin = points.min((0, 1)) - 8 * VOXEL
    size = np.ceil((points.max((0, 1)) + 8 * VOXEL - origin) / VOXEL).astype(int) + 1
    middle = 0.5 * (points[:, 1:] + points[:, :-1])
    piece = np.linalg.norm(points[:, 1:] - points[:, :-1], axis=2)
    cell = np.rint((middle - origin) / VOXEL).astype(int)
    flat = np.ravel_multi_index(tuple(np.moveaxis(cell, 2, 0)), size)
    area = np.bincount(flat.ravel(), (piece * width).ravel(), minlength=int(size.prod()))
    density = gaussian_filter(area.reshape(size) / VOXEL**3, 0.7).astype(np.float32)
    shade = HairShade(density, origin)
    return _transmittance(shade, points, normals), shade


def skin_shade(
    shade: HairShade, points: Float[np.ndarray, "vertices 3"], normals: Float[np.ndarray, "vertices 3"]
) -> Float[np.ndarray, " vertices"]:
    """Light that reaches the skin through the hair over it, in [0, 1]; positions in paint space."""
    return _transmittance(shade, points[:, None], normals[:, None])[:, 0]


def _transmittance(shade: HairShade, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Mean over a few outward directions of exp(-blocked area along them)."""
    total = np.zeros(points.shape[:2])
    for tilt in ((0, 0, 0), (0, 0.8, 0), (0, 0.2, 0.8), (0.8, 0.2, 0), (-0.8, 0.2, 0)):
        direction = unit(normals + np.array(tilt))
        depth = np.zeros(points.shape[:2])
        for step in range(1, 5):
            at = (points + direction * (VOXEL * step) - shade.origin) / VOXEL
            depth += map_coordinates(shade.density, np.moveaxis(at, 2, 0), order=1, mode="constant")
        total += np.exp(-0.55 * VOXEL * depth)
    return total / 5
