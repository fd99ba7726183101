"""The regression network frame by frame: samples in, states out once their windows are complete."""

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from meshanim.audio import SpeechEncoder, Waveform
from meshanim.audio.features import frame_count
from meshanim.errors import OptionError
from meshanim.models.audio2face.regression import STEP_TIMES, WINDOW, Audio2FaceRegression
from meshanim.models.audio2face.speech import RATE, EmotionTrack, FeatureReader, window_features

__all__ = ["RegressionStream", "animate_regression"]


class RegressionStream:
    """Animation states of speech that is still being spoken; all of all calls are those of the whole.

    A window of 8,320 samples slides by 16000 / fps (Sec. 4.1): a frame comes out 0.26 s after its time, or as
    much later as the encoder's features do. Memory does not grow with the length of the speech.

    Parameters
    ----------
    model : Audio2FaceRegression
        In eval mode.
    encoder : SpeechEncoder
        The one that the network was trained with.
    fps : float, optional
        Frames a second; the network's if not given.
    emotions : EmotionTrack, optional
        Explicit emotions over time; neutral if not given.
    implicit : (16,), optional
        What `implicit_of` gives; if not given the mean of the emotion that is strongest at the start;
        neutral has what the others leave.
    chunk : int
        Most frames computed at once.

    Raises
    ------
    OptionError
        If the encoder or the emotions do not fit the network, or fps is not positive.
    """

    def __init__(
        self,
        model: Audio2FaceRegression,
        encoder: SpeechEncoder,
        fps: float | None = None,
        emotions: EmotionTrack | None = None,
        implicit: Float[Tensor, " implicit"] | None = None,
        chunk: int = 64,
    ):
        config = model.config
        self.model, self.fps, self.chunk = model, float(config.fps if fps is None else fps), chunk
        if not (math.isfinite(self.fps) and self.fps > 0):
            raise OptionError(f"fps must be positive, not {fps}")
        if encoder.dim != config.feature_dim:
            raise OptionError(
                f"encoder {encoder.name} gives {encoder.dim} features, the network reads "
                f"{config.feature_dim}: it was trained with {config.encoder}"
            )
        self.emotions = EmotionTrack.of(config.emotions) if emotions is None else emotions
        if self.emotions.strengths.shape[1] != len(config.emotions):
            count = self.emotions.strengths.shape[1]
            raise OptionError(f"the track has {count} emotions, the network {len(config.emotions)}")
        if implicit is None:
            first = self.emotions.strengths[0]
            told = first.max(initial=0) >= max(1 - first.sum(), 1e-6)  # what is left is neutral's
            strongest = config.emotions[int(first.argmax())] if told else "neutral"
            implicit = model.implicit_of(strongest)
        self.implicit = implicit.to(model.device)
        self.reader = FeatureReader(encoder, config.hearing)
        self.given = 0

    def push(self, samples: Float[np.ndarray, " samples"]) -> Float[Tensor, "frames state"]:
        """Take the next samples, 16 kHz; give the states of the frames they complete (maybe none).

        Raises
        ------
        ShapeError
            If a sample is NaN or infinite.
        OptionError
            If the stream is finished.
        """
        self.reader.push(samples)
        ready = self.given
        while self._complete(ready):
            ready += 1
        return self._frames(ready)

    def finish(self, frames: int | None = None) -> Float[Tensor, "frames state"]:
        """End the speech and give the last states.

        Parameters
        ----------
        frames : int, optional
            Of the whole; as many as cover the speech if not given.

        Raises
        ------
        ShapeError
            If there were no samples.
        """
        self.reader.finish()
        if frames is None:
            frames = max(1, math.ceil(self.reader.received * self.fps / RATE - 1e-9))
        return self._frames(frames)

    def _time(self, frame: int) -> float:
        return (frame + 0.5) / self.fps

    def _start(self, frame: int) -> int:
        return round(self._time(frame) * RATE - WINDOW / 2)

    def _complete(self, frame: int) -> bool:
        last = self._time(frame) + float(STEP_TIMES[-1])
        return not self.reader.ended and self.reader.reaches(self._start(frame) + WINDOW, last)

    @torch.inference_mode()
    def _frames(self, until: int) -> Float[Tensor, "frames state"]:
        model, parts = self.model, []
        while self.given < until:
            frames = range(self.given, min(until, self.given + self.chunk))
            windows = self.reader.windows([self._start(frame) for frame in frames], WINDOW)
            times = torch.tensor([self._time(frame) for frame in frames], dtype=torch.float64)
            steps = torch.from_numpy(STEP_TIMES)
            if self.reader.mode == "window":
                features = window_features(self.reader.encoder, windows, steps + WINDOW / 2 / RATE)
            else:
                features = self.reader.features_at(times[:, None] + steps)
            explicit = self.emotions.at(times.numpy()).to(model.device)
            implicit = self.implicit.expand(len(frames), -1)
            out = model(windows.to(model.device), features.to(model.device), explicit, implicit)
            parts.append(out.states)
            self.given = frames.stop
        self.reader.forget(self._start(self.given), self._time(self.given) + float(STEP_TIMES[0]))
        return torch.cat(parts) if parts else torch.zeros(0, model.actors.basis.width, device=model.device)


def animate_regression(
    model: Audio2FaceRegression,
    encoder: SpeechEncoder,
    waveform: Waveform,
    fps: float | None = None,
    emotions: EmotionTrack | None = None,
    implicit: Float[Tensor, " implicit"] | None = None,
) -> Float[Tensor, "frames state"]:
    """Animation states of whole speech, through the stream a second at a time.

    Parameters
    ----------
    model, encoder, fps, emotions, implicit
        As `RegressionStream`.
    waveform : Waveform
        Speech at any rate.
    """
    stream = RegressionStream(model, encoder, fps, emotions, implicit)
    samples = waveform.resampled(RATE).samples
    parts = [stream.push(samples[first : first + RATE]) for first in range(0, len(samples), RATE)]
    return torch.cat([*parts, stream.finish(frame_count(waveform, stream.fps))])
