"""`meshanim train`: train a model."""

import sys

from meshanim.training.audio2emotion import TrainEmotionOptions, train_emotion
from meshanim.training.audio2emotion_evaluation import confusion_table, evaluate_emotion
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


def _emotion(options: TrainEmotionOptions) -> None:
    held = train_emotion(options, progress=sys.stderr.isatty())
    print(f"wrote {options.output / 'model'}")
    if held:
        results, confusion = evaluate_emotion(options.output / "model", held, progress=sys.stderr.isatty())
        results.save(options.output / "results.json")
        print(f"{results.table()}\n\nspeakers held out, without a neutral sample:")
        print(confusion_table(confusion["alone"]))


COMMANDS = {
    "gava": _gava,
    "a2f-regression": _regression,
    "a2f-diffusion": _diffusion,
    "syncnet": _syncnet,
    "audio2emotion": _emotion,
}
