"""Scalp hair: strands traced from the roots along a style's flow, clear of the head, gathered into locks."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from meshanim.render.look.groom import Ground, HairShade, hair_colors, make_strands, strand_occlusion, unit
from meshanim.render.look.noise import value_noise
from meshanim.render.look.paint import smoothstep
from meshanim.render.look.person import PersonParameters
from meshanim.render.look.regions import hairline
from meshanim.render.look.strands import Strands

__all__ = ["falls_over_ears", "scalp_hair"]

WHORL = np.array([4.0, 145.0, -80.0])
BUN = np.array([0.0, 158.0, -104.0])

Points = Float[np.ndarray, "strands 3"]


@dataclass(frozen=True)
class _Style:
    """How one style is traced. Lengths in millimetres.

    `flow(points, roots, person)` is the direction hair wants to take; `length(roots, person)` how long it is,
    times a draw from `spread`. Hair lies flat beside a parting where the style has one.
    """

    flow: Callable[[np.ndarray, np.ndarray, PersonParameters], np.ndarray]
    length: Callable[[np.ndarray, PersonParameters], np.ndarray]
    count: int
    steps: int
    lift: float
    volume: float
    gravity: float
    locks: int
    gather: float
    frizz: float
    width: float
    curl: float = 0.0
    over_ears: bool = False
    has_parting: bool = False
    spread: tuple[float, float] = (0.72, 1.06)


def _blend(first: np.ndarray, second: np.ndarray, share: np.ndarray) -> np.ndarray:
    return first * (1 - share[:, None]) + second * share[:, None]


def _down(points: Points, back: float = -0.15) -> Points:
    out = np.zeros_like(points)
    out[:, 1] = -1
    out[:, 2] = back
    return out


def _cropped(points: Points, roots: Points, person: PersonParameters) -> Points:
    """From the whorl forwards, down at the sides and the back."""
    away = unit((points - WHORL) * [1.0, 0.3, 1.0])
    away = unit(away * [0.5, 1, 1] + [0, 0, 0.25])
    side = smoothstep(48, 74, np.abs(points[:, 0])) * smoothstep(105, 70, points[:, 1])
    back = smoothstep(-90, -115, points[:, 2]) * smoothstep(135, 110, points[:, 1])
    return unit(_blend(away, unit(_down(points)), np.maximum(0.85 * side, back)))


def _parted(points: Points, roots: Points, person: PersonParameters) -> Points:
    """Combed sideways and back from a parting; down at the sides and the back."""
    part = person.part_side * 1000
    sign = np.sign(roots[:, 0] - part + 1e-6)
    across = np.stack([sign, np.full(len(points), -0.15), np.full(len(points), -0.35)], axis=1)
    front = smoothstep(0, 40, points[:, 2])[:, None]
    across = across + front * np.array([0, 0.25, 0.15])
    side = smoothstep(45, 72, np.abs(points[:, 0]))
    back = smoothstep(-80, -110, points[:, 2])
    return unit(_blend(unit(across), unit(_down(points, -0.35)), np.maximum(side, back)))


def _hanging(points: Points, roots: Points, person: PersonParameters) -> Points:
    """From a parting over the sides, then straight down; swept off the face."""
    part = person.part_side * 1000
    fade = smoothstep(-60, -100, roots[:, 2])[:, None]
    sign = np.sign(roots[:, 0] - part + 1e-6)
    across = np.stack([sign, np.full(len(points), -0.1), np.full(len(points), -0.30)], axis=1)
    radial = unit((points - WHORL) * [1.0, 0.0, 1.0]) * [1.0, 1.0, 1.0]
    across = unit(across * (1 - fade) + radial * fade)
    face = smoothstep(10, 45, points[:, 2]) * smoothstep(100, 60, points[:, 1])
    fall = _down(points, -0.05) - face[:, None] * np.array([0, 0, 0.6])
    low = np.maximum(smoothstep(52, 74, np.abs(points[:, 0])), smoothstep(-95, -120, points[:, 2]))
    low = np.maximum(low, smoothstep(95, 70, points[:, 1]))
    inward = smoothstep(-30, -70, points[:, 1])[:, None] * np.stack(
        [-np.sign(points[:, 0]) * 0.35, 0 * sign, 0.1 + 0 * sign], axis=1
    )
    flow = unit(_blend(across, unit(fall), low) + inward)
    fringe = _in_fringe(roots, person)
    if fringe.any():
        ahead, fall = np.array([[0.0, -0.1, 1.0]]), np.array([[0.0, -1.0, 0.12]])
        flow[fringe] = unit(_blend(ahead, fall, smoothstep(122, 100, points[fringe, 1])))
    return flow


def _in_fringe(roots: Points, person: PersonParameters) -> np.ndarray:
    """Which strands fall over the forehead: an even draw from the front, fixed by the root's place."""
    front = (np.abs(roots[:, 0]) < 46) & (roots[:, 2] > -30) & (roots[:, 1] > 90)
    lot = np.modf(np.abs(np.sin(roots @ np.array([12.9898, 78.233, 37.719])) * 43758.5453))[0]
    return front & (lot < person.fringe)


