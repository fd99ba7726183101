"""What both Audio2Face networks hear and are told: features at times, windows of sound, emotions."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64
from torch import Tensor

from meshanim.audio import SpeechEncoder, Waveform
from meshanim.errors import OptionError, ShapeError

__all__ = [
    "EmotionTrack",
    "FeatureReader",
    "Hearing",
    "features_at",
    "hearing",
    "window_features",
]

RATE = 16000
Hearing = Literal["speech", "window"]
"""Whether features come from the whole speech, or from each window of sound alone."""


def features_at(
    features: Float[Tensor, "steps dim"], rate: float, times: Float64[Tensor, "*times"]
) -> Float[Tensor, "*times dim"]:
    """Features at any times by linear interpolation; before the first and after the last step, those.

    Parameters
    ----------
    features : (steps, dim)
        Step k describes time (k + 0.5) / rate.
    rate : float
        Steps a second.
    times : (...,) float64
        Seconds.

    Raises
    ------
    ShapeError
        If there are no features.
    """
    if not len(features):
        raise ShapeError("features have no steps; expected (steps, dim) with steps > 0")
    position = (times * rate - 0.5).clamp(0, len(features) - 1)
    lower = position.floor().long()
    upper = (lower + 1).clamp(max=len(features) - 1)
    weight = (position - lower).to(features.dtype)[..., None]
    return features[lower] * (1 - weight) + features[upper] * weight


def hearing(encoder: SpeechEncoder) -> Hearing:
    """How an encoder is best listened through: "speech" where it streams, "window" where it does not."""
    try:
        encoder.stream()
    except OptionError:
        return "window"
    return "speech"


def window_features(
    encoder: SpeechEncoder, windows: Float32[Tensor, "batch samples"], times: Float64[Tensor, " steps"]
) -> Float32[Tensor, "batch steps dim"]:
    """Features of windows of sound that are heard alone, at times from their beginning, seconds."""
    found = [
        features_at(encoder(Waveform(window.numpy(), RATE)), encoder.rate, times) for window in windows.cpu()
    ]
    return torch.stack(found)


def cut_windows(
    samples: Float32[Tensor, " samples"], starts: Sequence[int], width: int
) -> Float32[Tensor, "batch width"]:
    """Windows from each start on, zeros beyond both ends."""
    out = samples.new_zeros(len(starts), width)
    for row, start in zip(out, starts):
        first, last = max(start, 0), min(start + width, len(samples))
        if first < last:
            row[first - start : last - start] = samples[first:last]
    return out


@dataclass(frozen=True)
class EmotionTrack:
    """Strengths of emotions over time: linear between keys, constant before the first and after the last.

    Parameters
    ----------
    times : (K,) array
        Seconds, rising.
    strengths : (K, E) array
        Of the emotions of a network, 0 to 1; all zero is neutral.

    Raises
    ------
    ShapeError
        If they do not fit together, times fall, or a number is not finite.
    """

    times: Float64[np.ndarray, " keys"]
    strengths: Float64[np.ndarray, "keys emotions"]

    def __post_init__(self):
        times, strengths = np.asarray(self.times, np.float64), np.asarray(self.strengths, np.float64)
        if times.ndim != 1 or not len(times) or strengths.shape[:1] != times.shape or strengths.ndim != 2:
            raise ShapeError(
                f"times have shape {times.shape} and strengths {strengths.shape}; expected (K,), (K, E)"
            )
        if not (np.isfinite(times).all() and np.isfinite(strengths).all()) or (np.diff(times) < 0).any():
            raise ShapeError("keys of emotions must be finite and their times must not fall")
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "strengths", strengths)

    @classmethod
    def of(
        cls, emotions: Sequence[str], *keys: tuple[float, Mapping[str, float]], constant: str = "neutral"
    ) -> "EmotionTrack":
        """A track from names.

        Parameters
        ----------
        emotions : sequence of str
            Those of a network.
        *keys : (seconds, mapping of str to float)
            Strengths by name at times; emotions that are not named are 0.
        constant : str
            One emotion at full strength throughout, where there are no keys.

        Raises
        ------
        OptionError
            If a network has no such emotion.
        """
        ordered = sorted(keys or [(0.0, {constant: 1.0})], key=lambda key: key[0])
        rows = np.zeros((len(ordered), len(emotions)))
        for row, (_, mixture) in zip(rows, ordered):
            for name, strength in mixture.items():
                if name not in ("neutral", *emotions):
                    raise OptionError(f"no emotion {name!r}; there are neutral, {', '.join(emotions)}")
                if name != "neutral":
                    row[list(emotions).index(name)] = strength
        return cls(np.array([time for time, _ in ordered]), rows)

    def at(self, times: Float64[np.ndarray, " frames"]) -> Float32[Tensor, "frames emotions"]:
        """Strengths at times, seconds."""
        columns = [np.interp(times, self.times, column) for column in self.strengths.T]
        values = np.stack(columns, axis=1) if columns else np.zeros((len(times), 0))
        return torch.from_numpy(values.astype(np.float32))


class FeatureReader:
    """Sound of a stream and its features, of which only what later frames need is kept.

    Parameters
    ----------
    encoder : SpeechEncoder
        At 16 kHz.
    mode : Hearing
        "speech" needs an encoder that streams.
    """

    def __init__(self, encoder: SpeechEncoder, mode: Hearing):
        self.encoder, self.mode = encoder, mode
        self.stream = encoder.stream() if mode == "speech" else None
        self.samples, self.dropped = torch.zeros(0), 0
        self.features, self.forgotten = torch.zeros(0, encoder.dim), 0
        self.ended = False

    @property
    def received(self) -> int:
        """Samples so far."""
        return self.dropped + len(self.samples)

    def push(self, samples: Float[np.ndarray, " samples"]) -> None:
        """Take the next samples, 16 kHz.

        Raises
        ------
        ShapeError
            If one is NaN or infinite.
        OptionError
            If the stream is finished.
        """
        if self.ended:
            raise OptionError("the stream is finished; start another one")
        block = np.array(samples, np.float32)
        if not np.isfinite(block).all():
            raise ShapeError("a block holds NaN or infinity; expected finite samples")
        self.samples = torch.cat([self.samples, torch.from_numpy(block)])
        if self.stream is not None and len(block):
            self.features = torch.cat([self.features, self.stream.push(block)])

    def finish(self) -> None:
        """End the speech.

        Raises
        ------
        ShapeError
            If there were no samples.
        """
        if self.ended:
            raise OptionError("the stream is finished; start another one")
        if not self.received:
            raise ShapeError("the stream got no samples; expected at least one before finish()")
        self.ended = True
        if self.stream is not None:
            self.features = torch.cat([self.features, self.stream.finish()])

    def reaches(self, sample: float, time: float) -> bool:
        """Whether all samples before one and the features up to a time are there."""
        if self.ended:
            return True
        if self.received < math.ceil(sample):
            return False
        known = self.forgotten + len(self.features)
        return self.stream is None or bool(time * self.encoder.rate - 0.5 <= known - 1)

    def windows(self, starts: Sequence[int], width: int) -> Float32[Tensor, "batch width"]:
        """Windows of sound by their first samples, zeros beyond the ends."""
        return cut_windows(self.samples, [start - self.dropped for start in starts], width)

    def features_at(self, times: Float64[Tensor, "*times"]) -> Float32[Tensor, "*times dim"]:
        """Features of the stream at times, seconds."""
        return features_at(self.features, self.encoder.rate, times - self.forgotten / self.encoder.rate)

    def forget(self, sample: int, time: float) -> None:
        """Drop samples before one and features before a time; at least one feature is kept."""
        count = min(max(sample - self.dropped, 0), len(self.samples))
        if count:
            self.samples, self.dropped = self.samples[count:].clone(), self.dropped + count
        step = math.floor(time * self.encoder.rate - 0.5) - self.forgotten
        step = min(step, len(self.features) - 1)
        if step > 0:
            self.features, self.forgotten = self.features[step:].clone(), self.forgotten + step
