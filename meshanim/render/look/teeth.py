"""Teeth: twelve crowns and the gum of each jaw, swept along the arch of the head's own teeth strip."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.interpolate import CubicSpline

from meshanim.render.look.eyes import similarity
from meshanim.render.look.noise import value_noise
from meshanim.render.look.paint import smoothstep
from meshanim.render.look.person import PersonParameters, srgb_to_linear

__all__ = ["Teeth", "make_teeth", "pose_teeth"]

# Crown widths and heights from the middle outwards, millimetres (two incisors, canine, two premolars, molar),
# rounded from a dental table.
_WIDTH = {"upper": [8.6, 6.7, 7.7, 7.2, 6.9, 10.2], "lower": [5.5, 6.0, 7.0, 7.2, 7.3, 10.8]}
_HEIGHT = {"upper": [10.4, 9.1, 10.2, 8.6, 8.0, 7.4], "lower": [8.6, 8.9, 9.9, 8.6, 8.0, 7.6]}
_POINTED = np.array([0.10, 0.16, 0.34, 0.30, 0.25, 0.22])
_GUM_HEIGHT = {"upper": 6.8, "lower": 5.5}

# Rows of the sweep: top of the gum (-0.75), gum line (0), edge (1), back of the tooth (1.6).
_ROWS = np.concatenate(
    [np.linspace(-0.75, -0.04, 7), np.linspace(0, 0.8, 9), np.linspace(0.86, 1, 5), np.linspace(1.04, 1.6, 5)]
)
_COLUMNS = 15
_TEXTURE = (192, 768)


@dataclass(frozen=True)
class Teeth:
    """One jaw of one person.

    Parameters
    ----------
    jaw : str
        `upper` or `lower`.
    vertices : (n, 3) float32
        At rest, metres.
    faces : (f, 3) int32
    uv : (n, 2) float32
        Into `texture`; v points up.
    texture : (H, W, 4) float32
        Linear albedo and roughness.
    anchors : (m,) int64
        The head's vertices that carry this jaw.
    rest : (m, 3) float32
        Their positions on the person's resting head.
    """

    jaw: str
    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    uv: Float[np.ndarray, "vertices 2"]
    texture: Float[np.ndarray, "height width 4"]
    anchors: Int[np.ndarray, " anchors"]
    rest: Float[np.ndarray, "anchors 3"]


def pose_teeth(
    teeth: Teeth, head_vertices: Float[np.ndarray, "head_vertices 3"]
) -> Float[np.ndarray, "vertices 3"]:
    """Teeth on a moved head: the rigid motion (and scale) of their anchors."""
    scale, rotation, translation = similarity(teeth.rest, np.asarray(head_vertices)[teeth.anchors])
    return (scale * teeth.vertices @ rotation.T + translation).astype(np.float32)


def make_teeth(
    jaw: str,
    anchors: Int[np.ndarray, " anchors"],
    mean_vertices: Float[np.ndarray, "head_vertices 3"],
    head_vertices: Float[np.ndarray, "head_vertices 3"],
    person: PersonParameters,
) -> Teeth:
    """Crowns and gums along the arch of the head's teeth strip.

    Parameters
    ----------
    jaw : str
        `upper` or `lower`.
    anchors : (m,) int
        The strip's vertices in the head.
    mean_vertices, head_vertices : (V, 3) float
        The mean head, on which the strip's columns are told apart, and the person's, both at rest.
    person : PersonParameters
        `seed` and `tooth_yellow` matter.
    """
    draws = np.random.default_rng([person.seed, 3, jaw == "lower"])
    rest = np.asarray(head_vertices, float)[anchors]
    middle, edge = _arch(np.asarray(mean_vertices, float)[anchors], rest, jaw)
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(middle[:, [0, 2]], axis=0), axis=1))])
    length -= length[-1] / 2
    arch = CubicSpline(length, middle)

    width, height = np.array(_WIDTH[jaw]), np.array(_HEIGHT[jaw]) * 1e-3
    width = width * min(1.08e-3, 0.99 * length[-1] / width.sum())
    ends = np.concatenate([[0], np.cumsum(width)])
    half = (ends[:-1, None] + width[:, None] * (np.arange(_COLUMNS) + 0.5) / _COLUMNS).ravel()
    along = np.concatenate([-half[::-1], half])
    kind = np.clip(np.searchsorted(ends, np.abs(along)) - 1, 0, 5)
    across = (np.abs(along) - ends[kind]) / width[kind] * 2 - 1
    tooth = np.where(along < 0, 5 - kind, 6 + kind)

    drop, out = _profile(jaw, across[:, None], kind, height)
    tangent = arch(along, 1) * [1, 0, 1]
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    outward = np.stack([-tangent[:, 2], 0 * along, tangent[:, 0]], axis=1)
    sign = -1.0 if jaw == "upper" else 1.0
    jitter = draws.normal(0, 0.00022, (2, 12))[:, tooth]
    vertices = arch(along)[:, None] * [1, 0, 1] + outward[:, None] * (out + jitter[0][:, None])[..., None]
    vertices[..., 2] -= 0.0012 * sign
    # The strip climbs steeply at its ends; a dental arch hardly does (curve of Spee).
    front = np.interp(0.0, length, edge)
    level = front + 0.3 * (np.interp(along, length, edge) - front) + jitter[1]
    vertices[..., 1] = level[:, None] + sign * (drop - height[kind][:, None])

    columns, rows = vertices.shape[:2]
    corner = np.arange(columns - 1)[:, None] * rows + np.arange(rows - 1)[None]
    quads = np.stack([corner, corner + 1, corner + rows + 1, corner + rows], axis=-1).reshape(-1, 4)
    if jaw == "lower":
        quads = quads[:, ::-1]
    grid = np.stack(
        np.broadcast_arrays(
            ((np.arange(columns) + 0.5) / columns)[:, None], (_ROWS - _ROWS[0]) / (_ROWS[-1] - _ROWS[0])
        ),
        axis=-1,
    )
    return Teeth(
        jaw,
        vertices.reshape(-1, 3).astype(np.float32),
        np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.int32),
        grid.reshape(-1, 2).astype(np.float32),
        _texture(person, jaw, draws),
        np.asarray(anchors),
        rest.astype(np.float32),
    )


def _arch(mean: np.ndarray, rest: np.ndarray, jaw: str) -> tuple[np.ndarray, np.ndarray]:
    """Middle line (c, 3) of the strip's outer side, right to left, symmetric, and its edge's height.

    The outer side is three vertices a column; it is told from the inner one by its distance from the middle
    of the arch on the mean head.
    """
    center = 0.0174 if jaw == "upper" else 0.0162
    forward = mean[:, 2] - center
    angle, radius = np.arctan2(mean[:, 0], forward), np.hypot(mean[:, 0], forward)
    outer = radius > np.interp(np.abs(angle), [0, 0.5, 1.0, 1.6], [0.0400, 0.0375, 0.0325, 0.029])
    ordered = np.flatnonzero(outer)[np.argsort(angle[outer], kind="stable")]
    columns = rest[ordered[: len(ordered) // 3 * 3]].reshape(-1, 3, 3)
    middle = columns.mean(1)
    middle = (middle + middle[::-1] * [-1, 1, 1]) / 2
    edge = columns[..., 1].min(1) if jaw == "upper" else columns[..., 1].max(1)
    return middle, (edge + edge[::-1]) / 2


def _profile(
    jaw: str, across: np.ndarray, kind: np.ndarray, heights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distance along the tooth from the gum line and outwards from the arch, metres, (columns, rows)."""
    row, height, pointed = _ROWS[None], heights[kind][:, None], _POINTED[kind][:, None]
    crown, back = np.clip(row, 0, 1), np.clip(row - 1, 0, 1)
    papilla = 0.20 * np.abs(across) ** 2.2 * height
    edge = 1 - 0.55 * pointed * np.abs(across) ** 2.6
    gum = row * _GUM_HEIGHT[jaw] * 1e-3 + papilla * np.exp(3 * np.minimum(row, 0))
    tooth = crown * height * (1 - (1 - edge) * crown**3) + papilla * (1 - crown) ** 2
    drop = np.where(row <= 0, gum, tooth) - 1.1 * back * height

    round_ = np.sqrt(np.clip(1 - np.abs(across) ** 3.2, 0, 1))
    recede = 0.0024 if jaw == "upper" else 0.0016
    gum_out = 0.0013 + 0.0005 * np.exp(-((row / 0.12) ** 2)) - 0.0006 * across**2
    gum_out = gum_out - recede * smoothstep(-0.1, -0.75, row)
    tooth_out = 0.00168 * np.sin(np.pi * (0.30 + 0.42 * crown)) * round_ - 0.0021 * crown**2
    tooth_out = tooth_out - 0.0016 * (1 - round_)
    return drop, np.where(row <= 0, gum_out, tooth_out) - 0.0075 * back


