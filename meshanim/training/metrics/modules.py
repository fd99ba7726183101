"""The metrics as torchmetrics classes: sequences in, one number out, the same over any number of processes.

    error = LipVertexError(mask)
    for predicted, true in sequences:       # on each process its own share
        value = error(predicted, true)      # of this sequence, in the unit of the table
    error.compute()                         # of all sequences of all processes
    error.summary()                         # the same with unit, mask, formula and counts

Each keeps a weighted sum in float64. Pooled over frames, a sequence weighs as many as it has frames, which is
the mean over all frames of all sequences; pooled over sequences, each weighs one. Published tables differ in
this too: lip errors pool frames, dynamics deviations pool sequences.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torchmetrics import Metric

from meshanim.errors import OptionError
from meshanim.results import MetricValue
from meshanim.training.metrics.distribution import Moments, frechet_of_moments, moments, motion_features
from meshanim.training.metrics.dynamics import (
    DeviationForm,
    axis_dynamics_deviation,
    high_frequency_share,
    upper_face_dynamics_deviation,
    velocity_error,
)
from meshanim.training.metrics.lips import bilabial_closure, mouth_opening_error
from meshanim.training.metrics.masks import Mask
from meshanim.training.metrics.pose import pose_error
from meshanim.training.metrics.vertex_errors import (
    coverage_error,
    diversity,
    eye_vertex_error,
    lip_vertex_error,
    mean_estimate_error,
    mean_vertex_error,
)

__all__ = [
    "AxisDynamicsDeviation",
    "BilabialClosure",
    "CoverageError",
    "Diversity",
    "EyeVertexError",
    "FrechetDistance",
    "HighFrequencyShare",
    "LipVertexError",
    "MeanEstimateError",
    "MeanVertexError",
    "MouthOpeningError",
    "PoseError",
    "SequenceMetric",
    "UpperFaceDynamicsDeviation",
    "VelocityError",
    "reported_length",
]

Pooled = Literal["frames", "sequences"]
Vertices = Float[Tensor, "frames vertices 3"]
TrueVertices = Float[Tensor, "true_frames vertices 3"]
Samples = Float[Tensor, "samples frames vertices 3"]
Template = Float[Tensor, "vertices 3"]
Spans = Sequence[tuple[float, float]]


def reported_length(unit: str, power: int = 1) -> tuple[str, float]:
    """Name of the unit that tables print and the factor to it: millimetres, square metres, or BIWI's units.

    Parameters
    ----------
    unit : str
        Of the vertices: "m", or "biwi" for BIWI's area-normalised unit (174 to 201 mm by subject).
    power : int
        1 for lengths, 2 for squares.

    Raises
    ------
    OptionError
        If the unit is another.
    """
    if unit not in ("m", "biwi"):
        raise OptionError(f"no unit {unit!r}; vertices are in m or biwi")
    if power == 2:
        return f"{unit}^2", 1.0
    return ("mm", 1000.0) if unit == "m" else (unit, 1.0)


class SequenceMetric(Metric):
    """Weighted mean of a number of each sequence; subclasses say which.

    Parameters
    ----------
    name : str
        As tables print it.
    formula : str
        What is computed, in a line; p predicted, t true, r template.
    unit : str
        Of the result.
    factor : float
        From the functions' unit to that.
    mask : Mask, optional
        Vertices that count; None for all.
    pooled : str
        "frames" or "sequences".
    """

    full_state_update = False
    is_differentiable = False
    total: Tensor
    weight: Tensor
    frames: Tensor
    sequences: Tensor

    def __init__(
        self, name: str, formula: str, unit: str, factor: float, mask: Mask | None, pooled: str = "frames"
    ):
        super().__init__()
        self.name, self.formula, self.unit, self.factor = name, formula, unit, factor
        self.mask, self.pooled = mask, pooled
        self.add_state("total", torch.zeros((), dtype=torch.float64), "sum")
        self.add_state("weight", torch.zeros((), dtype=torch.float64), "sum")
        self.add_state("frames", torch.zeros((), dtype=torch.int64), "sum")
        self.add_state("sequences", torch.zeros((), dtype=torch.int64), "sum")

    def indices(self, like: Tensor) -> Int[Tensor, " mask"]:
        """The mask on the device of the data; OptionError without a mask."""
        if self.mask is None:
            raise OptionError(f"{self.name} needs a mask")
        return self.mask.tensor(like.device)

    def add(self, value: Tensor, frames: int, weight: float | None = None) -> None:
        """Take a sequence's number, in the functions' unit, with its own weight where it has one."""
        heavy = (frames if self.pooled == "frames" else 1) if weight is None else weight
        if heavy:
            self.total += value.to(self.total) * heavy
        self.weight += heavy
        self.frames += frames
        self.sequences += 1

    def compute(self) -> Tensor:
        """The number over all sequences of all processes, NaN if there were none."""
        return self.total / self.weight * self.factor

    def summary(self, vertices: int = 0) -> MetricValue:
        """`compute` with everything that says what the number is.

        Parameters
        ----------
        vertices : int
            Of the mesh, for a metric without a mask.
        """
        value = float(self.compute())
        with self.sync_context(should_sync=self._to_sync):
            frames, sequences = int(self.frames), int(self.sequences)
        name, count, digest = "all", vertices, ""
        if self.mask is not None:
            name, count, digest = self.mask.name, len(self.mask), self.mask.digest
        return MetricValue(
            self.name, value, self.unit, name, count, digest, self.formula, self.pooled, frames, sequences
        )


class LipVertexError(SequenceMetric):
    """`lip_vertex_error`; pooled over sequences and in metres it is UniTalker's LVD."""

    def __init__(self, mask: Mask, squared: bool = False, unit: str = "m", pooled: Pooled = "frames"):
        name, power = "lip vertex error", "^2" if squared else ""
        super().__init__(
            f"{name} squared" if squared else name,
            f"mean over frames of the largest |p - t|{power} of a vertex",
            *reported_length(unit, 2 if squared else 1),
            mask,
            pooled,
        )
        self.squared = squared

    def update(self, predicted: Vertices, true: TrueVertices) -> None:
        """Take one sequence."""
        value = lip_vertex_error(predicted, true, self.indices(true), squared=self.squared)
        self.add(value, len(true))


