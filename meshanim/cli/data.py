"""`meshanim data`: make and check data sets."""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tyro.conf import Positional

from meshanim.datasets import MeshanimDataset
from meshanim.datasets.pose_augmentation import AugmentPoseOptions, augment_pose
from meshanim.datasets.synthetic.corpus import SynthesizeOptions, synthesize
from meshanim.training.feature_cache import CacheFeaturesOptions, cache_features

__all__ = ["COMMANDS", "CheckOptions"]


@dataclass(frozen=True)
class CheckOptions:
    """Read every file of a data set and say what is wrong.

    Example: meshanim data check corpus
    """

    directory: Positional[Path]
    """Folder with dataset.json."""


def _synthesize(options: SynthesizeOptions) -> int:
    directory = synthesize(options, progress=sys.stderr.isatty())
    print(f"wrote {directory}")
    return 0


def _check(options: CheckOptions) -> int:
    dataset = MeshanimDataset(options.directory)
    faults = dataset.check()
    for fault in faults:
        print(fault, file=sys.stderr)
    seconds = sum(dataset.info(name).frames for name in dataset.sequences) / dataset.fps
    splits = ", ".join(f"{len(names)} {split}" for split, names in dataset.splits.items())
    print(f"{dataset.name}: {len(dataset.subjects)} subjects, {len(dataset)} sequences ({splits})")
    print(f"{seconds / 60:.1f} min at {dataset.fps:g} fps, {dataset.mesh.n_vertices} vertices")
    print(f"{len(faults)} faults")
    return 2 if faults else 0


def _augment_pose(options: AugmentPoseOptions) -> int:
    found = augment_pose(options, progress=sys.stderr.isatty())
    mean, deviation, largest, speed = np.degrees([found.mean, found.deviation, found.largest, found.speed])
    print(
        f"{found.counts.sum()} frames: rotation {mean:.2f} ± {deviation:.2f} degrees, largest {largest:.2f}, "
        f"{speed:.2f} degrees a second"
    )
    return 0


def _cache_features(options: CacheFeaturesOptions) -> None:
    print(f"wrote {cache_features(options, progress=sys.stderr.isatty())}")


COMMANDS = {
    "synthesize": _synthesize,
    "check": _check,
    "augment-pose": _augment_pose,
    "cache-features": _cache_features,
}
