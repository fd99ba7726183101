"""All hair of one person: scalp, brows, beard and lashes."""

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from meshanim.render.look.groom import Ground, HairShade, hair_colors, make_strands, unit
from meshanim.render.look.lashes import LashGuide, lash_strands
from meshanim.render.look.person import PersonParameters
from meshanim.render.look.regions import brow_curve, brow_halfwidth
from meshanim.render.look.scalp import scalp_hair
from meshanim.render.look.skin import SkinPaint
from meshanim.render.look.strands import Strands

__all__ = ["grow_hair"]


def grow_hair(
    ground: Ground, paint: SkinPaint, guides: tuple[LashGuide, ...], person: PersonParameters
) -> tuple[tuple[Strands, ...], HairShade | None]:
    """Every strand of a person, and the shade that the scalp hair casts on the skin.

    Parameters
    ----------
    ground : Ground
    paint : SkinPaint
        Its scalp and beard masks say where hair grows.
    guides : tuple of LashGuide
        The lash lines of the four lids.
    person : PersonParameters
        Each kind of hair draws from its own stream of `seed`, so changing one leaves the others as they are.
    """
    scalp, shade = scalp_hair(ground, paint.scalp, person, np.random.default_rng([person.seed, 10]))
    groups = [
        *scalp,
        _brows(ground, person, np.random.default_rng([person.seed, 11])),
        *_beard(ground, paint.beard, person, np.random.default_rng([person.seed, 12])),
        *lash_strands(ground, guides, person, np.random.default_rng([person.seed, 13])),
    ]
    return tuple(group for group in groups if len(group)), shade


def _brows(ground: Ground, person: PersonParameters, draws: np.random.Generator) -> Strands:
    """Upright at the inner end, then along the curve; upper hairs lean down, lower ones up."""
    points = ground.points
    front = np.flatnonzero((points[:, 2] > 10) & (ground.atlas.island == 0))
    tree = cKDTree(points[front, :2])
    count = round(760 * person.brow_density)
    texels, paths = [], []
    for side in (1, -1):
        along = draws.beta(1.15, 1.25, count)
        x, y = brow_curve(along, person.brow_arch)
        across = draws.uniform(-0.85, 0.85, count)
        shift = across * brow_halfwidth(along) * person.brow_thickness
        at = np.stack([side * (x + draws.normal(0, 0.4, count)), y + shift], axis=1)
        texel = front[tree.query(at)[1]]
        ahead_x, ahead_y = brow_curve(np.clip(along + 0.02, 0, 1), person.brow_arch)
        tangent = np.stack([ahead_x - x + 1e-3, ahead_y - y], axis=1)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        angle = np.interp(along, [0, 0.15, 0.4, 1], [1.15, 0.70, 0.26, 0.05])
        angle = angle - 0.36 * across * np.interp(along, [0, 0.3, 1], [0.1, 1, 0.8])
        angle = angle + draws.normal(0, 0.07, count)
        cos, sin = np.cos(angle), np.sin(angle)
        direction = np.stack(
            [
                side * (cos * tangent[:, 0] - sin * tangent[:, 1]),
                sin * tangent[:, 0] + cos * tangent[:, 1],
                np.zeros(count),
            ],
            axis=1,
        )
        normal = ground.atlas.normal[texel]
        direction = unit(direction - normal * (direction * normal).sum(1, keepdims=True))
        length = np.interp(along, [0, 0.4, 1], [4.8, 6.0, 4.2]) * draws.uniform(0.65, 1.0, count)
        bend = np.stack([np.full(count, side * 0.12), np.full(count, -0.10), np.zeros(count)], axis=1)
        paths.append(
            np.stack([0.5 * (direction + 0.16 * normal), direction + 0.06 * normal + bend], axis=1)
            * length[:, None, None]
        )
        texels.append(texel)
    texel, path = np.concatenate(texels), np.concatenate(paths)
    width = 0.10e-3 * (0.7 + 0.3 * person.brow_thickness)
    colors = hair_colors(
        person, len(texel), draws, person.brow_color, 0.6 if person.brow_color is None else 1
    )
    return _short("brow", ground, texel, path, width, colors)


def _beard(
    ground: Ground, beard: Float[np.ndarray, " texels"], person: PersonParameters, draws: np.random.Generator
) -> list[Strands]:
    """Downwards and a little outwards; longer hair curves in and thins at its border."""
    if person.stubble <= 0 or person.beard_length <= 0:
        return []
    count = round(11000 * person.stubble * (1 + min(1.0, person.beard_length / 0.02)))
    density = beard**1.5
    texel = ground.sample(density, count, draws)
    roots, normal = ground.points[texel], ground.atlas.normal[texel]
    flow = np.stack([0.25 * np.sign(roots[:, 0]), np.full(count, -1.0), np.full(count, 0.35)], axis=1)
    flow = unit(flow - normal * (flow * normal).sum(1, keepdims=True)) + draws.normal(0, 0.3, (count, 3))
    length = person.beard_length * 1000 * draws.uniform(0.55, 1.15, count) * (0.35 + 0.65 * density[texel])
    steps = 2 if person.beard_length < 0.006 else 5
    here, path = np.zeros((count, 3)), []
    direction = unit(0.65 * unit(flow) + 0.5 * normal)
    for _ in range(steps):
        here = here + direction * (length / steps)[:, None]
        path.append(here)
        down = np.array([0.0, -1.0, 0.1]) + draws.normal(0, 0.12, (count, 3))
        direction = unit(direction + 0.45 * unit(flow) + 0.35 * down)
    colors = hair_colors(person, count, draws, None, 0.7)
    return [_short("beard", ground, texel, np.stack(path, axis=1), 0.13e-3, colors)]


def _short(
    kind: str, ground: Ground, texel: np.ndarray, path: np.ndarray, width: float, colors: np.ndarray
) -> Strands:
    """Strands too short to shade one another: light grows from root to tip."""
    points = path.shape[1] + 1
    normals = np.repeat(ground.atlas.normal[texel][:, None], points, axis=1)
    light = np.tile(np.linspace(0.6, 1.0, points), (len(texel), 1))
    return make_strands(kind, ground, texel, path, normals, light, width, colors)
