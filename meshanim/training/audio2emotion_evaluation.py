"""How often a classifier of emotions is right, clip by clip: alone, behind a neutral sample, fine-tuned."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Int
from tqdm import tqdm

from meshanim.audio import load_waveform
from meshanim.datasets.emotional import EmotionalClip, read_emotional, split_speakers
from meshanim.errors import OptionError
from meshanim.models.audio2emotion.detection import EmotionDetector, load_audio2emotion
from meshanim.models.audio2emotion.network import Audio2Emotion
from meshanim.motion.emotions import HEARD_EMOTIONS
from meshanim.results import Results
from meshanim.training.audio2emotion import fine_tuned, heard_samples

__all__ = ["EvaluateEmotionOptions", "confusion_table", "evaluate_emotion"]

Confusion = Int[np.ndarray, "true guessed"]


@dataclass(frozen=True)
class EvaluateEmotionOptions:
    """How often a classifier of emotions is right on clips of speakers it was not trained on.

    Example: meshanim evaluate audio2emotion --data TESS SAVEE
    """

    data: tuple[Path, ...]
    """Corpora of emotional speech, as of `meshanim train audio2emotion`."""
    model: str = "default"
    """The classifier."""
    held_out: float = 1.0
    """Share of each corpus's speakers, the last ones by name; that of the training for its own corpora."""
    fine_tune: int = 0
    """Also fine-tune on this many clips an emotion of each speaker, and test on the speaker's others."""
    seed: int = 0
    """Of which clips those are."""
    json: Path | None = None
    """Also write the numbers here."""

    def __post_init__(self):
        if not 0 < self.held_out <= 1 or self.fine_tune < 0:
            raise OptionError("held_out must be within 0 to 1, fine_tune not negative")

    def clips(self) -> list[EmotionalClip]:
        """Those that are tested.

        Raises
        ------
        FileFormatError, OptionError
            If a corpus cannot be read.
        """
        everything = [clip for folder in self.data for clip in read_emotional(folder)]
        return everything if self.held_out == 1 else split_speakers(everything, self.held_out)[1]


def evaluate_emotion(
    model: str | Path | Audio2Emotion,
    clips: Sequence[EmotionalClip],
    fine_tune: int = 0,
    seed: int = 0,
    progress: bool = False,
) -> tuple[Results, dict[str, Confusion]]:
    """Accuracy of the three ways on the same clips, and their confusion matrices.

    Clips that a way needs for itself (the neutral sample; those to tune on) are left out of all of them.

    Parameters
    ----------
    model : str, Path or Audio2Emotion
    clips : sequence of EmotionalClip
        Speakers that the classifier was not trained on.
    fine_tune : int
        Clips an emotion of each speaker to tune on; 0 leaves that way out.
    seed : int
    progress : bool

    Returns
    -------
    Results, dict of str to (6, 6) int
        Rows are true classes, columns guesses.
    """
    network = model if isinstance(model, Audio2Emotion) else load_audio2emotion(model)
    plain = EmotionDetector(network)
    ways = ["alone", "neutral sample"] + ["fine-tuned"] * (fine_tune > 0)
    confusion = {way: np.zeros((len(HEARD_EMOTIONS),) * 2, np.int64) for way in ways}
    people = sorted({clip.speaker for clip in clips})
    generator = np.random.default_rng([seed, 0xE7])
    for speaker in tqdm(people, desc="speakers", disable=not progress):
        own = [clip for clip in clips if clip.speaker == speaker]
        shuffled = [own[k] for k in generator.permutation(len(own))]
        neutral = next((clip for clip in shuffled if clip.emotion == "neutral"), None)
        tuning: list[EmotionalClip] = []
        for emotion in HEARD_EMOTIONS:
            tuning += [clip for clip in shuffled if clip.emotion == emotion][:fine_tune]
        taken = {clip.path for clip in tuning} | ({neutral.path} if neutral is not None else set())
        tested = [clip for clip in own if clip.path not in taken]
        detectors = {"alone": plain}
        if neutral is not None:
            sample = load_waveform(neutral.path)
            detectors["neutral sample"] = EmotionDetector(network, plain.features.encoder, sample)
        if tuning and tested:
            tuned = fine_tuned(network, plain.features, tuning, seed=seed)
            detectors["fine-tuned"] = EmotionDetector(tuned, plain.features.encoder)
        for clip in tested:
            samples = heard_samples(load_waveform(clip.path))
            for way, detector in detectors.items():
                guess = int(detector.probabilities(samples).argmax())
                confusion[way][HEARD_EMOTIONS.index(clip.emotion), guess] += 1
    results = Results("audio2emotion")
    for way, matrix in confusion.items():
        total = int(matrix.sum())
        if not total:
            continue
        present = matrix.sum(1) > 0
        recall = np.diag(matrix)[present] / matrix.sum(1)[present]
        case = f"{total} clips, {len(people)} speakers"
        results.add(case, way, "accuracy", np.trace(matrix) / total, "share")
        results.add(case, way, "mean recall", float(recall.mean()), "share")
        results.add(case, way, "chance", 1 / int(present.sum()), "share")
        for row, name in enumerate(HEARD_EMOTIONS):
            if present[row]:
                results.add(case, way, f"recall {name}", matrix[row, row] / matrix[row].sum(), "share")
    return results, confusion


def confusion_table(matrix: Confusion) -> str:
    """Rows are what was acted, columns what was guessed, counts."""
    names = [name[:7] for name in HEARD_EMOTIONS]
    lines = [f"{'':10s}" + "".join(f"{name:>8s}" for name in names)]
    lines += [
        f"{name:10s}" + "".join(f"{count:8d}" for count in row) for name, row in zip(HEARD_EMOTIONS, matrix)
    ]
    return "\n".join(lines)
