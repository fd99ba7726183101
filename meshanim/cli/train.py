"""`meshanim train`: train a model."""

import sys

from meshanim.training.audio2face_diffusion import TrainDiffusionOptions, train_diffusion
from meshanim.training.audio2face_regression import TrainRegressionOptions, train_regression
from meshanim.training.gava import TrainGavaOptions, train_gava
from meshanim.training.syncnet import TrainSyncNetOptions, train_syncnet

__all__ = ["COMMANDS"]


def _gava(options: TrainGavaOptions) -> None:
    print(f"wrote {train_gava(options, progress=sys.stderr.isatty())}")


def _regression(options: TrainRegressionOptions) -> None:
    print(f"wrote {train_regression(options, progress=sys.stderr.isatty())}")


def _diffusion(options: TrainDiffusionOptions) -> None:
    print(f"wrote {train_diffusion(options, progress=sys.stderr.isatty())}")


def _syncnet(options: TrainSyncNetOptions) -> None:
    print(f"wrote {train_syncnet(options, progress=sys.stderr.isatty())}")


COMMANDS = {
    "gava": _gava,
    "a2f-regression": _regression,
    "a2f-diffusion": _diffusion,
    "syncnet": _syncnet,
}