class EyeVertexError(SequenceMetric):
    """`eye_vertex_error`."""

    def __init__(self, mask: Mask, unit: str = "m"):
        formula = "mean over frames of the largest |p - t| of a vertex"
        super().__init__("eye vertex error", formula, *reported_length(unit), mask)

    def update(self, predicted: Vertices, true: TrueVertices) -> None:
        """Take one sequence."""
        self.add(eye_vertex_error(predicted, true, self.indices(true)), len(true))


class MeanVertexError(SequenceMetric):
    """`mean_vertex_error`."""

    def __init__(self, mask: Mask | None = None, unit: str = "m"):
        formula = "mean over frames and vertices of |p - t|"
        super().__init__("mean vertex error", formula, *reported_length(unit), mask)

    def update(self, predicted: Vertices, true: TrueVertices) -> None:
        """Take one sequence."""
        mask = None if self.mask is None else self.indices(true)
        self.add(mean_vertex_error(predicted, true, mask), len(true))


class UpperFaceDynamicsDeviation(SequenceMetric):
    """`upper_face_dynamics_deviation`, mean over sequences."""

    def __init__(self, mask: Mask, squared: bool = False, form: DeviationForm = "signed", unit: str = "m"):
        length = "|x - r|^2" if squared else "|x - r|"
        difference = f"std_T {length} of t less that of p"
        formulas = {
            "signed": f"mean over vertices of {difference}",
            "absolute": f"magnitude of the mean over vertices of {difference}",
            "vertexwise": f"mean over vertices of the magnitude of {difference}",
        }
        if form not in formulas:
            raise OptionError(f"no form {form!r} of FDD; there are {', '.join(formulas)}")
        words = ["FDD", *([] if form == "signed" else [form]), *(["squared"] if squared else [])]
        unit, factor = reported_length(unit, 2 if squared else 1)
        super().__init__(" ".join(words), formulas[form], unit, factor, mask, "sequences")
        self.squared, self.form = squared, form

    def update(self, predicted: Vertices, true: TrueVertices, template: Template) -> None:
        """Take one sequence and its subject at rest."""
        value = upper_face_dynamics_deviation(
            predicted, true, template, self.indices(true), squared=self.squared, form=self.form
        )
        self.add(value, len(true))


