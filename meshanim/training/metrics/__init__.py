"""Metrics of animated meshes, with every choice that published tables differ in as a named option.

Functions take one sequence of torch tensors, on any device, float32 or float64, and give numbers in the unit
of the input. `modules` has the same as torchmetrics classes, which pool sequences over processes and name
unit, mask and formula; `masks` reads the vertex sets of published tables. docs/metrics.md is the guide.
"""

from meshanim.training.metrics.checks import truncated
from meshanim.training.metrics.distribution import frechet_distance, motion_features
from meshanim.training.metrics.dynamics import (
    axis_dynamics_deviation,
    high_frequency_share,
    upper_face_dynamics_deviation,
    velocity_error,
)
from meshanim.training.metrics.lips import (
    aperture_extremes,
    bilabial_closure,
    lip_aperture,
    mouth_opening_error,
)
from meshanim.training.metrics.pose import pose_error, pose_errors
from meshanim.training.metrics.vertex_errors import (
    coverage_error,
    diversity,
    eye_vertex_error,
    largest_vertex_errors,
    lip_vertex_error,
    mean_estimate_error,
    mean_vertex_error,
)

__all__ = [
    "aperture_extremes",
    "axis_dynamics_deviation",
    "bilabial_closure",
    "coverage_error",
    "diversity",
    "eye_vertex_error",
    "frechet_distance",
    "high_frequency_share",
    "largest_vertex_errors",
    "lip_aperture",
    "lip_vertex_error",
    "mean_estimate_error",
    "mean_vertex_error",
    "motion_features",
    "mouth_opening_error",
    "pose_error",
    "pose_errors",
    "truncated",
    "upper_face_dynamics_deviation",
    "velocity_error",
]
