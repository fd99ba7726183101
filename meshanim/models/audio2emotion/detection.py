"""Emotions of speech over time: double sliding windows, interpolated in files, smoothed in streams."""

import csv
import math
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from huggingface_hub.errors import HfHubHTTPError, HFValidationError, LocalEntryNotFoundError
from jaxtyping import Float, Float32, Float64

from meshanim.audio import SpeechEncoder, Waveform
from meshanim.errors import FileFormatError, OptionError, ShapeError
from meshanim.files import written_whole
from meshanim.models.audio2emotion.features import RATE, EmotionFeatures
from meshanim.models.audio2emotion.network import Audio2Emotion
from meshanim.models.audio2emotion.postprocessing import EmotionOptions, EmotionPostProcessor
from meshanim.models.audio2face.speech import EmotionTrack
from meshanim.models.checkpoint import CONFIG
from meshanim.motion.emotions import EMOTIONS, HEARD_EMOTIONS

__all__ = [
    "DetectedEmotions",
    "EmotionDetector",
    "EmotionStream",
    "Timeline",
    "detect_emotions",
    "load_audio2emotion",
]

QUIET = 1e-3
"""A stretch without a sample above this (-60 dB) is neutral."""
NEUTRAL = HEARD_EMOTIONS.index("neutral")
Mode = Literal["offline", "live"]


@dataclass(frozen=True)
class Timeline:
    """The double sliding window (App. A.1), seconds.

    Parameters
    ----------
    window : float
        What one key of the timeline hears.
    stride : float
        Between windows.
    sub_stride : float
        Between the stretches in a window, over which probabilities are averaged.
    """

    window: float = 1.9
    stride: float = 0.5
    sub_stride: float = 0.31

    def __post_init__(self):
        if not (self.window > 0 and self.stride > 0 and self.sub_stride > 0 and self.stride <= self.window):
            raise OptionError(f"windows {self} need seconds above 0, and a stride no longer than the window")

    def windows(self, samples: int) -> int:
        """How many windows a sound has: the last reaches its end, and may be cut by it."""
        excess = samples / RATE - self.window
        return 1 if excess <= 0 else math.ceil(excess / self.stride - 1e-9) + 1

    def span(self, index: int, samples: int) -> tuple[int, int]:
        """First sample of a window and the one behind its last."""
        start = round(index * self.stride * RATE)
        return start, min(start + round(self.window * RATE), samples)


class EmotionDetector:
    """A classifier that listens.

    Parameters
    ----------
    network : Audio2Emotion
    encoder : SpeechEncoder, optional
        The network's by name if not given.
    neutral : Waveform, optional
        Neutral speech of the voice that will speak: personalisation without training (App. A.4).
    timeline : Timeline, optional
    """

    def __init__(
        self,
        network: Audio2Emotion,
        encoder: SpeechEncoder | None = None,
        neutral: Waveform | None = None,
        timeline: Timeline | None = None,
    ):
        self.network = network.eval()
        self.features = EmotionFeatures(network.config, encoder)
        self.neutral = None if neutral is None else neutral.resampled(RATE).samples
        self.timeline = Timeline() if timeline is None else timeline

    @torch.inference_mode()
    def probabilities(self, samples: Float32[np.ndarray, " samples"]) -> Float64[np.ndarray, " classes"]:
        """Of `HEARD_EMOTIONS` in one window: the mean over its stretches, 16 kHz samples."""
        step, crop = round(self.timeline.sub_stride * RATE), self.features.crop
        starts = range(0, max(len(samples) - crop, 0) + 1, step)
        found = np.zeros((len(starts), len(HEARD_EMOTIONS)))
        device = self.network.feature_mean.device
        for row, start in zip(found, starts):
            part = samples[start : start + crop]
            if np.abs(part).max(initial=0.0) < QUIET:
                row[NEUTRAL] = 1.0
                continue
            if self.neutral is None:
                logits = self.network(self.features.alone(part)[None].to(device))
            else:
                heard, reference = self.features.after(part, self.neutral)
                logits = self.network(heard[None].to(device), reference[None].to(device))
            row[:] = logits[0].double().softmax(0).cpu().numpy()
        return found.mean(0)

    def keys(
        self, waveform: Waveform
    ) -> tuple[Float64[np.ndarray, " keys"], Float64[np.ndarray, "keys classes"]]:
        """Middles of the windows of a whole speech, seconds, and their probabilities."""
        samples = waveform.resampled(RATE).samples
        spans = [self.timeline.span(k, len(samples)) for k in range(self.timeline.windows(len(samples)))]
        times = np.array([(start + end) / 2 / RATE for start, end in spans])
        return times, np.stack([self.probabilities(samples[start:end]) for start, end in spans])