def _tied(points: Points, roots: Points, person: PersonParameters) -> Points:
    """Combed tightly to the knot."""
    return unit(BUN - points)


def _outwards(points: Points, roots: Points, person: PersonParameters) -> Points:
    """Away from the skull, sagging a little."""
    return unit(unit(points - np.array([0, 60, -35])) + np.array([0, -0.25, 0.1]))


def _short_sides(roots: Points, person: PersonParameters) -> np.ndarray:
    top = person.hair_length * 1000
    sides = min(top, 9.0)
    high = np.maximum(smoothstep(70, 105, roots[:, 1]), smoothstep(10, 30, roots[:, 2]))
    high = high * smoothstep(76, 60, np.abs(roots[:, 0]))
    return sides + (top - sides) * high


def _to_one_level(roots: Points, person: PersonParameters) -> np.ndarray:
    """Long enough for every tip to reach one height: over the skull to its side, then down."""
    reach = np.sqrt(np.clip(1 - ((roots[:, 1] - 60) / 95) ** 2, 0, 1))
    over = np.where(roots[:, 1] > 60, 95 * (np.pi / 2 - np.arcsin(np.clip(reach, 0, 1))), 0)
    level = 60 - person.hair_length * 1000
    length = np.clip(over + np.minimum(roots[:, 1], 60) - level, 30, 400)
    brows = np.clip(47 + 1.1 * (60 - np.minimum(roots[:, 2], 60)), 40, 150)
    return np.where(_in_fringe(roots, person), brows, length)


def _to_knot(roots: Points, person: PersonParameters) -> np.ndarray:
    return np.linalg.norm(roots - BUN, axis=1) * 1.12


def _even(roots: Points, person: PersonParameters) -> np.ndarray:
    return np.full(len(roots), person.hair_length * 1000)


_STYLES = {
    "buzz": _Style(_cropped, _even, 30000, 2, 0.55, 0.0, 0.1, 0, 0.0, 0.0, 0.16),
    "crop": _Style(_cropped, _short_sides, 20000, 5, 0.55, 6.0, 0.25, 700, 0.45, 0.9, 0.16),
    "parted": _Style(_parted, _short_sides, 16000, 8, 0.40, 7.0, 0.15, 420, 0.6, 1.0, 0.21, has_parting=True),
    "curls": _Style(_outwards, _even, 15000, 15, 0.6, 2.0, 0.05, 1800, 0.45, 2.5, 0.26, 3.8),
    "bob": _Style(
        _hanging, _to_one_level, 12500, 12, 0.30, 9.0, 0.2, 330, 0.6, 1.4, 0.35, 0.0, True, True, (0.90, 1.02)
    ),
    "long": _Style(
        _hanging,
        _to_one_level,
        14000,
        14,
        0.30,
        9.0,
        0.25,
        260,
        0.65,
        2.4,
        0.32,
        0.0,
        True,
        True,
        (0.88, 1.04),
    ),
    "bun": _Style(_tied, _to_knot, 13000, 9, 0.25, 3.0, 0.0, 500, 0.3, 0.6, 0.24),
}


def falls_over_ears(style: str) -> bool:
    """Whether hair of a style (one of `HAIR_STYLES`) hangs over the ears."""
    return style in _STYLES and _STYLES[style].over_ears


