"""Skin paint: albedo by absorption of blood and melanin, roughness, shine and relief, texel by texel."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from meshanim.render.look.atlas import Atlas
from meshanim.render.look.groom import GREY
from meshanim.render.look.noise import value_noise
from meshanim.render.look.paint import blob, smoothstep
from meshanim.render.look.person import PersonParameters, skin_color, srgb_to_linear
from meshanim.render.look.regions import beard_mask, brow_curve, brow_halfwidth, hairline

__all__ = ["SkinPaint", "micro_detail", "paint_skin", "paint_tongue"]

EYE_CENTER = (31.1, 33.3, 38.1)
FACE, MOUTH, SOCKETS, NECK = 0, 1, (2, 3), 4
"""Islands of the skin's texture layout."""

BLOOD = np.array([0.05, 0.36, 0.30], np.float32)
MELANIN = np.array([0.30, 0.42, 0.55], np.float32)
"""Absorption of red, green, blue a unit of excess, set by eye: multiplied, so every tone stays plausible."""


@dataclass(frozen=True)
class SkinPaint:
    """What `paint_skin` makes.

    Parameters
    ----------
    skin : (S, S, 8) float32
        The channels of `appearance.SKIN_CHANNELS`.
    height : (S, S) float32
        Relief, metres.
    scalp, beard : (n,) float32
        Where hair grows, one value an active texel of the atlas, in [0, 1].
    """

    skin: Float[np.ndarray, "size size 8"]
    height: Float[np.ndarray, "size size"]
    scalp: Float[np.ndarray, " texels"]
    beard: Float[np.ndarray, " texels"]


class _Canvas:
    """The texels of an atlas in paint space, with the noises and masks that several brushes share."""

    def __init__(self, atlas: Atlas, person: PersonParameters):
        self.atlas, self.person = atlas, person
        self.points = atlas.position * np.float32(1000)
        self.x, self.y, self.z = self.points.T
        self.side = np.abs(self.x)
        self.fair = 1 - person.tone
        self.base = skin_color(person.tone, person.undertone).astype(np.float32)
        island = atlas.island
        self.face = (island == FACE).astype(np.float32)
        self.outer = ((island == FACE) | (island == NECK)).astype(np.float32)
        self.lining = (island == MOUTH).astype(np.float32)
        self.socket = np.isin(island, SOCKETS).astype(np.float32)
        front = smoothstep(58, 66, self.z) * self.lining
        self.lips = smoothstep(0.10, 0.95, atlas.masks["lips"]) * self.face + front
        self.lip_soft = atlas.masks["lips"] * self.face
        self.mouth = self.lining * (1 - front)
        self.broad = self.noise(40, 3, 3)
        self.blotch = self.noise(18, 0, 3)
        self.fine = self.noise(5.3, 1, 2)
        self.grain = self.noise(1.43, 2, 2)

    def noise(self, cell: float, channel: int, octaves: int = 1, stretch=(1.0, 1.0, 1.0)) -> np.ndarray:
        return value_noise(self.points, cell, self.person.seed * 64 + channel, octaves, stretch)

    def blob(self, center, spread) -> np.ndarray:
        return blob(self.points, center, spread)


def paint_skin(atlas: Atlas, person: PersonParameters) -> SkinPaint:
    """Paint one person's skin on the default head's atlas (the recipe and its numbers are in docs/look.md).

    Parameters
    ----------
    atlas : Atlas
        Of the default head's skin.
    person : PersonParameters
    """
    canvas = _Canvas(atlas, person)
    draws = np.random.default_rng([person.seed, 1])
    albedo = canvas.base * _tint(canvas)
    albedo = _spots(canvas, albedo, draws)
    lip_lines = canvas.noise(0.67, 6, 2, (1.0, 0.10, 0.20))
    albedo = _lips(canvas, albedo, lip_lines)
    albedo, wet = _openings(canvas, albedo)
    scalp, beard, albedo = _hair_shadow(canvas, albedo)
    roughness, specular, height = _relief(canvas, lip_lines, scalp, wet)

    detail = canvas.outer * (1 - 0.75 * smoothstep(0.15, 0.75, canvas.lip_soft)) * (1 - 0.5 * scalp)
    scatter = np.clip(1 - 0.35 * canvas.lips - canvas.mouth * 0.5 - 0.8 * scalp, 0, 1)
    skin = np.empty((len(albedo), 8), np.float32)
    skin[:, :3] = np.clip(albedo, 0.002, 0.95)
    for channel, values in enumerate((roughness, specular, canvas.mouth, detail, scatter), start=3):
        skin[:, channel] = values
    return SkinPaint(atlas.image(skin), atlas.image(height), scalp, beard)


