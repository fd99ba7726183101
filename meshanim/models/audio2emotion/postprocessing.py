"""From probabilities of six classes to strengths of a face's emotions, frame by frame: files as streams."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Float64

from meshanim.errors import OptionError, ShapeError
from meshanim.motion.emotions import EMOTIONS, HEARD_EMOTIONS

__all__ = ["EmotionOptions", "EmotionPostProcessor"]


@dataclass(frozen=True)
class EmotionOptions:
    """How detected emotions become a face's; names and defaults of Audio2Face-3D's SDK.

    Parameters
    ----------
    emotion_contrast : float
        Factor on the logarithms of the probabilities: above 1 the strongest wins more. 0 to 3.
    max_emotions : int
        Strongest emotions that are kept, neutral not counted; 1 to 6.
    live_blend_coef : float
        Share of the frame before in each frame, 0 (none) to 1 (never anything new).
    enable_preferred_emotion : bool
        Whether `preferred` is blended in, where one is given.
    preferred : mapping of str to float
        Strengths of a face's emotions.
    preferred_emotion_strength : float
        Share of the preferred emotion, 0 to 1.
    transition_smoothing : float
        Seconds in which a change is made, 0 to 10.
    emotion_strength : float
        Factor on the result, 0 to 1.
    fixed_dt : float
        Seconds of a frame.
    beginning : mapping of str to float
        Strengths before the first frame; neutral if empty.
    correspondence : mapping of str to str
        Which of a face's emotions a class stands for; classes that are not named move nothing.
    """

    emotion_contrast: float = 1.0
    max_emotions: int = 3
    live_blend_coef: float = 0.7
    enable_preferred_emotion: bool = False
    preferred: dict[str, float] = field(default_factory=dict)
    preferred_emotion_strength: float = 0.5
    transition_smoothing: float = 0.5
    emotion_strength: float = 0.6
    fixed_dt: float = 0.033
    beginning: dict[str, float] = field(default_factory=dict)
    correspondence: dict[str, str] = field(
        default_factory=lambda: {name: name for name in HEARD_EMOTIONS if name != "neutral"}
    )

    def __post_init__(self):
        for name, low, high in (
            ("emotion_contrast", 0, 3),
            ("max_emotions", 1, len(HEARD_EMOTIONS)),
            ("live_blend_coef", 0, 1),
            ("preferred_emotion_strength", 0, 1),
            ("transition_smoothing", 0, 10),
            ("emotion_strength", 0, 1),
            ("fixed_dt", 0.001, 1),
        ):
            if not low <= getattr(self, name) <= high:
                raise OptionError(f"{name} is {getattr(self, name)}; expected {low} to {high}")
        for name in self.correspondence:
            if name not in HEARD_EMOTIONS:
                raise OptionError(f"no class {name!r}; there are {', '.join(HEARD_EMOTIONS)}")


class EmotionPostProcessor:
    """Contrast, softmax, unmapped classes to zero, the strongest, smoothing, preference, transition.

    The order is the public SDK's. It keeps what a next frame needs, so that frames may
    come one at a time or all at once.

    Parameters
    ----------
    options : EmotionOptions
    emotions : sequence of str
        Of the face.

    Raises
    ------
    OptionError
        If an option names an emotion that the face does not have.
    """

    def __init__(self, options: EmotionOptions, emotions: Sequence[str] = EMOTIONS):
        self.options, self.emotions = options, tuple(emotions)
        self.table = np.zeros((len(HEARD_EMOTIONS), len(self.emotions)))
        for name, own in options.correspondence.items():
            if own in self.emotions:
                self.table[HEARD_EMOTIONS.index(name), self.emotions.index(own)] = 1.0
        self.preferred = self._strengths(options.preferred) if options.preferred else None
        self.smoothed = self.state = self._strengths(options.beginning)

    def _strengths(self, mixture: Mapping[str, float]) -> Float64[np.ndarray, " emotions"]:
        values = np.zeros(len(self.emotions))
        for name, strength in mixture.items():
            if name not in self.emotions or not 0 <= strength <= 1:
                raise OptionError(f"emotion {name}={strength}; expected 0 to 1 of {', '.join(self.emotions)}")
            values[self.emotions.index(name)] = strength
        return values

    def push(
        self,
        probabilities: Float[np.ndarray, "frames classes"],
        preferred: Float[np.ndarray, "frames emotions"] | None = None,
    ) -> Float64[np.ndarray, "frames emotions"]:
        """Strengths of the next frames, `fixed_dt` seconds apart.

        Parameters
        ----------
        probabilities : (T, 6)
            Of `HEARD_EMOTIONS`.
        preferred : (T, E), optional
            Of every frame, instead of the options' one.

        Raises
        ------
        ShapeError
            If one is negative or not finite.
        """
        given = np.asarray(probabilities, np.float64)
        if not np.isfinite(given).all() or (given < 0).any():
            raise ShapeError("probabilities of emotions must be finite and not negative")
        wishes = [self.preferred] * len(given) if preferred is None else preferred
        frames = [self._frame(row, wish) for row, wish in zip(given, wishes, strict=True)]
        return np.stack(frames) if frames else self.state[None][:0]

    def _frame(
        self,
        probabilities: Float64[np.ndarray, " classes"],
        preferred: Float64[np.ndarray, " emotions"] | None,
    ) -> Float64[np.ndarray, " emotions"]:
        options = self.options
        logits = options.emotion_contrast * np.log(probabilities + 1e-9)
        heard = np.exp(logits - logits.max())
        heard = heard / heard.sum() * self.table.any(1)
        heard[np.argsort(-heard, kind="stable")[options.max_emotions :]] = 0
        blend = options.live_blend_coef
        self.smoothed = (1 - blend) * (heard @ self.table) + blend * self.smoothed
        wanted = self.smoothed
        if options.enable_preferred_emotion and preferred is not None:
            share = options.preferred_emotion_strength
            wanted = (1 - share) * wanted + share * preferred
        seconds = options.transition_smoothing
        step = min(options.fixed_dt / seconds, 1.0) if seconds > 0 else 1.0
        self.state = self.state + step * (wanted - self.state)
        return options.emotion_strength * self.state
