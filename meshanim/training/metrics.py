"""Metrics of animated meshes, with every choice that published tables differ in as a named option.

| table | lip error | upper-face deviation |
| --- | --- | --- |
| GAVA (TVCG 2025) | distance, mm | signed FDD and AFDD of distances, mm |
| FaceFormer, CodeTalker, SelfTalk | `squared=True`: squared distance, m^2 | `squared=True`, signed, m^2 |
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from meshanim.errors import OptionError, ShapeError

__all__ = [
    "axis_dynamics_deviation",
    "bilabial_closure",
    "eye_vertex_error",
    "lip_aperture",
    "lip_vertex_error",
    "mean_vertex_error",
    "upper_face_dynamics_deviation",
]

MILLIMETRES = 1000.0


def lip_vertex_error(
    predicted: Float[np.ndarray, "frames vertices 3"],
    true: Float[np.ndarray, "true_frames vertices 3"],
    lips: Int[np.ndarray, " lips"],
    *,
    squared: bool = False,
) -> float:
    """Mean over frames of the largest error of a lip vertex (GAVA, Eq. 8).

    Parameters
    ----------
    predicted, true : (T, V, 3)
        Metres, in the same pose.
    lips : (L,) int
        Lip vertices.
    squared : bool
        False: distances, in millimetres (GAVA's E_vl). True: squared distances in square metres
        (FaceFormer's and CodeTalker's LVE; their tables print it times 1e5 or 1e4).

    Raises
    ------
    ShapeError
        If the arrays differ in shape, are empty or hold NaN.
    """
    _check(predicted, true, lips, "lips")
    worst = np.square(_chosen(predicted, lips) - _chosen(true, lips)).sum(-1).max(1)
    return float(worst.mean()) if squared else float(np.sqrt(worst).mean() * MILLIMETRES)


def eye_vertex_error(
    predicted: Float[np.ndarray, "frames vertices 3"],
    true: Float[np.ndarray, "true_frames vertices 3"],
    eyes: Int[np.ndarray, " eyes"],
    *,
    squared: bool = False,
) -> float:
    """`lip_vertex_error` on the eye region (GAVA, Sec. IV-A, E_ve)."""
    return lip_vertex_error(predicted, true, eyes, squared=squared)


def mean_vertex_error(
    predicted: Float[np.ndarray, "frames vertices 3"], true: Float[np.ndarray, "true_frames vertices 3"]
) -> float:
    """Mean distance of corresponding vertices over frames and vertices, in millimetres."""
    _check(predicted, true)
    return float(np.linalg.norm(predicted - true, axis=-1).mean(dtype=np.float64) * MILLIMETRES)


def upper_face_dynamics_deviation(
    predicted: Float[np.ndarray, "frames vertices 3"],
    true: Float[np.ndarray, "true_frames vertices 3"],
    template: Float[np.ndarray, "vertices 3"],
    upper_face: Int[np.ndarray, " upper"],
    *,
    squared: bool = False,
    signed: bool = True,
) -> float:
    """FDD: mean over upper-face vertices of dyn(true) - dyn(predicted) (GAVA, Eq. 9, after CodeTalker).

    dyn is the standard deviation over time of the length of the motion (vertex minus template).

    Parameters
    ----------
    predicted, true : (T, V, 3)
        Metres, in the same pose.
    template : (V, 3)
        The subject at rest, metres.
    upper_face : (U,) int
        Upper-face vertices.
    squared : bool
        False: of lengths, in millimetres (the papers' text). True: of squared lengths, in square metres
        (CodeTalker's evaluation script).
    signed : bool
        True (both papers): too little motion counts against too much. False: mean of magnitudes.

    Raises
    ------
    ShapeError
        If the arrays differ in shape, are empty or hold NaN.
    """
    _check(predicted, true, upper_face, "upper_face")
    rest = _chosen(template[None], upper_face)

    def dynamics(vertices):
        length = np.square(_chosen(vertices, upper_face) - rest).sum(-1)
        return (length if squared else np.sqrt(length) * MILLIMETRES).std(0)

    deviation = dynamics(true) - dynamics(predicted)
    return float(deviation.mean() if signed else np.abs(deviation).mean())


def axis_dynamics_deviation(
    predicted: Float[np.ndarray, "frames vertices 3"],
    true: Float[np.ndarray, "true_frames vertices 3"],
    upper_face: Int[np.ndarray, " upper"],
) -> float:
    """AFDD: difference of the standard deviations over time along each axis, in millimetres (GAVA, Eq. 10).

    Absolute differences, mean over upper-face vertices and axes; the template cancels.
    """
    _check(predicted, true, upper_face, "upper_face")
    deviation = _chosen(true, upper_face).std(0) - _chosen(predicted, upper_face).std(0)
    return float(np.abs(deviation).mean() * MILLIMETRES)


def lip_aperture(
    vertices: Float[np.ndarray, "frames vertices 3"], lip_pairs: Int[np.ndarray, "pairs 2"]
) -> Float[np.ndarray, " frames"]:
    """Height of the widest gap between paired upper and lower lip vertices, metres; negative if they overlap.

    Parameters
    ----------
    vertices : (T, V, 3)
        Metres, zero pose (y up).
    lip_pairs : (P, 2) int
        Upper and lower vertex of each pair.
    """
    upper, lower = vertices[:, lip_pairs[:, 0], 1], vertices[:, lip_pairs[:, 1], 1]
    return (upper - lower).max(1)


def bilabial_closure(
    predicted: Float[np.ndarray, "frames vertices 3"],
    true: Float[np.ndarray, "true_frames vertices 3"],
    lip_pairs: Int[np.ndarray, "pairs 2"],
    spans: Sequence[tuple[float, float]],
    fps: float,
    *,
    tolerance: float = 1e-3,
) -> list[bool]:
    """For each bilabial: do the lips close to within `tolerance` of how far the true lips close?

    Within a span, one frame of slack at either side, the smallest `lip_aperture` of the prediction may exceed
    the smallest of the truth by `tolerance`.

    Parameters
    ----------
    predicted, true : (T, V, 3)
        Metres, zero pose.
    lip_pairs : (P, 2) int
        Upper and lower vertices of the mouth's middle.
    spans : sequence of (start, end)
        Seconds, one bilabial each; spans past the last frame are left out.
    fps : float
        Frames a second.
    tolerance : float
        Metres.

    Returns
    -------
    list of bool
        One an evaluated span; the share of True is the metric.
    """
    _check(predicted, true)
    if not fps > 0:
        raise OptionError(f"fps must be positive, not {fps}")
    gap_predicted, gap_true = lip_aperture(predicted, lip_pairs), lip_aperture(true, lip_pairs)
    closed = []
    for start, end in spans:
        first, last = max(int(np.floor(start * fps)) - 1, 0), int(np.ceil(end * fps)) + 1
        if first < len(true):
            excess = gap_predicted[first:last].min() - gap_true[first:last].min()
            closed.append(bool(excess <= tolerance))
    return closed


def _chosen(vertices: np.ndarray, indices: np.ndarray) -> np.ndarray:
    return np.asarray(vertices[:, indices], np.float64)


def _check(predicted: np.ndarray, true: np.ndarray, indices: np.ndarray | None = None, name: str = ""):
    if predicted.shape != true.shape:
        raise ShapeError(
            f"predicted {predicted.shape} and true {true.shape} differ: cut both to the shorter one first"
        )
    if not len(predicted):
        raise ShapeError("there are no frames to compare")
    if indices is not None and not len(indices):
        raise ShapeError(f"{name} names no vertices")
    if not (np.isfinite(predicted).all() and np.isfinite(true).all()):
        raise ShapeError("the vertices hold NaN or infinite values")