def paint_tongue(atlas: Atlas, person: PersonParameters, paint: SkinPaint) -> None:
    """Paint the tongue into the free part of the skin's textures, in place.

    Parameters
    ----------
    atlas : Atlas
        Of the tongue, in the layout of the skin's.
    person : PersonParameters
    paint : SkinPaint
    """
    points = atlas.position * np.float32(1000)
    seed = person.seed * 64
    blotch, papillae = value_noise(points, 4.5, seed + 15, 2), value_noise(points, 0.7, seed + 14, 2)
    groove = np.exp(-((points[:, 0] / 2.2) ** 2)) * smoothstep(0.2, 0.7, atlas.normal[:, 1])
    coating = smoothstep(0.3, 0.9, atlas.normal[:, 1]) * smoothstep(55, 30, points[:, 2])
    albedo = srgb_to_linear((0.75, 0.39, 0.38)) * (1 + 0.10 * papillae + 0.12 * blotch)[:, None]
    albedo = albedo * (1 - 0.22 * groove[:, None]) * (1 + coating[:, None] * np.array([0.05, 0.25, 0.22]))
    # Little light reaches the root of the tongue and its flanks beside the teeth.
    albedo = albedo * (0.25 + 0.75 * smoothstep(8, 48, points[:, 2]))[:, None]
    albedo = albedo * (0.55 + 0.45 * smoothstep(21, 12, np.abs(points[:, 0])))[:, None]
    paint.skin[atlas.active, :3] = np.clip(albedo, 0.002, 0.95)
    paint.skin[atlas.active, 3:] = np.array([0.32, 1.0, 0.85, 0.2, 0.6])
    paint.height[atlas.active] = 1.2e-4 * papillae * (1 - 0.5 * groove) - 4e-4 * groove


def micro_detail(size: int = 256) -> Float[np.ndarray, "size size 2"]:
    """A periodic tile of skin grain, as slopes along u and v: the same for everyone."""
    draws = np.random.default_rng(7)
    rough, pits = (
        gaussian_filter(draws.normal(size=(size, size)), width, mode="wrap") for width in (1.3, 2.6)
    )
    height = 0.35 * rough / rough.std() - 1.1 * np.clip(pits / pits.std() - 0.7, 0, 2)
    slope_u = np.roll(height, -1, 1) - np.roll(height, 1, 1)
    slope_v = np.roll(height, 1, 0) - np.roll(height, -1, 0)
    return np.ascontiguousarray(np.stack([slope_u, slope_v], axis=2) * 0.16, np.float32)


def _tint(canvas: _Canvas) -> np.ndarray:
    """Transmittance (n, 3) of the excess of blood and melanin over the base tone."""
    person, blob = canvas.person, canvas.blob
    y, z, side = canvas.y, canvas.z, canvas.side
    blood = 0.15 * canvas.fine + 0.15 * canvas.blotch + 0.07 * canvas.grain
    blood += person.blush * (
        0.85 * blob((45, -2, 38), (17, 14, 30))
        + 0.45 * blob((0, -8, 78), (14, 10, 12))
        + 0.25 * blob((0, -68, 60), (16, 12, 20))
    )
    blood += 0.5 * canvas.atlas.masks["ears"] + 0.22 * blob((16, -12, 65), (6, 6, 20))
    around_eye = np.sqrt(((side - EYE_CENTER[0]) / 22) ** 2 + ((y - 32.5) / 11.5) ** 2)
    lid = np.exp(-3 * np.clip(around_eye - 0.55, 0, None) ** 2) * (z > 25)
    blood += lid * (0.30 + 0.15 * canvas.blotch)

    melanin = 0.14 * canvas.blotch + 0.10 * canvas.fine + 0.08 * canvas.grain + 0.25 * person.tone * lid
    melanin += (0.18 + 0.25 * person.age) * blob((28, 18.5, 50), (11, 3.5, 20))
    melanin += 0.10 * smoothstep(50, 90, y) * canvas.face + 0.12 * smoothstep(-75, -95, y)
    melanin -= 0.05 * blob((30, 0, 50), (20, 12, 30))
    if person.age > 0.5:  # age spots
        melanin += 0.5 * (person.age - 0.5) * canvas.fair * smoothstep(0.42, 0.5, canvas.noise(9, 5, 2))
    blood = np.clip(blood, -0.5, 1.4)[:, None]
    return np.exp(
        -blood * BLOOD * np.float32(0.45 + 0.75 * canvas.fair)
        - melanin[:, None] * MELANIN * np.float32(0.6 + 0.3 * person.tone)
    )


