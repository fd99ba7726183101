"""`meshanim evaluate`: score a model on held-out data, beside baselines."""

import sys

from meshanim.results import Results
from meshanim.training.gava_ablation import AblationOptions, ablation_table, gava_ablation
from meshanim.training.gava_evaluation import EvaluateGavaOptions, evaluate_gava
from meshanim.training.gava_maps import GavaMapsOptions, draw_gava_maps

__all__ = ["COMMANDS"]


def _gava(options: EvaluateGavaOptions) -> None:
    results = evaluate_gava(options, progress=sys.stderr.isatty())
    print(results.metrics_table())
    others = [row for row in results.rows if row.measured is None]
    if others:
        print("\n" + Results(results.name, others, results.machine).table())


def _gava_ablation(options: AblationOptions) -> None:
    print(ablation_table(gava_ablation(options, progress=sys.stderr.isatty())))


def _gava_maps(options: GavaMapsOptions) -> None:
    draw_gava_maps(options)
    print(f"wrote {options.output}")


COMMANDS = {"gava": _gava, "gava-ablation": _gava_ablation, "gava-maps": _gava_maps}