class EmotionStream:
    """Emotions of speech that is still being spoken.

    A frame is given as soon as the sound has reached its time; it knows the windows that ended before. All
    frames of all calls are those of `detect_emotions(..., mode="live")`.

    Parameters
    ----------
    detector : EmotionDetector
    options : EmotionOptions, optional
    emotions : sequence of str
        Of the face.

    Attributes
    ----------
    preferred : EmotionTrack, optional
        Preferred emotions over time, which frames from the next one on follow instead of the options' one.
    """

    def __init__(
        self,
        detector: EmotionDetector,
        options: EmotionOptions | None = None,
        emotions: tuple[str, ...] = EMOTIONS,
    ):
        self.detector = detector
        self.processor = EmotionPostProcessor(options or EmotionOptions(), emotions)
        self.samples = np.zeros(0, np.float32)
        self.dropped = self.windows = self.frames = 0
        self.latest = np.eye(len(HEARD_EMOTIONS))[NEUTRAL]
        self.ended = False
        self.preferred: EmotionTrack | None = None

    def push(self, samples: Float[np.ndarray, " samples"]) -> Float64[np.ndarray, "frames emotions"]:
        """Take the next samples, 16 kHz; give the strengths that they complete.

        Raises
        ------
        ShapeError
            If a sample is NaN or infinite.
        OptionError
            If the stream is finished.
        """
        if self.ended:
            raise OptionError("the stream is finished; start another one")
        block = np.asarray(samples, np.float32)
        if not np.isfinite(block).all():
            raise ShapeError("a block holds NaN or infinity; expected finite samples")
        self.samples = np.concatenate([self.samples, block])
        return self._advance()

    def finish(self) -> Float64[np.ndarray, "frames emotions"]:
        """End the speech and give the last frames.

        Raises
        ------
        ShapeError
            If there were no samples.
        """
        if self.ended:
            raise OptionError("the stream is finished; start another one")
        if not self.dropped + len(self.samples):
            raise ShapeError("the stream got no samples; expected at least one before finish()")
        self.ended = True
        return self._advance()

    def _advance(self) -> Float64[np.ndarray, "frames emotions"]:
        timeline, received = self.detector.timeline, self.dropped + len(self.samples)
        whole = round(timeline.window * RATE)
        parts = []
        while True:
            start, end = timeline.span(self.windows, received)
            if end - start < whole:
                break
            parts.append(self._frames(end))
            self.latest = self.detector.probabilities(self.samples[start - self.dropped : end - self.dropped])
            self.windows += 1
        parts.append(self._frames(received))
        keep = timeline.span(self.windows, received)[0] - self.dropped
        if keep > 0:
            self.samples, self.dropped = self.samples[keep:], self.dropped + min(keep, len(self.samples))
        return np.concatenate(parts)

    def _frames(self, end: int) -> Float64[np.ndarray, "frames emotions"]:
        """Frames whose times lie before a sample, by the window that is known."""
        step = self.processor.options.fixed_dt * RATE
        count = max(0, math.ceil(end / step - 1e-9) - self.frames)
        times = (self.frames + np.arange(count)) * self.processor.options.fixed_dt
        preferred = None if self.preferred is None else self.preferred.at(times).double().numpy()
        self.frames += count
        return self.processor.push(np.repeat(self.latest[None], count, 0), preferred)