def _spots(canvas: _Canvas, albedo: np.ndarray, draws: np.random.Generator) -> np.ndarray:
    """Freckles by a Poisson process over nose, cheeks and forehead; moles anywhere on the front."""
    person, points, blob = canvas.person, canvas.points, canvas.blob
    bare = 1 - canvas.lips
    count = round(2600 * person.freckles)
    if count:
        density = 1.2 * blob((0, 12, 75), (12, 14, 30)) + blob((36, 6, 40), (18, 12, 30))
        density = (density + 0.25 * blob((20, 65, 60), (35, 20, 30)) + 0.08) * canvas.face * bare
        density = density * (canvas.z > -30)
        centers = points[draws.choice(len(points), count, p=_distribution(density))]
        radius = draws.gamma(2.5, 0.13, count) + 0.28
        strength = draws.uniform(0.15, 1, count) ** 1.5
        near = np.flatnonzero(canvas.face * (canvas.z > -36) > 0)
        distance, spot = cKDTree(centers).query(points[near], k=min(2, count), distance_upper_bound=4)
        distance, spot = distance.reshape(len(near), -1), np.minimum(spot, count - 1).reshape(len(near), -1)
        ink = (strength[spot] * np.exp(-((np.minimum(distance, 9) / radius[spot]) ** 2))).sum(1)
        ink = np.clip(ink, 0, 1)[:, None] * np.array([0.36, 0.58, 0.74]) * (0.8 - 0.3 * person.tone)
        albedo[near] *= np.exp(-ink).astype(np.float32)
    if person.moles:
        density = canvas.outer * bare * (canvas.z > -60)
        centers = points[draws.choice(len(points), person.moles, p=_distribution(density))]
        radius = draws.uniform(0.5, 1.1, person.moles)
        distance, spot = cKDTree(centers).query(points, distance_upper_bound=3)
        mark = np.exp(-((np.minimum(distance, 9) / radius[np.minimum(spot, person.moles - 1)]) ** 4))
        albedo = albedo * (1 - 0.62 * mark[:, None] * np.array([0.7, 0.95, 1.0]))
    return albedo.astype(np.float32, copy=False)


def _distribution(density: np.ndarray) -> np.ndarray:
    density = density.astype(float)
    return density / density.sum()


def _lips(canvas: _Canvas, albedo: np.ndarray, lines: np.ndarray) -> np.ndarray:
    """Lips over the mouth's lining, which darkens towards the throat."""
    person = canvas.person
    tint = np.array([0.85, 0.58, 0.56]) * canvas.fair + np.array([0.94, 0.70, 0.72]) * person.tone
    natural = canvas.base * (1 - (1 - tint) * (1 - 0.35 * person.masculinity))
    color = natural * (1 - person.lip_amount) + srgb_to_linear(person.lip_color) * person.lip_amount
    upper = smoothstep(-42, -38, canvas.y)
    shade = (1 + 0.12 * lines + 0.12 * canvas.fine + 0.10 * canvas.blotch) * (1 - 0.10 * upper)
    shade = shade * (1 - 0.25 * canvas.lining)
    lips = canvas.lips[:, None]
    deep = smoothstep(55, -10, canvas.z)
    flesh = (
        np.array([0.32, 0.085, 0.08], np.float32) * ((1 + 0.25 * canvas.fine) * (1 - 0.75 * deep))[:, None]
    )
    albedo = np.where(canvas.lining[:, None] > 0, flesh, albedo)
    albedo = albedo * (1 - lips) + (color.astype(np.float32) * shade[:, None]) * lips
    # the vermilion border catches light, fair skin only
    border = smoothstep(0.02, 0.25, canvas.lip_soft) * (1 - smoothstep(0.25, 0.75, canvas.lip_soft))
    return albedo * (1 + 0.04 * border * canvas.fair)[:, None]


