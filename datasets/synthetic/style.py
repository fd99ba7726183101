"""How a subject speaks, and how an emotion changes it."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field

import numpy as np

from meshanim.errors import OptionError

__all__ = ["EMOTIONS", "Emotion", "SpeakingStyle", "emotion"]


@dataclass(frozen=True)
class SpeakingStyle:
    """Gains and habits of one speaker; every default is 1 or the middle of the range.

    Parameters
    ----------
    jaw, lips, rounding, spread : float
        Gains on jaw opening, lip opening, pucker and funnel, stretch and smile.
    smile : float
        Resting smile, an ARKit weight.
    asymmetry : float
        Positive: the left half of the mouth moves more by this share, the right half less.
    brows, head, gaze : float
        Gains on brow movement, head movement and the size of gaze shifts.
    blinks : float
        Blinks a second.
    hyper : float
        From -1 (mumbling: neighbours blur) to 1 (over-articulated: targets are reached).
    rest_closure : float
        How far the lips come together in a pause, 0 to 1.
    """

    jaw: float = 1.0
    lips: float = 1.0
    rounding: float = 1.0
    spread: float = 1.0
    smile: float = 0.03
    asymmetry: float = 0.0
    brows: float = 1.0
    head: float = 1.0
    gaze: float = 1.0
    blinks: float = 0.28
    hyper: float = 0.0
    rest_closure: float = 0.95

    def __post_init__(self):
        for name, value in asdict(self).items():
            low = -1.0 if name in ("asymmetry", "hyper") else 0.0
            high = 1.0 if name in ("asymmetry", "hyper", "smile", "rest_closure") else 3.0
            if not low <= value <= high:
                raise OptionError(f"speaking style: {name} must be in [{low:g}, {high:g}], not {value}")

    @classmethod
    def random(cls, seed: int) -> "SpeakingStyle":
        """A plausible speaker; the same seed gives the same one."""
        generator = np.random.default_rng([seed, 0x57])

        def around(middle: float, deviation: float, low: float, high: float) -> float:
            return round(float(np.clip(generator.normal(middle, deviation), low, high)), 4)

        return cls(
            jaw=around(1.0, 0.20, 0.65, 1.4),
            lips=around(1.0, 0.20, 0.6, 1.45),
            rounding=around(1.0, 0.18, 0.65, 1.4),
            spread=around(1.0, 0.25, 0.5, 1.5),
            smile=around(0.04, 0.05, 0.0, 0.16),
            asymmetry=around(0.0, 0.09, -0.22, 0.22),
            brows=around(1.0, 0.35, 0.3, 1.8),
            head=around(1.0, 0.30, 0.4, 1.7),
            gaze=around(1.0, 0.30, 0.4, 1.7),
            blinks=around(0.28, 0.08, 0.12, 0.5),
            hyper=around(0.0, 0.35, -0.8, 0.8),
            rest_closure=around(0.92, 0.12, 0.6, 1.0),
        )


@dataclass(frozen=True)
class Emotion:
    """What an emotion at full intensity adds to the face and how it changes speech and movement.

    Parameters
    ----------
    offsets : mapping
        ARKit weights added; a name without Left or Right counts for both sides.
    jaw, lips, brows, head, blinks : float
        Gains on the speaking style.
    gaze : (pitch, yaw)
        Radians added to where the eyes rest; pitch positive looks down, yaw positive to the subject's left.
    head_tilt : (pitch, yaw, roll)
        Radians added to the head's resting pose.
    rate, pitch, volume : float
        Gains on the voice: speaking rate, fundamental frequency, amplitude.
    """

    offsets: Mapping[str, float] = field(default_factory=dict)
    jaw: float = 1.0
    lips: float = 1.0
    brows: float = 1.0
    head: float = 1.0
    blinks: float = 1.0
    gaze: tuple[float, float] = (0.0, 0.0)
    head_tilt: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rate: float = 1.0
    pitch: float = 1.0
    volume: float = 1.0


EMOTIONS: dict[str, Emotion] = {
    "neutral": Emotion(),
    "joy": Emotion(
        {
            "mouthSmile": 0.46,
            "mouthDimple": 0.12,
            "cheekSquint": 0.42,
            "eyeSquint": 0.16,
            "browInnerUp": 0.08,
            "browOuterUp": 0.10,
            "mouthUpperUp": 0.06,
        },
        jaw=1.10,
        lips=1.10,
        brows=1.25,
        head=1.3,
        head_tilt=(-0.02, 0.0, 0.03),
        rate=1.06,
        pitch=1.10,
        volume=1.1,
    ),
    "sadness": Emotion(
        {
            "browInnerUp": 0.48,
            "browDown": 0.10,
            "mouthFrown": 0.36,
            "mouthShrugLower": 0.14,
            "eyeSquint": 0.10,
            "eyeBlink": 0.12,
        },
        jaw=0.80,
        lips=0.85,
        brows=0.6,
        head=0.6,
        blinks=0.8,
        gaze=(0.10, 0.0),
        head_tilt=(0.09, 0.0, 0.02),
        rate=0.86,
        pitch=0.94,
        volume=0.75,
    ),
    "anger": Emotion(
        {
            "browDown": 0.62,
            "eyeSquint": 0.26,
            "noseSneer": 0.26,
            "mouthPress": 0.10,
            "mouthFrown": 0.14,
            "mouthUpperUp": 0.08,
            "mouthLowerDown": 0.10,
            "jawForward": 0.12,
        },
        jaw=1.20,
        lips=1.15,
        brows=0.8,
        head=1.4,
        blinks=0.7,
        head_tilt=(0.05, 0.0, 0.0),
        rate=1.06,
        pitch=1.06,
        volume=1.3,
    ),
    "fear": Emotion(
        {
            "browInnerUp": 0.54,
            "browOuterUp": 0.26,
            "browDown": 0.14,
            "eyeWide": 0.46,
            "mouthStretch": 0.28,
            "mouthFrown": 0.10,
        },
        jaw=0.90,
        head=0.8,
        blinks=1.5,
        head_tilt=(-0.04, 0.0, 0.0),
        rate=1.10,
        pitch=1.14,
        volume=0.9,
    ),
    "disgust": Emotion(
        {
            "noseSneer": 0.54,
            "mouthUpperUp": 0.24,
            "browDown": 0.30,
            "eyeSquint": 0.28,
            "cheekSquint": 0.22,
            "mouthFrown": 0.22,
        },
        jaw=0.90,
        lips=1.05,
        brows=0.7,
        head=0.9,
        head_tilt=(-0.04, 0.05, 0.0),
        rate=0.94,
        pitch=0.97,
    ),
    "surprise": Emotion(
        {"browInnerUp": 0.60, "browOuterUp": 0.56, "eyeWide": 0.50, "jawOpen": 0.04},
        jaw=1.15,
        lips=1.05,
        brows=1.2,
        head=1.1,
        blinks=0.6,
        head_tilt=(-0.05, 0.0, 0.0),
        rate=1.03,
        pitch=1.18,
        volume=1.1,
    ),
    "contempt": Emotion(
        {
            "mouthSmileLeft": 0.26,
            "mouthDimpleLeft": 0.36,
            "eyeSquint": 0.16,
            "browOuterUpRight": 0.18,
            "browDownLeft": 0.14,
        },
        jaw=0.92,
        lips=0.9,
        head=0.8,
        head_tilt=(-0.06, 0.0, -0.03),
        rate=0.95,
        pitch=0.96,
    ),
}


def emotion(name: str) -> Emotion:
    """Look an emotion up by name; OptionError lists the names there are."""
    if name not in EMOTIONS:
        raise OptionError(f"no emotion {name!r}; there are {', '.join(EMOTIONS)}")
    return EMOTIONS[name]
