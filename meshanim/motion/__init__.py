"""Animated meshes and what is done to them."""

from meshanim.motion.pose import pose_from_prosody, prosodic_accents, smooth_rotations
from meshanim.motion.pose_track import PoseTrack, load_pose_track
from meshanim.motion.sequence import MeshSequence

__all__ = [
    "MeshSequence",
    "PoseTrack",
    "load_pose_track",
    "pose_from_prosody",
    "prosodic_accents",
    "smooth_rotations",
]