class AxisDynamicsDeviation(SequenceMetric):
    """`axis_dynamics_deviation`, mean over sequences."""

    def __init__(self, mask: Mask, unit: str = "m"):
        formula = "mean over vertices and axes of |std_T t - std_T p|"
        super().__init__("AFDD", formula, *reported_length(unit), mask, "sequences")

    def update(self, predicted: Vertices, true: TrueVertices) -> None:
        """Take one sequence."""
        self.add(axis_dynamics_deviation(predicted, true, self.indices(true)), len(true))


class VelocityError(SequenceMetric):
    """`velocity_error`; a sequence weighs one less than it has frames."""

    def __init__(self, fps: float, mask: Mask | None = None, unit: str = "m"):
        length, factor = reported_length(unit)
        formula = "mean over steps and vertices of |v(p) - v(t)|, v = difference of frames x fps"
        super().__init__("velocity error", formula, f"{length}/s", factor, mask)
        self.fps = fps

    def update(self, predicted: Vertices, true: TrueVertices) -> None:
        """Take one sequence."""
        mask = None if self.mask is None else self.indices(true)
        self.add(velocity_error(predicted, true, self.fps, mask), len(true), len(true) - 1)


class HighFrequencyShare(SequenceMetric):
    """`high_frequency_share`, mean over sequences; of the predictions, or of the truth to compare with."""

    def __init__(self, mask: Mask, fps: float, above: float = 8.0, of: Literal["p", "t"] = "p"):
        formula = f"share of the power of acceleration of {of} above {above:g} Hz, at {fps:g} frames a second"
        name = "jitter" if of == "p" else "jitter of truth"
        super().__init__(name, formula, "share", 1.0, mask, "sequences")
        self.fps, self.above = fps, above

    def update(self, vertices: Vertices) -> None:
        """Take one sequence."""
        value = high_frequency_share(vertices, self.fps, self.above, self.indices(vertices))
        self.add(value, len(vertices))


class MouthOpeningError(SequenceMetric):
    """`mouth_opening_error`.

    Parameters
    ----------
    lip_pairs : (P, 2) int
        Upper and lower vertices.
    unit : str
        As in `reported_length`.
    """

    def __init__(self, lip_pairs: Int[Tensor, "pairs 2"], unit: str = "m"):
        formula = "mean over frames of |a(p) - a(t)|, a = largest height of a lip pair"
        super().__init__("mouth opening error", formula, *reported_length(unit), _pair_mask(lip_pairs))
        self.lip_pairs = lip_pairs

    def update(self, predicted: Vertices, true: TrueVertices) -> None:
        """Take one sequence."""
        self.add(mouth_opening_error(predicted, true, self.lip_pairs.to(true.device)), len(true))


class BilabialClosure(SequenceMetric):
    """`bilabial_closure`: the share of all bilabials of all sequences whose lips close.

    Parameters
    ----------
    lip_pairs : (P, 2) int
        Upper and lower vertices.
    fps : float
        Frames a second.
    relative : bool
        To the truth's smallest aperture, instead of to zero.
    tolerance : float
        Metres.
    """

    def __init__(
        self, lip_pairs: Int[Tensor, "pairs 2"], fps: float, relative: bool = True, tolerance: float = 1e-3
    ):
        than = "that of t" if relative else "closed lips"
        formula = (
            f"share of bilabials whose smallest lip aperture is at most {tolerance * 1e3:g} mm above {than}"
        )
        name = "bilabials closed" if relative else "bilabials with closed lips"
        super().__init__(name, formula, "share", 1.0, _pair_mask(lip_pairs), "bilabials")
        self.lip_pairs, self.fps, self.relative, self.tolerance = lip_pairs, fps, relative, tolerance

    def update(self, predicted: Vertices, true: TrueVertices, spans: Spans) -> None:
        """Take one sequence and when its bilabials are, seconds."""
        against = true if self.relative else None
        pairs = self.lip_pairs.to(predicted.device)
        closed = bilabial_closure(predicted, pairs, spans, self.fps, true=against, tolerance=self.tolerance)
        self.add(closed.double().mean(), len(predicted), len(closed))