def _openings(canvas: _Canvas, albedo: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Eye sockets, wet lid rims, nostrils; also returns the wet mask (n,)."""
    fair = canvas.fair
    pink = srgb_to_linear((0.80, 0.47, 0.41)).astype(np.float32) * np.float32(0.55 + 0.45 * fair)
    socket = canvas.socket[:, None]
    albedo = albedo * (1 - socket) + pink * (1 + 0.2 * canvas.fine)[:, None] * socket

    from_eye = np.linalg.norm(
        np.stack([canvas.side, canvas.y, canvas.z], axis=1) - np.array(EYE_CENTER, np.float32), axis=1
    )
    rim = canvas.atlas.masks["eyelids"] * smoothstep(19.2, 18.0, from_eye) * canvas.face
    wet_color = srgb_to_linear((0.745, 0.41, 0.37)) * (0.18 + 0.82 * fair**1.2)
    albedo = albedo * (1 - 0.45 * rim[:, None]) + wet_color.astype(np.float32) * (0.45 * rim[:, None])
    if canvas.person.liner > 0:
        line = smoothstep(20.6, 19.4, from_eye) * smoothstep(17.6, 18.6, from_eye)
        line = line * canvas.atlas.masks["eyelids"] * canvas.face * (canvas.y > 30)
        albedo = albedo * (1 - 0.9 * canvas.person.liner * line)[:, None]
    nostril = canvas.blob((7.8, -16.5, 67.5), (2.6, 3.0, 4.2)) * canvas.face
    nostril = np.clip(1.15 * nostril * smoothstep(0.05, -0.45, canvas.atlas.normal[:, 1]), 0, 0.93)
    return albedo * (1 - nostril[:, None] * np.array([0.72, 0.92, 0.94], np.float32)), rim


def _hair_shadow(canvas: _Canvas, albedo: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Scalp and beard masks, and the albedo with the colour of dense roots under scalp, brows and beard."""
    person, base = canvas.person, canvas.base
    hair = _grown(person)
    ears = canvas.atlas.masks["ears"]
    has_hair = float(person.hair != "none")
    edge = hairline(canvas.points, person.baldness, person.masculinity) + 5 * canvas.fine + 2 * canvas.grain
    scalp = smoothstep(-6, 10, edge) * canvas.outer * (1 - ears) * has_hair
    if has_hair:
        scalp = scalp * _away_from_ears(canvas)
    cover, skin_share = (0.86, 0.05) if person.hair == "buzz" else (0.95, 0.012)
    under = cover * scalp[:, None]
    albedo = albedo * (1 - under) + (0.40 * hair + skin_share * base) * under

    brow = _brow_shadow(canvas)[:, None]
    brow_color = srgb_to_linear(person.brow_color) if person.brow_color else hair
    albedo = albedo * (1 - 0.62 * brow) + (0.6 * brow_color + 0.12 * base) * (0.62 * brow)

    beard = beard_mask(canvas.points) * canvas.outer * (1 - canvas.lips)
    if person.stubble > 0:
        dots = smoothstep(0.0, 0.6, canvas.noise(0.48, 8))
        strength = person.stubble * beard * np.clip(0.42 + 0.30 * dots + 0.25 * canvas.fine, 0, 1)
        roots = base * np.array([0.36, 0.42, 0.50]) * 0.6 + 0.4 * hair
        albedo = albedo * (1 - strength[:, None]) + roots * strength[:, None]
    return scalp, beard, albedo.astype(np.float32, copy=False)


def _grown(person: PersonParameters) -> np.ndarray:
    """Mean linear colour of the hair, grey strands included."""
    pigment = srgb_to_linear(person.hair_color)
    return (pigment * (1 - person.hair_grey) + 0.26 * GREY * person.hair_grey).astype(np.float32)


def _away_from_ears(canvas: _Canvas) -> np.ndarray:
    ears = canvas.points[canvas.atlas.masks["ears"] > 0.5]
    distance = np.full(len(canvas.points), 30.0, np.float32)
    if len(ears):
        low, high = ears.min(0) - 6, ears.max(0) + 6
        mirrored = np.abs(canvas.points) * [1, 0, 0] + canvas.points * [0, 1, 1]
        low[0] = np.abs(ears[:, 0]).min() - 6
        near = np.flatnonzero(((mirrored > low) & (mirrored < high)).all(1))
        distance[near] = cKDTree(ears[::3]).query(canvas.points[near], distance_upper_bound=30)[0]
    return smoothstep(1.5, 5, np.minimum(distance, 30))


def _brow_shadow(canvas: _Canvas) -> np.ndarray:
    person = canvas.person
    along = np.linspace(0, 1, 60)
    curve = np.stack(brow_curve(along, person.brow_arch), axis=1)
    width = brow_halfwidth(along) * person.brow_thickness
    shadow = np.zeros(len(canvas.points), np.float32)
    near = np.flatnonzero(
        (canvas.z > 10) & (np.abs(canvas.y - 53) < 20) & (canvas.side < 65) & (canvas.face > 0)
    )
    distance, nearest = cKDTree(curve).query(np.stack([canvas.side[near], canvas.y[near]], axis=1))
    patchy = np.clip(0.65 + 0.8 * canvas.noise(2.4, 11, 2)[near], 0, 1)
    shadow[near] = np.exp(-1.2 * (distance / width[nearest]) ** 2) * min(1.0, person.brow_density) * patchy
    return shadow


def _relief(
    canvas: _Canvas, lip_lines: np.ndarray, scalp: np.ndarray, wet: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Roughness, specular scale and height (metres), each (n,)."""
    person, blob, lips = canvas.person, canvas.blob, canvas.lips
    shiny = blob((0, 10, 75), (16, 30, 30)) + 0.8 * blob((0, 75, 60), (40, 20, 30))
    shiny = shiny + 0.5 * blob((36, 8, 40), (15, 10, 30)) + 0.4 * blob((0, -68, 60), (15, 10, 30))
    shiny = np.clip(shiny, 0, 1)
    moist = (canvas.mouth > 0.5) | (canvas.socket > 0)

    roughness = 0.55 - 0.13 * person.oil * shiny + 0.05 * canvas.grain + 0.05 * canvas.blotch
    roughness = np.clip(roughness - 0.10 * lips + 0.12 * scalp, 0.2, 0.8)
    roughness = np.where(moist, 0.28, np.where(wet > 0.3, 0.25, roughness))
    specular = 0.70 + 0.35 * person.oil * shiny + 0.25 * canvas.fine + 0.15 * canvas.grain - 0.55 * scalp
    specular = np.clip(specular, 0.05, 1.6) + 0.10 * lips

    pores = np.clip(canvas.noise(0.67, 9) - 0.12, 0, 1)
    weave = canvas.noise(1.54, 10, 2)
    zone = 0.5 + 0.9 * blob((20, 0, 60), (20, 13, 30)) + 0.5 * shiny
    zone = zone * (1 - lips) * canvas.face + 0.25 * canvas.outer * (1 - canvas.face)
    height = -1.1e-4 * pores * zone + 0.35e-4 * weave * (1 - 0.5 * lips) + 1.5e-4 * lip_lines * lips
    height = height + (1 - lips) * (0.6e-4 * canvas.fine * person.age + person.age**2 * _sagging(canvas))
    height = np.where(canvas.lining > 0, 0.8e-4 * canvas.fine + 1.0e-4 * lip_lines * lips, height)
    return roughness, specular, np.where(canvas.socket > 0, 0, height)


def _sagging(canvas: _Canvas) -> np.ndarray:
    """Relief of old age that no expression drives: lines down from the mouth corners, rings of the neck."""
    side, y = canvas.side, canvas.y
    along = np.clip((-46 - y) / 26, -0.5, 1.5)
    corner = smoothstep(-0.1, 0.2, along) * smoothstep(1.1, 0.6, along) * (canvas.z > 20)
    lines = 5.5e-4 * corner * _valley(side - (25 + 4 * along + 0.5 * canvas.blotch), 1.8)
    sway = y + 1.5 * canvas.broad + 2 * canvas.blotch
    rings = sum(_valley(sway - level - 0.004 * side**2, 1.6) for level in (-96.0, -110.0, -121.0))
    fold = 4e-4 * rings * smoothstep(-70, -40, canvas.z) * smoothstep(60, 35, side) * canvas.outer
    bag = 4e-4 * canvas.blob((30, 17, 50), (11, 3, 20)) - 3e-4 * canvas.blob((30, 11, 50), (13, 2, 20))
    return lines + fold + bag * canvas.face


def _valley(distance: np.ndarray, width: float) -> np.ndarray:
    return -np.exp(-((distance / width) ** 2))
