"""Talking-head data sets."""

from meshanim.datasets.faceformer import FaceFormerDataset
from meshanim.datasets.meshanim_format import MeshanimDataset, MotionSequence, SequenceInfo, Subject

__all__ = ["FaceFormerDataset", "MeshanimDataset", "MotionSequence", "SequenceInfo", "Subject"]