class MeanEstimateError(SequenceMetric):
    """`mean_estimate_error` (MEE)."""

    def __init__(self, mask: Mask, squared: bool = True, unit: str = "m"):
        formula = f"mean over frames of the largest |m - t|{'^2' if squared else ''}, m = mean of the samples"
        super().__init__("MEE", formula, *reported_length(unit, 2 if squared else 1), mask)
        self.squared = squared

    def update(self, samples: Samples, true: TrueVertices) -> None:
        """Take all samples of one sequence."""
        value = mean_estimate_error(samples, true, self.indices(true), squared=self.squared)
        self.add(value, len(true))


class CoverageError(SequenceMetric):
    """`coverage_error` (CE)."""

    def __init__(self, mask: Mask, squared: bool = True, unit: str = "m"):
        formula = (
            f"mean over frames of the largest |p - t|{'^2' if squared else ''} of each sequence's best sample"
        )
        super().__init__("CE", formula, *reported_length(unit, 2 if squared else 1), mask)
        self.squared = squared

    def update(self, samples: Samples, true: TrueVertices) -> None:
        """Take all samples of one sequence."""
        self.add(coverage_error(samples, true, self.indices(true), squared=self.squared), len(true))


class Diversity(SequenceMetric):
    """`diversity`, mean over sequences."""

    def __init__(self, mask: Mask | None = None, unit: str = "m"):
        formula = "mean over pairs of samples, frames and vertices of |p - q|"
        super().__init__("diversity", formula, *reported_length(unit), mask, "sequences")

    def update(self, samples: Samples) -> None:
        """Take all samples of one sequence."""
        mask = None if self.mask is None else self.indices(samples)
        self.add(diversity(samples, mask), samples.shape[1])


class PoseError(SequenceMetric):
    """`pose_error` in degrees."""

    def __init__(self) -> None:
        formula = "mean over frames of the angle between the rotations"
        super().__init__("pose error", formula, "deg", 180 / torch.pi, None)

    def update(self, predicted: Float[Tensor, "frames 3"], true: Float[Tensor, "true_frames 3"]) -> None:
        """Take one sequence of axis-angle poses, radians."""
        self.add(pose_error(predicted, true), len(true))

    def summary(self, vertices: int = 0) -> MetricValue:
        """As of every metric; it looks at no vertices."""
        return replace(super().summary(), mask="none", vertices=0)


class FrechetDistance(SequenceMetric):
    """`frechet_distance` of `motion_features` over the frames of all sequences.

    Parameters
    ----------
    mask : Mask
        Vertices that the features are picked from.
    landmarks : int
        How many of them at most.
    unit : str
        As in `reported_length`; the result is in its square, mm^2 for metres.
    """

    predicted_outer: Tensor
    predicted_total: Tensor
    true_outer: Tensor
    true_total: Tensor

    def __init__(self, mask: Mask, landmarks: int = 32, unit: str = "m"):
        length, factor = reported_length(unit)
        count = len(range(0, len(mask), -(-len(mask) // landmarks)))
        formula = (
            "Frechet distance of Gaussians fitted to frames' displacements from r and steps to the next frame"
            f" of {count} vertices picked evenly"
        )
        super().__init__("Frechet distance", formula, f"{length}^2", factor**2, mask, "frames")
        self.landmarks = landmarks
        for side in ("predicted", "true"):
            self.add_state(f"{side}_total", torch.zeros(6 * count, dtype=torch.float64), "sum")
            self.add_state(f"{side}_outer", torch.zeros(6 * count, 6 * count, dtype=torch.float64), "sum")

    def update(self, predicted: Vertices, true: TrueVertices, template: Template) -> None:
        """Take one sequence and its subject at rest."""
        mask = self.indices(true)
        for side, vertices in (("predicted", predicted), ("true", true)):
            sums = moments(motion_features(vertices, template, mask, self.landmarks))
            setattr(self, f"{side}_total", getattr(self, f"{side}_total") + sums.total)
            setattr(self, f"{side}_outer", getattr(self, f"{side}_outer") + sums.outer)
        self.add(self.total.new_zeros(()), len(true), len(true) - 1)

    def compute(self) -> Tensor:
        """The distance over all frames of all processes, of one sequence when it is called with one."""
        predicted, true = (
            Moments(self.weight, getattr(self, f"{side}_total"), getattr(self, f"{side}_outer"))
            for side in ("predicted", "true")
        )
        return frechet_of_moments(predicted, true) * self.factor


def _pair_mask(lip_pairs: Int[Tensor, "pairs 2"]) -> Mask:
    return Mask("lip pairs", lip_pairs.flatten().unique().numpy())
