"""Animated meshes and what is done to them."""

from meshanim.motion.blendshape_solver import BlendshapeSolver, SolverOptions, solve_blendshapes
from meshanim.motion.blendshape_track import BlendshapeTrack
from meshanim.motion.personal_shapes import personal_shapes
from meshanim.motion.pose import pose_from_prosody, prosodic_accents, smooth_rotations
from meshanim.motion.pose_track import PoseTrack, load_pose_track
from meshanim.motion.sequence import MeshSequence

__all__ = [
    "BlendshapeSolver",
    "BlendshapeTrack",
    "MeshSequence",
    "PoseTrack",
    "SolverOptions",
    "load_pose_track",
    "personal_shapes",
    "pose_from_prosody",
    "prosodic_accents",
    "smooth_rotations",
    "solve_blendshapes",
]
