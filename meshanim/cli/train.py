"""`meshanim train`: train a model."""

import sys

from meshanim.training.gava import TrainGavaOptions, train_gava

__all__ = ["COMMANDS"]


def _gava(options: TrainGavaOptions) -> None:
    print(f"wrote {train_gava(options, progress=sys.stderr.isatty())}")


COMMANDS = {"gava": _gava}