@dataclass(frozen=True)
class DetectedEmotions:
    """What was heard in a speech.

    Parameters
    ----------
    emotions : tuple of str
        Of the face.
    times, probabilities : (K,), (K, 6)
        Middles of the windows, seconds, and probabilities of `HEARD_EMOTIONS`.
    track : EmotionTrack
        Strengths of `emotions` after post-processing, a key every `fixed_dt` seconds.
    """

    emotions: tuple[str, ...]
    times: Float64[np.ndarray, " keys"]
    probabilities: Float64[np.ndarray, "keys classes"]
    track: EmotionTrack

    def save(self, path: str | Path) -> None:
        """Write the track as Audio2Face-3D's clients write a2f_smoothed_emotion_output.csv.

        A column without a name that counts rows, `time_code` in seconds, `emotion_values.amazement` and so
        on. Source: NVIDIA/Audio2Face-3D-Samples, by pandas' `json_normalize` and `to_csv`.

        Raises
        ------
        OptionError
            If the path does not end in .csv.
        """
        if Path(path).suffix.lower() != ".csv":
            raise OptionError(f"emotions are written as .csv, not {path}")
        with written_whole(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as text:
            writer = csv.writer(text, lineterminator="\n")
            writer.writerow(["", "time_code", *(f"emotion_values.{name}" for name in self.emotions)])
            rows = zip(self.track.times.tolist(), self.track.strengths.tolist())
            for number, (time, strengths) in enumerate(rows):
                writer.writerow([number, repr(time), *map(repr, strengths)])


def detect_emotions(
    waveform: Waveform,
    detector: EmotionDetector,
    options: EmotionOptions | None = None,
    emotions: tuple[str, ...] = EMOTIONS,
    mode: Mode = "offline",
) -> DetectedEmotions:
    """Emotions of a whole speech.

    Parameters
    ----------
    waveform : Waveform
        Speech, any rate.
    detector : EmotionDetector
    options : EmotionOptions, optional
        Of post-processing.
    emotions : tuple of str
        Of the face.
    mode : "offline" or "live"
        Offline is linear between the middles of windows; live is what a stream gives: each frame knows the
        windows that ended before it, about a second late.
    """
    options = options or EmotionOptions()
    waveform = waveform.resampled(RATE)
    times, probabilities = detector.keys(waveform)
    if mode == "live":
        stream = EmotionStream(detector, options, emotions)
        strengths = np.concatenate([stream.push(waveform.samples), stream.finish()])
    else:
        count = math.ceil(len(waveform.samples) / RATE / options.fixed_dt - 1e-9)
        frames = np.arange(count) * options.fixed_dt
        raw = np.stack([np.interp(frames, times, column) for column in probabilities.T], 1)
        strengths = EmotionPostProcessor(options, emotions).push(raw)
    track = EmotionTrack(np.arange(len(strengths)) * options.fixed_dt, strengths)
    return DetectedEmotions(emotions, times, probabilities, track)


def load_audio2emotion(name: str | Path = "default") -> Audio2Emotion:
    """A classifier: "default", a folder that `meshanim train audio2emotion` wrote, or a hub repository.

    Raises
    ------
    FileFormatError
        If it is missing or damaged.
    """
    if str(name) == "default":
        path = Path(str(files("meshanim") / "models" / "weights" / "audio2emotion-default"))
    else:
        path = Path(name)
        if not (path / CONFIG).exists() and (path / "model" / CONFIG).exists():
            path = path / "model"
    try:
        return Audio2Emotion.from_pretrained(str(path))
    except (HfHubHTTPError, LocalEntryNotFoundError, HFValidationError) as error:
        raise FileFormatError(
            f"no classifier of emotions {name}: neither a folder here nor a repository of the hub that can "
            "be reached"
        ) from error
    except (ValueError, TypeError, OSError) as error:
        raise FileFormatError(f"no classifier of emotions {name}: {error}") from error
