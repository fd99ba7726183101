"""Emotions of one gRPC stream: what its client says, and what is heard in the voice where it asks for it."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import soxr
from jaxtyping import Float32, Float64

from meshanim.errors import MeshanimError
from meshanim.models.audio2emotion import EmotionDetector, EmotionOptions, EmotionStream
from meshanim.models.audio2face import EmotionTrack

__all__ = ["RequestError", "StreamEmotions"]

KEYS = 1000
"""Most emotions that a stream keeps."""
KEPT = 0.5
"""Seconds of heard emotions that are kept behind the last frame: networks read a few frames again."""
RATE = 16000
OTHER_NAMES = {"amazement": "surprise", "grief": "sadness"}
"""What networks that lack one of NVIDIA's emotions are told instead."""


class RequestError(MeshanimError):
    """What a client sent cannot be animated; the message goes back with INVALID_ARGUMENT."""


class StreamEmotions:
    """Emotions of one stream.

    Without a detector a network follows the client's emotions as they are. With one, what is heard is
    post-processed as the header says, with the client's emotions as the preferred ones, which is what the
    protocol says of them; the result is known a frame of post-processing (33 ms) after its time, so that it
    does not depend on how the sound is cut.

    Parameters
    ----------
    known : tuple of str
        Emotions that the network is told, but neutral.
    header : AudioWithEmotionStreamHeader
    detector : EmotionDetector, optional
        Shared by streams.

    Raises
    ------
    RequestError, OptionError
        If a number of the header is out of its range.
    """

    def __init__(self, known: tuple[str, ...], header: Any, detector: EmotionDetector | None):
        self.known = known
        self.unknown: set[str] = set()
        self.told: list[tuple[float, dict[str, float]]] = []
        self.news: list[tuple[float, dict[str, float]]] = []
        self.times: list[float] = []
        self.rows: list[Float64[np.ndarray, " emotions"]] = []
        beginning = self._mixture(header.emotion_params.beginning_emotion)
        self.stream = None
        if detector is None:
            self.told = [(0.0, beginning)] if beginning else []
        else:
            options = _options(header, beginning)
            self.stream = EmotionStream(detector, options, known)
            beginning = {name: options.emotion_strength * value for name, value in beginning.items()}
            rate = header.audio_header.samples_per_second
            self.resample = soxr.ResampleStream(rate, RATE, 1, "float32") if rate != RATE else None
        self.track = EmotionTrack.of(known, (0.0, beginning))

    def _mixture(self, strengths: Mapping[str, float]) -> dict[str, float]:
        """Those that the network knows; the others are noted."""
        if not all(0 <= value <= 1 for value in strengths.values()):
            raise RequestError("emotions must lie within 0 to 1, and their times be finite")
        mixture: dict[str, float] = {}
        for name, value in strengths.items():
            own = name if name in self.known else OTHER_NAMES.get(name, name)
            if own in self.known:
                mixture[own] = max(value, mixture.get(own, 0.0))
            elif value > 0 and name != "neutral":
                self.unknown.add(name)
        return mixture

    def tell(self, keys: Iterable[tuple[float, Mapping[str, float]]], seconds: float) -> None:
        """Take the client's emotions at times; those before `seconds`, which frames have passed, are dropped.

        Raises
        ------
        RequestError
            If one is out of its range, or there are too many.
        """
        for time, strengths in keys:
            if not np.isfinite(time):
                raise RequestError("emotions must lie within 0 to 1, and their times be finite")
            self.told.append((time, self._mixture(strengths)))
            self.news.append((time, dict(strengths)))
            if len(self.news) > KEYS:
                raise RequestError(f"more than {KEYS} emotions ahead of the sound")
        if self.stream is not None:
            seconds = self.stream.frames * self.stream.processor.options.fixed_dt
        # Linear between two keys: of those that frames have passed, the last one is still needed.
        self.told.sort(key=lambda key: key[0])
        past = [key for key in self.told if key[0] <= seconds]
        self.told = [*past[-1:], *self.told[len(past) :]]
        if len(self.told) > KEYS:
            raise RequestError(f"more than {KEYS} emotions ahead of the sound")
        if not self.told:
            return
        if self.stream is None:
            self.track = EmotionTrack.of(self.known, *self.told)
        else:
            self.stream.preferred = EmotionTrack.of(self.known, *self.told)

    def hear(self, samples: Float32[np.ndarray, " samples"], last: bool) -> None:
        """Listen to the next samples, at the client's rate, before the network does."""
        if self.stream is None:
            return
        stream = self.stream
        if self.resample is not None:
            samples = self.resample.resample_chunk(samples, last=last)
        begin, step = stream.frames, stream.processor.options.fixed_dt
        rows = stream.push(samples)
        self.times += [(begin + k + 1) * step for k in range(len(rows))]
        self.rows += list(rows)
        if self.rows:
            self.track = EmotionTrack(np.array(self.times), np.stack(self.rows))

    def forget(self, seconds: float) -> None:
        """Drop what frames after `seconds` no longer read."""
        count = sum(time < seconds - KEPT for time in self.times[:-1])
        self.times, self.rows = self.times[count:], self.rows[count:]

    def aggregate(self, seconds: float) -> Any:
        """EmotionAggregate of a frame: what was told since the frame before, and what it shows.

        Its `a2e_output` stays empty: NVIDIA's sample client (2.0) fails where it is not.
        """
        from nvidia_audio2face_3d.messages_pb2 import EmotionAggregate, EmotionWithTimeCode

        def keys(found: list[tuple[float, dict[str, float]]]) -> list[EmotionWithTimeCode]:
            return [EmotionWithTimeCode(time_code=time, emotion=emotion) for time, emotion in found]

        shown = dict(zip(self.known, self.track.at(np.array([seconds]))[0].tolist()))
        answer = EmotionAggregate(
            input_emotions=keys(self.news), a2f_smoothed_output=keys([(seconds, shown)])
        )
        self.news = []
        return answer


def _options(header: Any, beginning: Mapping[str, float]) -> EmotionOptions:
    """Post-processing as a header says, what it does not say as the protocol has it."""
    post, names = header.emotion_post_processing_params, EmotionOptions.__dataclass_fields__
    given = {name: getattr(post, name) for name in post.DESCRIPTOR.fields_by_name if post.HasField(name)}
    given = {name: value for name, value in given.items() if name in names}
    if header.emotion_params.HasField("live_transition_time"):
        given["transition_smoothing"] = header.emotion_params.live_transition_time
    return EmotionOptions(**{"enable_preferred_emotion": True, **given}, beginning=dict(beginning))
