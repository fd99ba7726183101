"""`meshanim evaluate`: score a model on held-out data, beside baselines."""

import sys

from meshanim.results import Results
from meshanim.training.gava_evaluation import EvaluateGavaOptions, evaluate_gava

__all__ = ["COMMANDS"]


def _gava(options: EvaluateGavaOptions) -> None:
    results = evaluate_gava(options, progress=sys.stderr.isatty())
    print(results.metrics_table())
    others = [row for row in results.rows if row.measured is None]
    if others:
        print("\n" + Results(results.name, others, results.machine).table())


COMMANDS = {"gava": _gava}
