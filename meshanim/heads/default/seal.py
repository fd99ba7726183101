"""The lip seal: a delta, linear in identity, that brings the lips of every person together.

The lips of the base mesh are concentric closed edge loops. Along the loop where they meet, the gap between
the upper and the lower lip at a given x is linear in the vertices, hence linear in the identity coefficients,
and so is the delta that closes it: no image and no solve is needed at run time.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from meshanim.errors import MeshError
from meshanim.heads.default.crop import edge_loop

__all__ = ["LipLine", "lip_line", "seal_directions"]

# Vertical overlap of the sealed lips, metres: with 1.0 mm nothing of the mouth's inside is seen on any of 60
# people; with 0.4 mm, up to 6 square millimetres.
OVERLAP = 0.001
# The closing is shared between the lips: the lower one moves more.
LOWER_SHARE = 0.6
# Full within the first distance (metres) of the line of contact, then a Gaussian of the second.
FALL_OFF = (0.003, 0.006)
# The front of the mouth (z, metres) where the push sets in, and over how much it grows.
FRONT = (0.028, 0.012)
# Columns: spacing and the part of the mouth's width that they span.
SPACING, SPAN = 0.001, 0.97
# jawOpen travel that tells upper lip from lower lip, metres.
SPLIT = (0.0105, 0.0145)


@dataclass(frozen=True)
class LipLine:
    """The edge loop along which the lips meet, cut at the corners of the mouth; both from -x to +x."""

    upper: Int[np.ndarray, " upper"]
    lower: Int[np.ndarray, " lower"]

    def middle_pairs(
        self, vertices: Float[np.ndarray, "vertices 3"], width: float = 0.016
    ) -> Int[np.ndarray, "pairs 2"]:
        """Upper and lower vertices nearest to each other in x, within `width` (metres) of the middle."""
        distance = np.abs(vertices[self.upper, None, 0] - vertices[None, self.lower, 0])
        nearest_lower, nearest_upper = distance.argmin(1), distance.argmin(0)
        mutual = nearest_upper[nearest_lower] == np.arange(len(self.upper))
        mutual &= np.abs(vertices[self.upper, 0]) < width
        return np.stack([self.upper[mutual], self.lower[nearest_lower[mutual]]], axis=1)


def lip_line(vertices: Float[np.ndarray, "vertices 3"], quads: Int[np.ndarray, "quads 4"]) -> LipLine:
    """Find the loop of the lips whose upper and lower middle are closest together."""
    edges = np.unique(np.sort(np.concatenate([quads[:, [k, (k + 1) % 4]] for k in range(4)]), 1), axis=0)
    x, y, z = vertices.T
    candidates = np.flatnonzero((np.abs(x) < 1e-4) & (np.abs(y + 0.035) < 0.008) & (z > 0.06))
    best: tuple[float, list[int]] | None = None
    for start in candidates.tolist():
        ends = edges[(edges == start).any(1)].sum(1) - start
        loop = next((edge_loop(quads, start, int(end)) for end in ends if x[end] > 1e-4), None)
        if loop is None:
            continue
        height = y[start] - y[loop[len(loop) // 2]]
        if height > 0 and (best is None or height < best[0]):
            best = height, loop
    if best is None:
        raise MeshError("no closed edge loop round the lips: is this MakeHuman's base mesh?")
    ring = np.array(best[1])
    left, right = x[ring].argmax(), x[ring].argmin()
    upper = np.concatenate([ring[right:], ring[: left + 1]])
    return LipLine(upper, ring[left : right + 1][::-1])


def seal_directions(
    template: Float[np.ndarray, "vertices 3"],
    shapes: Float[np.ndarray, "shapes vertices 3"],
    jaw_open: Float[np.ndarray, "vertices 3"],
    mouth_close: Float[np.ndarray, "vertices 3"],
    line: LipLine,
    skin: int,
) -> Float[np.ndarray, "directions vertices 3"]:
    """Delta of the template's lip seal, then its change with each identity coefficient.

    First as much of the shape mouthClose as closes the middle of the mouth on average, then a vertical push
    that brings each column of the lips to the wanted overlap. With jawOpen at j, the lips are closed at
    mouthClose = j and lipSeal = 1.
    """
    pairs = line.middle_pairs(template)
    positions = np.concatenate([template[None], shapes])

    def pair_gap(offsets: np.ndarray) -> np.ndarray:
        return (offsets[..., pairs[:, 0], 1] - offsets[..., pairs[:, 1], 1]).mean(-1)

    amount = -pair_gap(positions) / pair_gap(mouth_close)
    delta = amount[:, None, None] * mouth_close

    x, y, z = template.T
    upper, lower = line.upper, line.lower
    half = SPAN * x[upper].max()
    columns = np.linspace(-half, half, int(2 * half / SPACING) + 1)
    closed = positions + delta
    opening = np.stack(
        [
            np.interp(columns, x[upper], heights[upper, 1]) - np.interp(columns, x[lower], heights[lower, 1])
            for heights in closed
        ]
    )
    opening[0] += OVERLAP

    contact = (np.interp(x, x[upper], y[upper]) + np.interp(x, x[lower], y[lower])) / 2
    fall = np.exp(-((np.maximum(np.abs(y - contact) - FALL_OFF[0], 0) / FALL_OFF[1]) ** 2))
    fall *= np.clip((z - FRONT[0]) / FRONT[1], 0, 1)
    fall *= np.clip(1 - (np.abs(x) - half) / FALL_OFF[1], 0, 1)
    fall[skin:] = 0
    is_lower = np.clip((-jaw_open[:, 1] - SPLIT[0]) / (SPLIT[1] - SPLIT[0]), 0, 1)
    share = is_lower * LOWER_SHARE - (1 - is_lower) * (1 - LOWER_SHARE)
    push = np.stack([np.interp(x, columns, row) for row in opening])
    delta[:, :, 1] += push * fall * share
    return delta
