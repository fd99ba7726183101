"""Predicted motion against recorded motion: every metric that masks and data allow, sequence by sequence."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from meshanim.errors import ShapeError
from meshanim.heads import Head
from meshanim.motion.lip_seal import head_lip_pairs
from meshanim.results import MetricValue
from meshanim.training.metrics import truncated
from meshanim.training.metrics.masks import Mask, region_mask
from meshanim.training.metrics.modules import (
    AxisDynamicsDeviation,
    BilabialClosure,
    CoverageError,
    Diversity,
    EyeVertexError,
    FrechetDistance,
    HighFrequencyShare,
    LipVertexError,
    MeanEstimateError,
    MeanVertexError,
    MouthOpeningError,
    PoseError,
    SequenceMetric,
    UpperFaceDynamicsDeviation,
    VelocityError,
)

__all__ = ["JITTER_ABOVE", "MotionEvaluation", "MotionMasks", "masks_of_head"]

JITTER_ABOVE = 8.0
"""Hz. Speech moves lips below it: syllables come at 3 to 8 a second."""
LEAST_FRAMES = 8
"""Shorter sequences have no spectrum."""


@dataclass(frozen=True)
class MotionMasks:
    """Vertices that the metrics look at; a metric whose mask is None is not measured.

    Parameters
    ----------
    lips : Mask, optional
        Lip error, velocity error, jitter, Frechet distance, MEE and CE.
    upper_face : Mask, optional
        FDD, AFDD.
    eyes : Mask, optional
        Eye error.
    lip_pairs : (P, 2) int, optional
        Upper and lower vertices of the mouth's middle: mouth opening and bilabials.
    """

    lips: Mask | None = None
    upper_face: Mask | None = None
    eyes: Mask | None = None
    lip_pairs: Int[Tensor, "pairs 2"] | None = None


def masks_of_head(head: Head | None) -> MotionMasks:
    """The regions and lip pairs of a head, none without one."""
    if head is None:
        return MotionMasks()
    pairs = head_lip_pairs(head)
    return MotionMasks(
        region_mask(head, "lips"),
        region_mask(head, "upper_face"),
        region_mask(head, "eye_region"),
        None if pairs is None else torch.from_numpy(pairs),
    )


class MotionEvaluation:
    """Scores sequences one after the other and keeps each one's numbers.

    Parameters
    ----------
    masks : MotionMasks
        What to look at.
    fps : float
        Frames a second of all sequences.
    unit : str
        Of the vertices, "m" or "biwi".
    jitter_above : float
        Hz.
    """

    def __init__(self, masks: MotionMasks, fps: float, unit: str = "m", jitter_above: float = JITTER_ABOVE):
        self.masks, self.fps, self.vertices = masks, fps, 0
        self.per_sequence: dict[str, dict[str, tuple[float, float]]] = {}
        self.dropped_frames: dict[str, int] = {}
        self.pairs: list[SequenceMetric] = [MeanVertexError(unit=unit)]
        self.resting: list[SequenceMetric] = []
        self.single: list[tuple[SequenceMetric, str]] = []
        self.sampled: list[SequenceMetric] = []
        self.diversity = Diversity(unit=unit)
        self.pose = PoseError()
        self.closure: BilabialClosure | None = None
        self.frechet: FrechetDistance | None = None
        self.velocity: VelocityError | None = None
        if masks.lips is not None:
            self.pairs += [LipVertexError(masks.lips, unit=unit), LipVertexError(masks.lips, True, unit)]
            self.velocity = VelocityError(fps, masks.lips, unit)
            self.single = [
                (HighFrequencyShare(masks.lips, fps, jitter_above, "p"), "predicted"),
                (HighFrequencyShare(masks.lips, fps, jitter_above, "t"), "true"),
            ]
            self.sampled = [MeanEstimateError(masks.lips, unit=unit), CoverageError(masks.lips, unit=unit)]
            self.frechet = FrechetDistance(masks.lips, unit=unit)
        if masks.eyes is not None:
            self.pairs.append(EyeVertexError(masks.eyes, unit))
        if masks.upper_face is not None:
            self.pairs.append(AxisDynamicsDeviation(masks.upper_face, unit))
            self.resting = [
                UpperFaceDynamicsDeviation(masks.upper_face, unit=unit),
                UpperFaceDynamicsDeviation(masks.upper_face, True, unit=unit),
                UpperFaceDynamicsDeviation(masks.upper_face, True, "absolute", unit),
            ]
        if masks.lip_pairs is not None:
            self.pairs.append(MouthOpeningError(masks.lip_pairs, unit))
            if unit == "m":
                self.closure = BilabialClosure(masks.lip_pairs, fps)

    def add(
        self,
        name: str,
        samples: Float[Tensor, "samples frames vertices 3"],
        true: Float[Tensor, "true_frames vertices 3"],
        template: Float[Tensor, "vertices 3"] | None = None,
        bilabials: Sequence[tuple[float, float]] = (),
        predicted_pose: Float[Tensor, "frames 3"] | None = None,
        true_pose: Float[Tensor, "true_frames 3"] | None = None,
    ) -> None:
        """Score one sequence, predictions and truth cut to the shorter one.

        Parameters
        ----------
        name : str
            Of the sequence, once each.
        samples : (S, T, V, 3)
            Predictions; the first one is scored, all of them for MEE, CE and diversity where S > 1.
        true : (T', V, 3)
            The recording, in the same pose and unit.
        template : (V, 3), optional
            The subject at rest; without it no FDD and no Frechet distance.
        bilabials : sequence of (start, end)
            Seconds at which p, b and m are spoken.
        predicted_pose, true_pose : (T, 3), (T', 3), optional
            Axis-angle, radians.

        Raises
        ------
        ShapeError
            If the topologies differ, a clip is empty or holds NaN, or the name was there before.
        """
        if name in self.dropped_frames:
            raise ShapeError(f"sequence {name} is scored twice")
        if samples.shape[2] != true.shape[1]:
            raise ShapeError(
                f"{name}: {samples.shape[2]} predicted and {true.shape[1]} true vertices: other topology"
            )
        first, true, dropped = truncated(samples[0], true)
        self.dropped_frames[name], self.vertices = dropped, true.shape[1]
        samples = samples[:, : len(true)]
        for metric in self.pairs:
            self._take(name, metric, first, true)
        if self.velocity is not None and len(true) > 1:
            self._take(name, self.velocity, first, true)
        if len(true) >= LEAST_FRAMES:
            for metric, side in self.single:
                self._take(name, metric, first if side == "predicted" else true)
        if template is not None:
            for metric in self.resting:
                self._take(name, metric, first, true, template)
            if self.frechet is not None and len(true) > 1:
                self.frechet.update(first, true, template)
        if self.closure is not None and bilabials:
            self._take(name, self.closure, first, true, bilabials)
        if predicted_pose is not None and true_pose is not None:
            self._take(name, self.pose, *truncated(predicted_pose, true_pose)[:2])
        if len(samples) > 1:
            for metric in self.sampled:
                self._take(name, metric, samples, true)
            self._take(name, self.diversity, samples)

    def _take(self, name: str, metric: SequenceMetric, *arguments: object) -> None:
        before = float(metric.weight)
        value = float(metric(*arguments))
        if (weight := float(metric.weight) - before) > 0:
            self.per_sequence.setdefault(metric.name, {})[name] = (value, weight)

    def values(self) -> list[MetricValue]:
        """What was measured, in the order of the table."""
        lips_first = sorted(self.pairs, key=lambda metric: not isinstance(metric, LipVertexError))
        metrics: list[SequenceMetric | None] = [
            *lips_first,
            self.velocity,
            *self.resting,
            *(metric for metric, _ in self.single),
            self.frechet,
            self.closure,
            self.pose,
            *self.sampled,
            self.diversity,
        ]
        return [
            replace(metric.summary(self.vertices), per_sequence=self.per_sequence.get(metric.name, {}))
            for metric in metrics
            if metric is not None and float(metric.weight) > 0
        ]

    @property
    def truncation(self) -> str:
        """A line on frames that were dropped; empty if there were none."""
        cut = {name: count for name, count in self.dropped_frames.items() if count}
        if not cut:
            return ""
        worst = max(cut, key=cut.__getitem__)
        return (
            f"{len(cut)} of {len(self.dropped_frames)} sequences cut to the shorter of prediction and truth:"
            f" {sum(cut.values())} frames dropped, at most {cut[worst]} ({worst})"
        )