def scalp_hair(
    ground: Ground,
    scalp: Float[np.ndarray, " texels"],
    person: PersonParameters,
    draws: np.random.Generator,
) -> tuple[list[Strands], HairShade | None]:
    """Grow a person's scalp hair on the mean head.

    Parameters
    ----------
    ground : Ground
    scalp : (n,) float
        Density of roots a texel, in [0, 1].
    person : PersonParameters
    draws : numpy Generator
    """
    if person.hair == "none" or scalp.max() <= 0:
        return [], None
    style = _STYLES[person.hair]
    sparse = 0.45 if style.over_ears else 0.15  # single long hairs below the hairline look like scratches
    texels = ground.sample(np.where(scalp > sparse, scalp, 0), style.count, draws)
    roots = ground.points[texels].astype(float)
    length = style.length(roots, person) * draws.uniform(*style.spread, len(roots))
    edge = hairline(roots, person.baldness, person.masculinity)
    if person.hair != "bun":
        thin = (0.45 + 0.55 * smoothstep(-3, 9, edge)) * ~_in_fringe(roots, person)
        length = length * np.where(thin > 0, thin, 1)
    points, normals = _trace(ground, style, roots, ground.atlas.normal[texels], length, person, draws)
    if style.locks:
        apart = 1000.0 * _in_fringe(roots, person)  # a fringe and the hair behind it share no locks
        points = _gather(points, apart, style, draws)
    if style.frizz:
        points = _frizz(points, style, draws)
    if style.curl:
        points = _curl(points, style, draws)
    points = _clear(ground, points, style)
    if style.over_ears:
        keep = ~_strays(points, roots, person)
        texels, points, normals = texels[keep], points[keep], normals[keep]
    groups = [(texels, points, normals)]
    if person.hair == "bun":
        groups.append(_knot(ground, texels, draws))
    occlusion, shade = _shade(groups, style.width)
    strands = []
    for (texel, path, normal), light in zip(groups, occlusion):
        colors = hair_colors(person, len(texel), draws) * _lock_tint(path[:, 0], person)
        width = style.width * 1e-3 * np.where(_in_fringe(path[:, 0], person), 1.9, 1.0)
        strands.append(
            make_strands("hair", ground, texel, path[:, 1:] - path[:, :1], normal, light, width, colors)
        )
    return strands, shade