def _texture(person: PersonParameters, jaw: str, draws: np.random.Generator) -> np.ndarray:
    """Linear albedo and roughness over the sweep: enamel, gaps, gums."""
    rows, columns = _TEXTURE
    row = _ROWS[0] + (_ROWS[-1] - _ROWS[0]) * (1 - (np.arange(rows) + 0.5) / rows)[:, None]
    place = (np.arange(columns) + 0.5) / columns * 12
    tooth, across = place.astype(int), (place % 1) * 2 - 1
    at = np.stack(np.broadcast_arrays(7 * place, 9 * row, np.zeros((1, 1))), axis=-1).reshape(-1, 3)
    speckle = value_noise(at, 2.0, person.seed * 64 + 12, 2).reshape(rows, columns, 1)
    veins = value_noise(at, 2.9, person.seed * 64 + 13, 2).reshape(rows, columns, 1)
    bright, yellow = srgb_to_linear((0.933, 0.898, 0.831)), srgb_to_linear((0.871, 0.769, 0.580))
    enamel = bright * (1 - person.tooth_yellow) + yellow * person.tooth_yellow
    enamel = enamel * (1 + draws.normal(0, 0.035, 12)[tooth])[:, None]
    crown = np.clip(row, 0, 1)[..., None]
    enamel = enamel * (1 - 0.22 * (1 - smoothstep(0, 0.5, crown)) * [0.2, 0.5, 1.0])
    enamel = enamel * (1 - 0.25 * smoothstep(0.80, 1.0, crown) * [1.0, 0.85, 0.6]) * (1 + 0.05 * speckle)
    gap = (smoothstep(0.80, 1.0, np.abs(across)) * smoothstep(-0.02, 0.1, row))[..., None]
    enamel = enamel * (1 - 0.80 * gap * [0.8, 0.93, 1.0])
    gum = srgb_to_linear((0.769, 0.439, 0.424)) * (1 + 0.25 * veins)
    gum = gum * (1 - 0.25 * smoothstep(-0.2, -0.75, row))[..., None]
    is_gum = smoothstep(0.035, -0.03, row)[..., None] + np.zeros((rows, columns, 1))
    texture = np.concatenate([enamel * (1 - is_gum) + gum * is_gum, 0.16 + 0.12 * is_gum], axis=2)
    return np.ascontiguousarray(texture, np.float32)
