"""`meshanim avatar`: mesh-bound Gaussian avatars."""

import sys

from meshanim.gaussians.avatar.evaluation import EvaluateAvatarOptions, evaluate_avatar
from meshanim.gaussians.avatar.fit import FitAvatarOptions, fit_avatar

__all__ = ["COMMANDS"]


def _fit(options: FitAvatarOptions) -> None:
    print(fit_avatar(options, progress=sys.stderr.isatty()).table())
    print(f"wrote {options.output / 'model'}")


def _evaluate(options: EvaluateAvatarOptions) -> None:
    print(evaluate_avatar(options, progress=sys.stderr.isatty()).table())
    if options.lpips is None:
        print("LPIPS: not measured, no weights given (--lpips)")
    if options.pictures is not None:
        print(f"wrote sheets into {options.pictures}: truth, rendering, error times 4; eyes and mouth below")


COMMANDS = {"fit": _fit, "evaluate": _evaluate}
