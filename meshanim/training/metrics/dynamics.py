"""How a mesh moves: dynamics deviation (FDD, AFDD), velocity, and jitter."""

from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from meshanim.errors import OptionError, ShapeError
from meshanim.training.metrics.checks import checked_pair, chosen

__all__ = [
    "DeviationForm",
    "axis_dynamics_deviation",
    "high_frequency_share",
    "upper_face_dynamics_deviation",
    "velocity_error",
]

Vertices = Float[Tensor, "frames vertices 3"]
TrueVertices = Float[Tensor, "true_frames vertices 3"]
Indices = Int[Tensor, " mask"]
Scalar = Float[Tensor, ""]
DeviationForm = Literal["signed", "absolute", "vertexwise"]


def upper_face_dynamics_deviation(
    predicted: Vertices,
    true: TrueVertices,
    template: Float[Tensor, "vertices 3"],
    upper_face: Indices,
    *,
    squared: bool = False,
    form: DeviationForm = "signed",
) -> Scalar:
    """FDD: mean over upper-face vertices of dyn(true) - dyn(predicted) (GAVA, Eq. 9, after CodeTalker).

    dyn is the standard deviation over time (divided by T) of the length of the motion, vertex minus template.

    Parameters
    ----------
    predicted, true : (T, V, 3)
        The same unit, pose and length.
    template : (V, 3)
        The subject at rest.
    upper_face : (U,) int
        Upper-face vertices.
    squared : bool
        Of squared lengths, unit^2: CodeTalker's and FaceDiffuser's scripts. Plain lengths: the papers' text.
    form : str
        "signed" (GAVA, CodeTalker): too little motion counts against too much, within and between sequences.
        "absolute" (FaceDiffuser's second number): the magnitude of a sequence's signed value.
        "vertexwise": mean of the vertices' magnitudes.

    Raises
    ------
    ShapeError
        If the arrays differ in shape, are empty or hold NaN within the mask.
    """
    predicted, true = checked_pair(predicted, true, upper_face)
    rest = chosen(template[None], upper_face)

    def dynamics(vertices: Tensor) -> Tensor:
        length = (vertices - rest).square().sum(-1)
        return (length if squared else length.sqrt()).std(0, correction=0)

    deviation = dynamics(true) - dynamics(predicted)
    if form == "vertexwise":
        return deviation.abs().mean()
    return deviation.mean().abs() if form == "absolute" else deviation.mean()


def axis_dynamics_deviation(predicted: Vertices, true: TrueVertices, upper_face: Indices) -> Scalar:
    """AFDD: magnitude of the difference of the standard deviations along each axis (GAVA, Eq. 10).

    Mean over upper-face vertices and axes; the template cancels.
    """
    predicted, true = checked_pair(predicted, true, upper_face)
    return (true.std(0, correction=0) - predicted.std(0, correction=0)).abs().mean()


def velocity_error(
    predicted: Vertices,
    true: TrueVertices,
    fps: float,
    mask: Indices | None = None,
) -> Scalar:
    """Mean distance of the vertices' velocities over frame steps and vertices, unit a second.

    Parameters
    ----------
    predicted, true : (T, V, 3)
        The same unit, pose and length; at least two frames.
    fps : float
        Frames a second.
    mask : (M,) int, optional
        All vertices without it.

    Raises
    ------
    ShapeError, OptionError
        For arrays as above; for a rate that is not positive.
    """
    predicted, true = checked_pair(predicted, true, mask)
    _check_rate(fps)
    if len(true) < 2:
        raise ShapeError("one frame has no velocity: at least two are needed")
    return (predicted - true).diff(dim=0).norm(dim=-1).mean() * fps


def high_frequency_share(vertices: Vertices, fps: float, above: float, mask: Indices | None = None) -> Scalar:
    """Jitter: share of the power of the vertices' acceleration above a frequency, 0 to 1.

    The acceleration is the second difference over time; its power spectrum is that of a Hann window over the
    whole sequence, summed over vertices and axes. After the Fourier metric of Audio2Face-3D (Sec. 7), which
    looks at the mouth and does not state its cutoff. Nothing that moves gives 0. Compare with the share of
    the recording, at the same frame rate: recordings jitter too.

    Parameters
    ----------
    vertices : (T, V, 3)
        Any unit; at least 8 frames.
    fps : float
        Frames a second.
    above : float
        Hz; below fps / 2.
    mask : (M,) int, optional
        All vertices without it.

    Raises
    ------
    OptionError
        If the rate is not positive or holds no frequency above `above`.
    ShapeError
        If there are too few frames.
    """
    _check_rate(fps)
    if not 0 <= above < fps / 2:
        raise OptionError(f"motion at {fps:g} frames a second has no power above {above:g} Hz; give less")
    if len(vertices) < 8:
        raise ShapeError(f"{len(vertices)} frames have no spectrum: at least 8 are needed")
    acceleration = chosen(vertices, mask).diff(n=2, dim=0).flatten(1)
    window = torch.hann_window(len(acceleration) + 2, False).to(acceleration)[1:-1]
    power = torch.fft.rfft(acceleration * window[:, None], dim=0).abs().square().sum(1)
    if len(acceleration) % 2 == 0:
        power[-1] = power[-1] / 2  # the one-sided spectrum holds all but the first and this one twice
    power[0] = power[0] / 2
    total = power.sum()
    frequencies = torch.fft.rfftfreq(len(acceleration), 1 / fps).to(power)
    return torch.where(total > 0, power[frequencies > above].sum() / total.clamp_min(1e-300), total)


def _check_rate(fps: float) -> None:
    if not fps > 0:
        raise OptionError(f"fps must be positive, not {fps}")
