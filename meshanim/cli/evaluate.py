"""`meshanim evaluate`: score models and motion, and compare scores."""

import sys

from meshanim.audio.viseme_evaluation import EvaluateVisemesOptions, evaluate_visemes
from meshanim.comparison import CompareOptions, compare, comparison_results, comparison_table
from meshanim.results import Results
from meshanim.training.audio2emotion_evaluation import (
    EvaluateEmotionOptions,
    confusion_table,
    evaluate_emotion,
)
from meshanim.training.audio2face_evaluation import EvaluateAudio2FaceOptions, evaluate_audio2face
from meshanim.training.folder_evaluation import EvaluateMotionOptions, evaluate_motion
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


def _audio2face(options: EvaluateAudio2FaceOptions) -> None:
    print(evaluate_audio2face(options, progress=sys.stderr.isatty()).metrics_table())


def _gava_ablation(options: AblationOptions) -> None:
    print(ablation_table(gava_ablation(options, progress=sys.stderr.isatty())))


def _gava_maps(options: GavaMapsOptions) -> None:
    draw_gava_maps(options)
    print(f"wrote {options.output}")


def _motion(options: EvaluateMotionOptions) -> None:
    results, notes = evaluate_motion(options, progress=sys.stderr.isatty())
    print(results.metrics_table())
    for note in notes:
        print(note)


def _compare(options: CompareOptions) -> None:
    differences = compare(options)
    print(comparison_table(differences, options.level))
    if options.json is not None:
        comparison_results(differences).save(options.json)


def _emotion(options: EvaluateEmotionOptions) -> None:
    results, confusion = evaluate_emotion(
        options.model, options.clips(), options.fine_tune, options.seed, progress=sys.stderr.isatty()
    )
    print(results.table())
    for way, matrix in confusion.items():
        print(f"\n{way}:\n{confusion_table(matrix)}")
    if options.json is not None:
        results.save(options.json)


def _visemes(options: EvaluateVisemesOptions) -> None:
    print(evaluate_visemes(options, progress=sys.stderr.isatty()).table())


COMMANDS = {
    "gava": _gava,
    "a2f": _audio2face,
    "gava-ablation": _gava_ablation,
    "gava-maps": _gava_maps,
    "motion": _motion,
    "visemes": _visemes,
    "audio2emotion": _emotion,
    "compare": _compare,
}
