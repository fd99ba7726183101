"""Phonemes in time to mouth and jaw: coarticulation, seals, labiodental contact."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d

from meshanim.datasets.synthetic.style import SpeakingStyle
from meshanim.datasets.synthetic.visemes import (
    ARTICULATORS,
    BILABIALS,
    DIPHTHONGS,
    LABIODENTALS,
    PHONEMES,
    SILENCE,
    VISEMES,
    VOWELS,
)
from meshanim.errors import OptionError
from meshanim.motion.idle import smoothstep
from meshanim.motion.pose import CONTROL_RATE

__all__ = ["Segment", "TimedPhoneme", "articulate", "holds", "segments"]

_CLOSED_SHARE = {"P": 0.80, "B": 0.90, "M": 1.0}
"""Share of a bilabial that is closed; the rest of P and B is burst and breath."""
_LABIODENTAL = {
    "jawOpen": 0.02,
    "mouthRollLower": 0.55,
    "mouthShrugLower": 0.32,
    "mouthUpperUp": 0.46,
}
_SEALED_JAW = 0.12


@runtime_checkable
class TimedPhoneme(Protocol):
    """Anything with a start and an end in seconds and an ARPAbet symbol: `meshanim.audio.Phoneme`."""

    @property
    def start(self) -> float: ...
    @property
    def end(self) -> float: ...
    @property
    def symbol(self) -> str: ...


@dataclass(frozen=True)
class Segment:
    """A stretch of one articulatory target.

    Parameters
    ----------
    start, end : float
        Seconds.
    viseme : str
        Key of `VISEMES`.
    phoneme : str
        ARPAbet symbol that it belongs to, or SIL.
    """

    start: float
    end: float
    viseme: str
    phoneme: str


def segments(phonemes: Sequence[TimedPhoneme], duration: float) -> list[Segment]:
    """Cover [0, duration] without gaps: silence between phonemes, diphthongs in two parts.

    Raises
    ------
    OptionError
        For a symbol that is not ARPAbet, a phoneme that ends before it starts, or one out of order.
    """
    result: list[Segment] = []
    now = previous = 0.0
    for phoneme in phonemes:
        symbol = phoneme.symbol.rstrip("012").upper()
        if symbol not in PHONEMES and symbol != SILENCE:
            known = " ".join(sorted(PHONEMES))
            raise OptionError(f"no ARPAbet phoneme {phoneme.symbol!r}: expected SIL or one of {known}")
        if not phoneme.start < phoneme.end or phoneme.start < previous - 1e-3:
            span = f"{phoneme.start:g} to {phoneme.end:g} s"
            raise OptionError(f"phoneme {symbol} from {span}: phonemes must follow each other in time")
        previous = phoneme.end
        start, end = max(phoneme.start, now), min(phoneme.end, duration)
        if end - start < 1e-6:
            continue
        if start > now + 1e-6:
            result.append(Segment(now, start, SILENCE, SILENCE))
        if symbol in DIPHTHONGS:
            first, second = DIPHTHONGS[symbol]
            middle = start + 0.55 * (end - start)
            result.append(Segment(start, middle, first, symbol))
            result.append(Segment(middle, end, second, symbol))
        else:
            result.append(Segment(start, end, symbol, symbol))
        now = end
    if duration > now:
        result.append(Segment(now, duration, SILENCE, SILENCE))
    return _joined_silence(result)


def _joined_silence(parts: list[Segment]) -> list[Segment]:
    joined: list[Segment] = []
    for part in parts:
        if joined and part.phoneme == SILENCE == joined[-1].phoneme:
            joined[-1] = Segment(joined[-1].start, part.end, SILENCE, SILENCE)
        else:
            joined.append(part)
    return joined


def holds(parts: Sequence[Segment], kinds: frozenset[str]) -> Float[np.ndarray, "holds 2"]:
    """Start and end of the time in which each P, B, M is closed, or each F, V touches, in seconds."""
    spans = []
    for part in parts:
        if part.phoneme not in kinds:
            continue
        length = part.end - part.start
        if part.phoneme in BILABIALS:
            spans.append((part.start, part.start + _CLOSED_SHARE[part.phoneme] * length))
        else:
            spans.append((part.start + 0.2 * length, part.end - 0.2 * length))
    return np.array(spans, float).reshape(-1, 2)


def envelope(
    times: Float[np.ndarray, " times"],
    own: Float[np.ndarray, "holds 2"],
    others: Float[np.ndarray, "others 2"],
    rise: float,
    fall: float,
    taken: Bool[np.ndarray, " times"] | None = None,
) -> Float[np.ndarray, " times"]:
    """One inside each hold, minimum-jerk ramps around it that never reach into another contact's hold.

    Parameters
    ----------
    times : (T,)
        Seconds, ascending.
    own, others : (H, 2), (K, 2)
        Start and end of this contact's holds, and of holds that must stay free of it.
    rise, fall : float
        Seconds of the ramps where there is room.
    taken : (T,), optional
        Times that belong to another contact. A hold shorter than the steps of `times` gets one free time.
    """
    result = np.zeros(len(times))
    for start, end in own:
        before = others[others[:, 1] <= start + 1e-9, 1]
        after = others[others[:, 0] >= end - 1e-9, 0]
        up = max(min(rise, start - before.max()) if len(before) else rise, 1e-3)
        down = max(min(fall, after.min() - end) if len(after) else fall, 1e-3)
        value = np.minimum(smoothstep((times - start + up) / up), smoothstep((end + down - times) / down))
        value[(times >= start) & (times <= end)] = 1
        if len(times) and value.max() < 1:
            distance = np.abs(times - 0.5 * (start + end))
            value[np.argmin(distance if taken is None else distance + 1e3 * taken)] = 1
        result = np.maximum(result, value)
    return result


def _prominence(part: Segment, times: np.ndarray, accent: np.ndarray) -> float:
    inside = (times >= part.start - 0.03) & (times <= part.end + 0.03)
    return float(accent[inside].max()) if inside.any() else 0.0


def _tracks(
    parts: Sequence[Segment], times: np.ndarray, accent: np.ndarray, style: SpeakingStyle
) -> dict[str, np.ndarray]:
    """Blend the targets of all segments by dominance, one articulator at a time."""
    starts, ends = (np.array([getattr(part, name) for part in parts])[:, None] for name in ("start", "end"))
    gains = np.ones(len(parts))
    firmness = np.ones(len(parts))
    for index, part in enumerate(parts):
        if part.phoneme in VOWELS:
            prominence = _prominence(part, times, accent)
            # Short vowels fall short of their targets (Lindblom, 1963).
            reach = 1 - 0.50 * np.exp(-(part.end - part.start) / 0.055)
            gains[index] = (0.88 + 0.30 * prominence) * (reach + (1 - reach) * 0.6 * max(style.hyper, 0))
            firmness[index] = (0.8 + 0.5 * prominence) * (1 + 0.5 * style.hyper)
    reach_in_time = 1 - 0.3 * style.hyper
    tracks: dict[str, np.ndarray] = {}
    for name, articulator in ARTICULATORS.items():
        before = np.maximum(starts - times, 0) / (articulator.lead * reach_in_time)
        after = np.maximum(times - ends, 0) / (articulator.lag * reach_in_time)
        dominance = np.array([VISEMES[part.viseme].dominance[name] for part in parts]) * firmness
        # The floor keeps the blend defined far from any segment that cares for this articulator.
        weights = dominance[:, None] * np.exp(-(before**2) - after**2) + 1e-9
        weights /= weights.sum(0)
        for channel in articulator.channels:
            targets = np.array([VISEMES[part.viseme].targets.get(channel, 0.0) for part in parts])
            if channel == "jawOpen":
                targets = targets * gains
            blended = targets @ weights
            tracks[channel] = gaussian_filter1d(blended, articulator.smoothing * CONTROL_RATE, mode="nearest")
    return tracks


_GAINS = {
    "jawOpen": "jaw",
    "mouthPucker": "rounding",
    "mouthFunnel": "rounding",
    "mouthStretch": "spread",
    "mouthSmile": "spread",
    "mouthDimple": "spread",
    "mouthLowerDown": "lips",
    "mouthUpperUp": "lips",
}


def _resting(parts: Sequence[Segment], times: np.ndarray) -> np.ndarray:
    """Where lips come to rest in pauses of more than 0.4 s; open again for speech."""
    result = np.zeros(len(times))
    for index, part in enumerate(parts):
        if part.phoneme != SILENCE or part.end - part.start < 0.4:
            continue
        up = (times - part.start - 0.06) / 0.16 if index > 0 else np.ones(len(times))
        last = index + 1 == len(parts)
        stay = last or parts[index + 1].phoneme in BILABIALS
        down = (part.end + 0.16 - times) / 0.16 if stay else (part.end - 0.13 - times) / 0.16
        result = np.maximum(result, np.minimum(smoothstep(up), smoothstep(down)))
    return result


def articulate(
    parts: Sequence[Segment],
    at: Float[np.ndarray, " frames"],
    loudness: Float[np.ndarray, " times"],
    accent: Float[np.ndarray, " times"],
    style: SpeakingStyle,
    closing: float = 0.0,
) -> tuple[dict[str, np.ndarray], Float[np.ndarray, " frames"], Float[np.ndarray, " frames"]]:
    """Mouth and jaw at the given times.

    Parameters
    ----------
    parts : sequence of Segment
        What `segments` gives.
    at : (T,)
        Seconds, ascending.
    loudness, accent : (N,)
        Relative loudness and accent, each 0 to 1, at `CONTROL_RATE` from time 0 on.
    style : SpeakingStyle
        Gains.
    closing : float
        What mouthClose needs beyond jawOpen to bring the lips together, where the head has no lipSeal.

    Returns
    -------
    curves : dict of (T,)
        ARKit weights without sides, lipSeal included.
    seal, labiodental : (T,)
        1 where lips are closed, and where the lower lip touches the upper teeth.
    """
    times = np.arange(len(loudness)) / CONTROL_RATE
    tracks = _tracks(parts, times, accent, style)
    # Louder speech opens the jaw more than the lips (JALI, Sec. 4.3).
    tracks["jawOpen"] = tracks["jawOpen"] * (0.72 + 0.42 * loudness)
    tracks["mouthLowerDown"] = tracks["mouthLowerDown"] * (0.85 + 0.22 * loudness)
    tracks["mouthUpperUp"] = tracks["mouthUpperUp"] * (0.85 + 0.22 * loudness)
    curves = {
        name: np.interp(at, times, track) * (getattr(style, _GAINS[name]) if name in _GAINS else 1.0)
        for name, track in tracks.items()
    }
    bilabial, labial = holds(parts, BILABIALS), holds(parts, LABIODENTALS)
    sealed = envelope(at, bilabial, labial, 0.065, 0.055)
    labiodental = envelope(at, labial, bilabial, 0.055, 0.045, taken=sealed == 1) * (sealed < 1)
    sealed = sealed * (labiodental < 1)
    seal = np.maximum(sealed, style.rest_closure * _resting(parts, at) * (1 - labiodental))
    curves["mouthClose"] = np.zeros(len(at))
    for name in curves:
        curves[name] = curves[name] * (1 - labiodental) + _LABIODENTAL.get(name, 0.0) * labiodental
    # Speech opens the jaw to about two thirds of what it can do, however loud.
    jaw = np.maximum(curves["jawOpen"], 0)
    jaw = np.where(jaw < 0.4, jaw, 0.4 + 0.25 * np.tanh((jaw - 0.4) / 0.25))
    jaw = jaw - sealed * np.maximum(jaw - _SEALED_JAW, 0) * 0.6
    for name in ("mouthLowerDown", "mouthUpperUp", "mouthFunnel", "tongueOut"):
        curves[name] = curves[name] * (1 - sealed)
    curves["jawOpen"] = jaw
    curves["mouthClose"] = curves["mouthClose"] * (1 - seal) + seal * (jaw + closing)
    curves["lipSeal"] = seal
    return curves, sealed, labiodental
