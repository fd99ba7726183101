"""What the lips do: aperture, mouth-opening error, and whether bilabials close."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from meshanim.errors import OptionError
from meshanim.training.metrics.checks import checked_pair, chosen

__all__ = ["aperture_extremes", "bilabial_closure", "lip_aperture", "mouth_opening_error"]

Vertices = Float[Tensor, "frames vertices 3"]
TrueVertices = Float[Tensor, "true_frames vertices 3"]
Pairs = Int[Tensor, "pairs 2"]
Spans = Sequence[tuple[float, float]]


def lip_aperture(vertices: Vertices, lip_pairs: Pairs) -> Float[Tensor, " frames"]:
    """Height of the widest gap between paired upper and lower lip vertices; negative if they overlap.

    Parameters
    ----------
    vertices : (T, V, 3)
        Zero pose, y up.
    lip_pairs : (P, 2) int
        Upper and lower vertex of each pair.
    """
    lips = chosen(vertices, lip_pairs.flatten())[..., 1].unflatten(1, (-1, 2))
    return (lips[..., 0] - lips[..., 1]).amax(1)


def mouth_opening_error(predicted: Vertices, true: TrueVertices, lip_pairs: Pairs) -> Float[Tensor, ""]:
    """Mean over frames of the difference of the lip apertures' magnitude (cf. DiffPoseTalk's MOD).

    Parameters
    ----------
    predicted, true : (T, V, 3)
        The same unit and length, zero pose.
    lip_pairs : (P, 2) int
        As in `lip_aperture`.
    """
    checked_pair(predicted, true, lip_pairs.flatten())
    return (lip_aperture(predicted, lip_pairs) - lip_aperture(true, lip_pairs)).abs().mean()


def aperture_extremes(
    vertices: Vertices, lip_pairs: Pairs, spans: Spans, fps: float
) -> tuple[Float[Tensor, " spans"], Float[Tensor, " spans"]]:
    """Smallest and largest lip aperture within each span, one frame of slack at either side.

    Parameters
    ----------
    vertices : (T, V, 3)
        Zero pose.
    lip_pairs : (P, 2) int
        Upper and lower vertices of the mouth's middle.
    spans : sequence of (start, end)
        Seconds; spans past the last frame are left out.
    fps : float
        Frames a second.

    Raises
    ------
    OptionError
        If the rate is not positive.
    """
    if not fps > 0:
        raise OptionError(f"fps must be positive, not {fps}")
    aperture = lip_aperture(vertices, lip_pairs)
    parts = [
        aperture[max(math.floor(start * fps) - 1, 0) : math.ceil(end * fps) + 1]
        for start, end in spans
        if max(math.floor(start * fps) - 1, 0) < len(aperture)
    ]
    if not parts:
        return aperture[:0], aperture[:0]
    return torch.stack([part.min() for part in parts]), torch.stack([part.max() for part in parts])


def bilabial_closure(
    predicted: Vertices,
    lip_pairs: Pairs,
    spans: Spans,
    fps: float,
    *,
    true: TrueVertices | None = None,
    tolerance: float = 1e-3,
) -> Bool[Tensor, " spans"]:
    """For each bilabial: do the lips close? The share of True is the score.

    Without a truth, the smallest aperture within the span must be at most `tolerance` (the bilabial score of
    Audio2Face-3D, Sec. 7, which does not state its threshold). With one, it may exceed the smallest aperture
    of the truth by `tolerance`: what the recording leaves open is not asked for.

    Parameters
    ----------
    predicted, true : (T, V, 3)
        Zero pose.
    lip_pairs : (P, 2) int
        Upper and lower vertices of the mouth's middle.
    spans : sequence of (start, end)
        Seconds, one bilabial each; spans past the last frame are left out.
    fps : float
        Frames a second.
    tolerance : float
        In the unit of the vertices; 1 mm if those are metres.

    Raises
    ------
    ShapeError, OptionError
        If the arrays differ in shape or hold NaN at the lips; if the rate is not positive.
    """
    if true is not None:
        checked_pair(predicted, true, lip_pairs.flatten())
    reached, _ = aperture_extremes(predicted, lip_pairs, spans, fps)
    wanted = torch.zeros_like(reached)
    if true is not None:
        wanted, _ = aperture_extremes(true, lip_pairs, spans, fps)
    return reached - wanted <= tolerance
