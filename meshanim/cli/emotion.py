"""`meshanim emotion`: which emotions are heard in a speech, over time."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from meshanim.audio import load_waveform
from meshanim.errors import OptionError
from meshanim.files import check_writable
from meshanim.models.audio2emotion import (
    DetectedEmotions,
    EmotionDetector,
    EmotionOptions,
    detect_emotions,
    load_audio2emotion,
)
from meshanim.motion.emotions import HEARD_EMOTIONS
from meshanim.results import Results

__all__ = ["COMMANDS", "EmotionVerbOptions", "emotion"]


@dataclass(frozen=True)
class EmotionVerbOptions:
    """Say which emotions are heard in a speech, and write them over time for a face to follow.

    Example: meshanim emotion speech.wav -o emotions.csv
    """

    speech: Positional[Path]
    """Sound file."""
    output: Annotated[Path | None, arg(aliases=["-o"])] = None
    """Table of strengths over time, .csv, as Audio2Face-3D's clients write it."""
    neutral: Path | None = None
    """Neutral speech of the same voice: makes the guesses better without training."""
    model: str = "default"
    """Classifier: default (trained on synthetic voices), or what `meshanim train audio2emotion` wrote."""
    live: bool = False
    """As a stream hears it: every moment knows only the windows that ended before."""
    json: Path | None = None
    """Also write the probabilities of every window here."""
    post: OmitArgPrefixes[EmotionOptions] = field(default_factory=EmotionOptions)


def emotion(options: EmotionVerbOptions) -> None:
    """Run the verb."""
    if options.output is not None:
        if options.output.suffix.lower() != ".csv":
            raise OptionError(f"cannot write {options.output}: the ending must be .csv")
        check_writable(options.output)
    speech = load_waveform(options.speech)
    neutral = None if options.neutral is None else load_waveform(options.neutral)
    detector = EmotionDetector(load_audio2emotion(options.model), neutral=neutral)
    found = detect_emotions(speech, detector, options.post, mode="live" if options.live else "offline")
    print(_told(found))
    if options.model == "default":
        print("heard by the default classifier: trained on synthetic voices, not validated on people")
    if options.output is not None:
        found.save(options.output)
        print(f"wrote {options.output}: {len(found.track.times)} rows, {len(found.emotions)} emotions")
    if options.json is not None:
        _results(found).save(options.json)


def _told(found: DetectedEmotions) -> str:
    """A line a window: its middle, the class that is most probable, all probabilities."""
    lines = ["  seconds  heard     " + "".join(f"{name:>9s}" for name in HEARD_EMOTIONS)]
    for time, row in zip(found.times, found.probabilities):
        shares = "".join(f"{share:9.2f}" for share in row)
        lines.append(f"{time:9.2f}  {HEARD_EMOTIONS[int(row.argmax())]:10s}{shares}")
    return "\n".join(lines)


def _results(found: DetectedEmotions) -> Results:
    results = Results("emotion")
    for time, row in zip(found.times, found.probabilities):
        for name, share in zip(HEARD_EMOTIONS, row):
            results.add(f"{time:.2f} s", "audio2emotion", name, share, "share")
    return results


COMMANDS = emotion
