"""`meshanim evaluate`: score a model on held-out data, beside baselines."""

import sys

from meshanim.training.gava_evaluation import EvaluateGavaOptions, evaluate_gava

__all__ = ["COMMANDS"]


def _gava(options: EvaluateGavaOptions) -> None:
    print(evaluate_gava(options, progress=sys.stderr.isatty()).table())


COMMANDS = {"gava": _gava}
