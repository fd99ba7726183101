"""Talking-head data sets."""

from meshanim.datasets.faceformer import FaceFormerDataset, FaceFormerOptions
from meshanim.datasets.meshanim_format import MeshanimDataset
from meshanim.datasets.motion_dataset import (
    DatasetOptions,
    MotionDataset,
    MotionSequence,
    SequenceInfo,
    Subject,
    open_dataset,
)

__all__ = [
    "DatasetOptions",
    "FaceFormerDataset",
    "FaceFormerOptions",
    "MeshanimDataset",
    "MotionDataset",
    "MotionSequence",
    "SequenceInfo",
    "Subject",
    "open_dataset",
]
