"""Talking-head data sets."""

from meshanim.datasets.biwi import BiwiDataset, BiwiOptions
from meshanim.datasets.capture import Capture, Picture, View, open_capture
from meshanim.datasets.conversion import convert
from meshanim.datasets.faceformer import FaceFormerDataset, FaceFormerOptions
from meshanim.datasets.mesh_folder import MeshFolderDataset, MeshFolderOptions
from meshanim.datasets.meshanim_format import MeshanimDataset
from meshanim.datasets.motion_dataset import (
    DatasetOptions,
    MotionDataset,
    MotionSequence,
    SequenceInfo,
    Subject,
    open_dataset,
)
from meshanim.datasets.vocaset import VocasetDataset, VocasetOptions

__all__ = [
    "BiwiDataset",
    "BiwiOptions",
    "Capture",
    "DatasetOptions",
    "FaceFormerDataset",
    "FaceFormerOptions",
    "MeshFolderDataset",
    "MeshFolderOptions",
    "MeshanimDataset",
    "MotionDataset",
    "MotionSequence",
    "Picture",
    "SequenceInfo",
    "Subject",
    "View",
    "VocasetDataset",
    "VocasetOptions",
    "convert",
    "open_capture",
    "open_dataset",
]
