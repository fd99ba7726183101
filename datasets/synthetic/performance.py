"""From timed phonemes and prosody to a whole performance: face curves and head pose."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from meshanim.datasets.synthetic.articulation import Segment, TimedPhoneme, articulate, segments
from meshanim.datasets.synthetic.style import SpeakingStyle, emotion
from meshanim.datasets.synthetic.upper_face import blinks, brows, gaze
from meshanim.datasets.synthetic.visemes import SILENCE, VOWELS
from meshanim.errors import OptionError, ShapeError
from meshanim.motion.pose import (
    CONTROL_RATE,
    pitch_contour,
    pose_from_prosody,
    prosodic_accents,
    pulses,
    relative_loudness,
    wander,
)

__all__ = ["CURVE_NAMES", "Performance", "perform"]


def _sided(*names: str) -> tuple[str, ...]:
    return tuple(name + side for name in names for side in ("Left", "Right"))


_EYE = ("eyeBlink", "eyeLookDown", "eyeLookIn", "eyeLookOut", "eyeLookUp", "eyeSquint", "eyeWide")
CURVE_NAMES: tuple[str, ...] = (
    *(name + "Left" for name in _EYE),
    *(name + "Right" for name in _EYE),
    *("jawForward", "jawLeft", "jawRight", "jawOpen"),
    *("mouthClose", "mouthFunnel", "mouthPucker", "mouthLeft", "mouthRight"),
    *_sided("mouthSmile", "mouthFrown", "mouthDimple", "mouthStretch"),
    *("mouthRollLower", "mouthRollUpper", "mouthShrugLower", "mouthShrugUpper"),
    *_sided("mouthPress", "mouthLowerDown", "mouthUpperUp", "browDown"),
    "browInnerUp",
    *_sided("browOuterUp"),
    "cheekPuff",
    *_sided("cheekSquint", "noseSneer"),
    "tongueOut",
    "lipSeal",
)
"""ARKit's 52 blendshape locations in ARKit's order, then lipSeal."""

_SIDED = {name.removesuffix("Left") for name in CURVE_NAMES if name.endswith("Left")} - {"jaw", "mouth"}
_ASYMMETRIC = ("mouthStretch", "mouthSmile", "mouthDimple", "mouthLowerDown", "mouthUpperUp")
_OPENS_LIPS = ("jawOpen", "mouthUpperUp", "mouthLowerDown", "mouthStretch", "mouthFrown")


@dataclass(frozen=True)
class Performance:
    """A face in motion, frame by frame; frame i is at (i + 0.5) / fps seconds.

    Parameters
    ----------
    curves : (T, 53) float32
        Weights in [0, 1] by `CURVE_NAMES`.
    pose : (T, 3) float32
        Head rotation, axis-angle, radians.
    seal : (T,) float32
        1 where a bilabial closes the lips; lips that rest together in a pause do not count.
    labiodental : (T,) float32
        1 where the lower lip touches the upper teeth.
    fps : float
        Frames a second.
    """

    curves: Float[np.ndarray, "frames curves"]
    pose: Float[np.ndarray, "frames 3"]
    seal: Float[np.ndarray, " frames"]
    labiodental: Float[np.ndarray, " frames"]
    fps: float

    def __len__(self) -> int:
        return len(self.curves)

    def curve(self, name: str) -> Float[np.ndarray, " frames"]:
        """One curve by its ARKit name; OptionError if there is none of that name."""
        if name not in CURVE_NAMES:
            raise OptionError(f"no curve {name!r}: names are ARKit's, for example jawOpen, and lipSeal")
        return self.curves[:, CURVE_NAMES.index(name)]


@dataclass(frozen=True)
class _Prosody:
    """Everything at `CONTROL_RATE` from time 0 on."""

    loudness: np.ndarray
    accent: np.ndarray
    contour: np.ndarray


def _prosody(
    parts: Sequence[Segment],
    duration: float,
    loudness: np.ndarray | None,
    pitch: np.ndarray | None,
    rate: float,
) -> _Prosody:
    """Loudness, accents and pitch contour; guessed from the phonemes where no sound is given."""
    count = int(np.ceil(duration * CONTROL_RATE)) + 2
    times = np.arange(count) / CONTROL_RATE
    if loudness is None:
        rate = 100.0
        steps = (np.arange(max(3, int(np.ceil(duration * rate)))) + 0.5) / rate
        loudness = np.full(len(steps), 1e-4)
        for part in parts:
            if part.phoneme != SILENCE:
                level = 0.25 * min(1.0, (part.end - part.start) / 0.12) if part.phoneme in VOWELS else 0.05
                loudness[(steps >= part.start) & (steps < part.end)] = level
    steps = (np.arange(len(loudness)) + 0.5) / rate
    centres, strengths = prosodic_accents(loudness, pitch, rate)
    return _Prosody(
        np.interp(times, steps, relative_loudness(loudness)),
        pulses(times, centres, strengths, 0.14, 0.20),
        np.zeros(count) if pitch is None else np.interp(times, steps, pitch_contour(pitch, rate)),
    )


def _spread_sides(curves: Mapping[str, np.ndarray], asymmetry: float) -> dict[str, np.ndarray]:
    result = {}
    for name, values in curves.items():
        if name not in _SIDED:
            result[name] = values
            continue
        share = asymmetry if name in _ASYMMETRIC else 0.0
        result[name + "Left"] = values * (1 + share)
        result[name + "Right"] = values * (1 - share)
    return result


def perform(
    phonemes: Sequence[TimedPhoneme],
    frames: int,
    fps: float,
    *,
    loudness: Float[np.ndarray, " times"] | None = None,
    pitch: Float[np.ndarray, " times"] | None = None,
    rate: float = 100.0,
    style: SpeakingStyle | None = None,
    emotion_name: str = "neutral",
    intensity: float = 1.0,
    closing: float = 0.0,
    seed: int = 0,
) -> Performance:
    """Act out timed phonemes.

    Parameters
    ----------
    phonemes : sequence
        With `start`, `end` (seconds) and `symbol` (ARPAbet, SIL for silence), in order.
    frames : int
        Frames to make.
    fps : float
        Frames a second. Lips are closed at every P, B, M and touch the teeth at every F, V for at least one
        whole frame, whatever the rate.
    loudness : (N,), optional
        Amplitude, as `meshanim.audio.loudness` gives it; guessed from the phonemes otherwise.
    pitch : (N,), optional
        Hz, 0 where unvoiced, aligned with `loudness`.
    rate : float
        Values of `loudness` and `pitch` a second; value k is at (k + 0.5) / rate.
    style : SpeakingStyle, optional
        The speaker.
    emotion_name : str
        One of `EMOTIONS`.
    intensity : float
        Of the emotion, 0 to 1.
    closing : float
        What mouthClose needs beyond jawOpen to close the lips of the head that will be moved; 0 where lipSeal
        does it, as on the default head.
    seed : int
        Of everything left to chance: blinks, gaze, wandering of head and brows. The same seed gives the same
        motion in time at every frame rate.

    Returns
    -------
    Performance

    Raises
    ------
    OptionError
        For unknown phonemes or emotions, or options out of range.
    ShapeError
        If pitch is given without loudness or of another length.
    """
    if not fps > 0 or frames < 0 or not 0 <= intensity <= 1:
        given = f"{fps}, {frames} and {intensity}"
        raise OptionError(f"expected fps above 0, frames from 0 and intensity in [0, 1], not {given}")
    if pitch is not None and (loudness is None or len(loudness) != len(pitch)):
        raise ShapeError("pitch needs a loudness of the same length beside it")
    style = style or SpeakingStyle()
    feeling = emotion(emotion_name)
    duration = frames / fps
    at = (np.arange(frames) + 0.5) / fps
    parts = segments(phonemes, duration)
    prosody = _prosody(parts, duration, loudness, pitch, rate)
    count = len(prosody.loudness)
    grid = np.arange(count) / CONTROL_RATE

    def gain(value: float) -> float:
        return 1 + intensity * (value - 1)

    spoken = replace(
        style,
        jaw=min(style.jaw * gain(feeling.jaw), 3.0),
        lips=min(style.lips * gain(feeling.lips), 3.0),
    )
    mouth, seal, labiodental = articulate(parts, at, prosody.loudness, prosody.accent, spoken, closing)
    curves = _spread_sides(mouth, style.asymmetry)

    tilt = feeling.head_tilt
    pose = pose_from_prosody(
        frames,
        fps,
        seed,
        loudness,
        pitch,
        rate,
        style.head * gain(feeling.head),
        (intensity * tilt[0], intensity * tilt[1], intensity * tilt[2]),
    )
    streams = [np.random.default_rng([seed, 0xFACE, index]) for index in range(4)]
    upper = brows(count, prosody.accent, prosody.contour, streams[0])
    for name, track in upper.items():
        curves[name] = style.brows * gain(feeling.brows) * np.interp(at, grid, track)
    curves.update(
        gaze(
            at,
            duration,
            pose,
            (intensity * feeling.gaze[0], intensity * feeling.gaze[1]),
            style.gaze,
            streams[1],
        )
    )

    free = 1 - np.maximum(seal, labiodental)
    mood = intensity * np.interp(at, grid, np.clip(0.9 + 0.1 * wander(count, 1.0, 1.0, streams[2]), 0.6, 1.0))
    offsets = {name: value * mood for name, value in feeling.offsets.items()}
    offsets["mouthSmile"] = offsets.get("mouthSmile", 0.0) + style.smile
    for name, offset in offsets.items():
        if name.startswith(_OPENS_LIPS):
            offset = offset * free
        elif name.startswith(("mouth", "jaw")):
            offset = offset * (0.55 + 0.45 * free)
        for side in ("Left", "Right") if name in _SIDED else ("",):
            curves[name + side] = curves.get(name + side, 0.0) + offset
    # A weight that is already high gives way: rounded lips neither smile nor stretch.
    rounded = np.clip(curves["mouthPucker"] + curves["mouthFunnel"], 0, 1)
    for name in _sided("mouthSmile", "mouthStretch", "mouthDimple"):
        curves[name] = curves[name] * (1 - 0.6 * rounded)

    effort = np.interp(at, grid, prosody.loudness)
    lids = blinks(at, duration, parts, style.blinks * gain(feeling.blinks), streams[3])
    for side in ("Left", "Right"):
        curves["cheekSquint" + side] = (
            curves.get("cheekSquint" + side, 0.0) + 0.25 * curves["mouthSmile" + side]
        )
        curves["eyeSquint" + side] = curves.get("eyeSquint" + side, 0.0) + 0.03 + 0.05 * effort
        droop = curves.get("eyeBlink" + side, 0.0)
        curves["eyeBlink" + side] = droop + (1 - droop) * lids
        for name in ("eyeWide", "eyeSquint"):
            curves[name + side] = curves.get(name + side, 0.0) * (1 - lids)
    weights = np.zeros((frames, len(CURVE_NAMES)))
    for name, values in curves.items():
        weights[:, CURVE_NAMES.index(name)] = values
    return Performance(
        np.clip(weights, 0, 1).astype(np.float32),
        pose,
        seal.astype(np.float32),
        labiodental.astype(np.float32),
        float(fps),
    )