def _trace(
    ground: Ground,
    style: _Style,
    roots: Points,
    root_normals: np.ndarray,
    length: np.ndarray,
    person: PersonParameters,
    draws: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Walk from the roots: points and outward normals (n, steps + 1, 3)."""
    layer = draws.uniform(0.05, 1, len(roots))
    step = (length / style.steps)[:, None]
    flow = style.flow(roots, roots, person)
    tangent = unit(flow - root_normals * (flow * root_normals).sum(1, keepdims=True))
    tangent = unit(tangent + draws.normal(0, 0.16, roots.shape))
    rise = _rise(roots, person) if style.has_parting else np.ones(len(roots))
    lift = (style.lift * rise)[:, None]
    direction = unit(lift * root_normals + (1 - lift) * tangent)
    points, normals = [roots], [root_normals.astype(float)]
    here = roots
    for index in range(style.steps):
        moved = here + direction * step
        normal, height = ground.nearest(moved)
        along = (index + 1) / style.steps
        settled = np.maximum(rise, smoothstep(0, 70, np.linalg.norm(moved - roots, axis=1)))
        hover = 0.4 + style.volume * layer * min(1.0, 2.5 * along) * settled
        moved = moved + normal * np.clip(hover - height, 0, None)[:, None]
        excess = np.clip(height - hover - 0.5, 0, None)
        if style.curl == 0:
            pull = 0.35 + 0.45 * (1 - settled)
            moved = moved - normal * (pull * np.minimum(excess, 6 + 6 * (1 - settled)))[:, None]
        direction = unit(moved - here)
        wanted = style.flow(moved, roots, person)
        close = smoothstep(25, 5, height)[:, None]
        wanted = unit(wanted - close * normal * np.minimum((wanted * normal).sum(1, keepdims=True), 0))
        direction = unit(0.45 * direction + 0.55 * wanted + np.array([0, -style.gravity, 0]))
        points.append(moved)
        normals.append(normal)
        here = moved
    return np.stack(points, axis=1), np.stack(normals, axis=1)


def _rise(roots: Points, person: PersonParameters) -> np.ndarray:
    """How far hair may stand off the head: little beside the parting, where it is combed flat."""
    return 0.22 + 0.78 * smoothstep(0, 60, np.abs(roots[:, 0] - person.part_side * 1000))


def _gather(points: np.ndarray, apart: np.ndarray, style: _Style, draws: np.random.Generator) -> np.ndarray:
    """Pull every strand towards the leader of its lock, more so towards the tip."""
    leaders = draws.choice(len(points), min(style.locks, len(points)), replace=False)
    place = np.concatenate([points[:, 0], apart[:, None]], axis=1)
    lock = leaders[cKDTree(place[leaders]).query(place)[1]]
    along = np.linspace(0, 1, points.shape[1])[None, :, None]
    own = points - points[:, :1]
    led = points[lock] - points[lock, :1]
    start = points[:, :1] - points[lock, :1]
    loose = np.where(apart > 0, 0.3, 1.0)[:, None, None]  # a fringe hangs evenly
    share = style.gather * along * loose * draws.uniform(0.6, 1.2, (len(points), 1, 1)).clip(max=1)
    target = (
        points[lock, :1]
        + start * (1 - 0.75 * along)
        + led
        * np.linalg.norm(own, axis=2, keepdims=True)
        / (np.linalg.norm(led, axis=2, keepdims=True) + 1e-6)
    )
    return points * (1 - share) + target * share


def _frizz(points: np.ndarray, style: _Style, draws: np.random.Generator) -> np.ndarray:
    """A slow random bend of each strand."""
    along = np.linspace(0, 1, points.shape[1])[None, :, None]
    phase = draws.uniform(0, 2 * np.pi, (len(points), 1, 3))
    waves = draws.uniform(0.5, 1.4, (len(points), 1, 3))
    amount = style.frizz * draws.gamma(2.0, 0.5, (len(points), 1, 1)) * along
    return points + amount * (np.sin(2 * np.pi * waves * along + phase) - np.sin(phase))


def _curl(points: np.ndarray, style: _Style, draws: np.random.Generator) -> np.ndarray:
    """Wind each strand around its own path."""
    forward = unit(np.gradient(points, axis=1))
    across = unit(np.cross(forward, [0.3, 0.9, 0.2]))
    other = np.cross(forward, across)
    along = np.linspace(0, 1, points.shape[1])[None, :, None]
    turns = draws.uniform(2.0, 3.2, (len(points), 1, 1)) * draws.choice([-1, 1], (len(points), 1, 1))
    angle = 2 * np.pi * turns * along + draws.uniform(0, 2 * np.pi, (len(points), 1, 1))
    radius = style.curl * draws.uniform(0.5, 1.3, (len(points), 1, 1)) * np.minimum(1, 3 * along)
    return points + radius * (np.cos(angle) * across + np.sin(angle) * other)


def _clear(ground: Ground, points: np.ndarray, style: _Style) -> np.ndarray:
    """Push points that locks or frizz brought into the head back out."""
    flat = points[:, 1:].reshape(-1, 3)
    normal, height = ground.nearest(flat)
    flat = flat + normal * np.clip(0.5 - height, 0, None)[:, None]
    return np.concatenate([points[:, :1], flat.reshape(len(points), -1, 3)], axis=1)


def _strays(points: np.ndarray, roots: Points, person: PersonParameters) -> np.ndarray:
    """Strands that hang over the forehead and do not belong to a fringe: singly they look like scratches."""
    x, y, z = np.abs(points[..., 0]), points[..., 1], points[..., 2]
    below = hairline(points.reshape(-1, 3), 0.0, 0.0).reshape(x.shape) < -5
    return ((x < 58) & (y > 20) & (z > 20) & below).any(1) & ~_in_fringe(roots, person)


def _knot(ground: Ground, texels: np.ndarray, draws: np.random.Generator):
    """A bun: strands wound around the knot in flat spirals, carried by the scalp nearest to it."""
    count, steps, radius = 2600, 12, 27.0
    carrier = texels[np.argsort(np.linalg.norm(ground.points[texels] - BUN, axis=1), kind="stable")[:50]]
    carrier = draws.choice(carrier, count)
    axis = unit(BUN - np.array([0.0, 70.0, -40.0]))
    across = unit(np.cross(axis, [1.0, 0, 0]))
    other = np.cross(axis, across)
    latitude = draws.uniform(-0.5, 1.5, (count, 1))
    angle = draws.uniform(0, 2 * np.pi, (count, 1)) + np.linspace(0, 1, steps + 1) * draws.uniform(
        1.2, 3.0, (count, 1)
    )
    latitude = latitude + 0.35 * np.sin(angle * 1.5 + draws.uniform(0, 6.28, (count, 1)))
    shell = radius * draws.uniform(0.72, 1.0, (count, 1))
    ring, height = shell * np.cos(latitude), 0.72 * shell * np.sin(latitude)
    around = np.cos(angle)[..., None] * across + np.sin(angle)[..., None] * other
    offset = ring[..., None] * around + height[..., None] * axis
    points = BUN + offset
    points[:, 0] = ground.points[carrier]
    points[:, 1] = points[:, 2] - 0.2 * (points[:, 3] - points[:, 2])
    return carrier, points, unit(offset)


def _lock_tint(roots: Points, person: PersonParameters) -> np.ndarray:
    """A factor (n, 1) on the colour: neighbouring locks are a little lighter or darker."""
    noise = value_noise(roots.astype(np.float32), 7.0, person.seed * 64 + 20, 2)
    return np.exp(0.22 * noise)[:, None]


def _shade(groups, width: float):
    """Occlusion of each group in the density of all of them."""
    steps = max(path.shape[1] for _, path, _ in groups)
    padded = [
        np.concatenate([p, np.repeat(p[:, -1:], steps - p.shape[1], axis=1)], axis=1) for _, p, _ in groups
    ]
    outward = [
        np.concatenate([n, np.repeat(n[:, -1:], steps - n.shape[1], axis=1)], axis=1) for _, _, n in groups
    ]
    light, shade = strand_occlusion(np.concatenate(padded), np.concatenate(outward), width)
    split = np.split(light, np.cumsum([len(p) for p in padded])[:-1])
    return [part[:, : path.shape[1]] for part, (_, path, _) in zip(split, groups)], shade
