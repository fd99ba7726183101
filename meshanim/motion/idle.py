"""What a face does that the speech does not tell: blinks, shifts of gaze, a slow sway of the head.

A model trained to the mean of all recordings averages these away. They are functions of time and a seed, so
that a stream and a file get the same ones.
"""

import itertools
from bisect import bisect
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from meshanim.errors import OptionError

__all__ = ["GAZE_RANGE", "IdleMotion", "gaze_angles", "gaze_weights", "lid_closure", "saccade", "smoothstep"]

GAZE_RANGE = (0.17, 0.235)
"""Radians that an eye of the default head turns at an eyeLook weight of 1: up or down, and sideways."""

_SWAY = (0.013, 0.024, 0.013)
"""Radians: deviation of nodding, turning and tilting."""


def smoothstep(x: np.ndarray) -> np.ndarray:
    """0 below 0, 1 above 1, the cubic 3 x^2 - 2 x^3 between."""
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3 - 2 * x)


def lid_closure(seconds: Float[np.ndarray, " times"]) -> Float[np.ndarray, " times"]:
    """Lids around a blink at 0: closing in 0.09 s, shut for 0.045 s (a frame at 24 Hz), opening in 0.18 s."""
    return np.minimum(smoothstep((seconds + 0.1125) / 0.09), smoothstep((0.2025 - seconds) / 0.18))


def saccade(seconds: Float[np.ndarray, " times"], angle: float) -> Float[np.ndarray, " times"]:
    """Share of a gaze shift that is done: it takes 21 ms + 2.2 ms a degree (Carpenter, 1988).

    Parameters
    ----------
    seconds : (T,)
        Since the beginning.
    angle : float
        Size of the shift, radians.
    """
    return smoothstep(seconds / (0.021 + 0.0022 * np.degrees(angle)))


def gaze_weights(
    pitch: Float[np.ndarray, " frames"], yaw: Float[np.ndarray, " frames"]
) -> dict[str, Float[np.ndarray, " frames"]]:
    """ARKit's eight eyeLook weights for a gaze: pitch positive looks down, yaw to the subject's left."""
    pitch, yaw = pitch / GAZE_RANGE[0], yaw / GAZE_RANGE[1]
    left, right = np.clip(yaw, 0, 1), np.clip(-yaw, 0, 1)
    down, up = np.clip(pitch, 0, 1), np.clip(-pitch, 0, 1)
    return {
        "eyeLookOutLeft": left,
        "eyeLookInRight": left,
        "eyeLookInLeft": right,
        "eyeLookOutRight": right,
        "eyeLookDownLeft": down,
        "eyeLookDownRight": down,
        "eyeLookUpLeft": up,
        "eyeLookUpRight": up,
    }


def gaze_angles(
    weights: Mapping[str, Float[np.ndarray, " frames"]],
) -> Float[np.ndarray, "frames 2"]:
    """Pitch and yaw that `gaze_weights` were made of, where none was cut at 1."""
    pitch = weights["eyeLookDownLeft"] - weights["eyeLookUpLeft"]
    yaw = weights["eyeLookOutLeft"] - weights["eyeLookInLeft"]
    return np.stack([pitch * GAZE_RANGE[0], yaw * GAZE_RANGE[1]], axis=1)


class IdleMotion:
    """Blinks, gaze and sway as functions of time.

    Parameters
    ----------
    seed : int
        Of everything left to chance.
    blinks : float
        Blinks a second on average; 0 for none.
    gaze : float
        Gain on shifts of gaze; 0 keeps the eyes still.
    sway : float
        Gain on the movement of the head; 0 keeps it still.
    gaze_seed : int, optional
        Of the shifts of gaze; `seed` if not given.

    Raises
    ------
    OptionError
        If a rate or gain is negative.
    """

    def __init__(
        self,
        seed: int = 0,
        blinks: float = 0.28,
        gaze: float = 1.0,
        sway: float = 1.0,
        gaze_seed: int | None = None,
    ):
        if min(blinks, gaze, sway) < 0:
            raise OptionError(f"blinks, gaze and sway must not be negative, not {blinks}, {gaze}, {sway}")
        self.blinks, self.gaze, self.sway = blinks, gaze, sway
        self._lids = np.random.default_rng([seed, 1])
        self._eyes = np.random.default_rng([seed if gaze_seed is None else gaze_seed, 2])
        self._blinks: list[tuple[float, float]] = []  # time, how far the lids close
        self._shifts: list[tuple[float, float, float]] = [(-1.0, 0.0, 0.0)]  # time, new pitch, new yaw
        head = np.random.default_rng([seed, 3])
        # Twelve slow waves an axis, between 0.08 and 0.7 Hz, weaker the faster.
        self._frequency = 0.08 * (0.7 / 0.08) ** head.uniform(0, 1, (12, 3))
        self._phase = head.uniform(0, 2 * np.pi, (12, 3))
        amplitude = 1 / self._frequency**0.7
        self._amplitude = amplitude * np.sqrt(2 / np.square(amplitude).sum(0)) * np.array(_SWAY)

    def pose(self, times: Float[np.ndarray, " frames"]) -> Float[np.ndarray, "frames 3"]:
        """Head rotation at the given seconds, axis-angle in radians, small, with mean zero."""
        waves = np.sin(2 * np.pi * self._frequency * times[:, None, None] + self._phase)
        return (self.sway * (self._amplitude * waves).sum(1)).astype(np.float32)

    def weights(
        self, times: Float[np.ndarray, " frames"], head: Float[np.ndarray, "frames 3"]
    ) -> Mapping[str, Float[np.ndarray, " frames"]]:
        """ARKit weights of lids and eyes at the given seconds.

        Parameters
        ----------
        times : (T,)
            Seconds, rising.
        head : (T, 3)
            Head pose, axis-angle, radians: the eyes turn against it, so that the gaze stays where it is.
        """
        if len(times) == 0:
            empty = np.zeros(0)
            return {"eyeBlinkLeft": empty, "eyeBlinkRight": empty, **gaze_weights(empty, empty)}
        self._plan(times[-1] + 1.0)
        lids = np.zeros(len(times))
        for moment, depth in self._near(self._blinks, times):
            lids = np.maximum(lids, depth * lid_closure(times - moment))
        shifts = self._near(self._shifts, times)
        pitch, yaw = np.full(len(times), shifts[0][1]), np.full(len(times), shifts[0][2])
        for (_, *here), (moment, *there) in itertools.pairwise(shifts):
            step = saccade(times - moment, float(np.hypot(there[0] - here[0], there[1] - here[1])))
            pitch += (there[0] - here[0]) * step
            yaw += (there[1] - here[1]) * step
        lids = 1 - (1 - lids) * (1 - 0.25 * np.clip(pitch / 0.45, 0, 1))  # lids follow a downward gaze
        look = gaze_weights(pitch - 0.85 * head[:, 0], yaw - 0.85 * head[:, 1])
        return {"eyeBlinkLeft": lids, "eyeBlinkRight": lids, **look}

    @staticmethod
    def _near(events: list, times: np.ndarray) -> list:
        """The events that matter at these times: from the last that is over to the last that has begun."""
        over = bisect(events, times[0] - 0.5, key=lambda event: event[0])
        return events[max(over - 1, 0) : bisect(events, times[-1] + 0.5, key=lambda event: event[0])]

    def _plan(self, until: float) -> None:
        while self.blinks > 0 and (not self._blinks or self._blinks[-1][0] < until):
            last = self._blinks[-1][0] if self._blinks else self._lids.uniform(-1.5, 0.5)
            pause = 0.6 + self._lids.exponential(max(1 / self.blinks - 0.6, 0.05))
            self._blinks.append((last + pause, self._lids.uniform(0.94, 1.0)))
        while self._shifts[-1][0] < until:
            away = self._eyes.random() < 0.12  # now and then past the listener, otherwise within the face
            deviation = np.array([0.07, 0.14]) if away else np.array([0.018, 0.032])
            pitch, yaw = self.gaze * self._eyes.normal(size=2) * deviation
            stay = float(np.clip(self._eyes.gamma(2.2, 0.22 if away else 0.42), 0.25, 2.5))
            self._shifts.append((max(self._shifts[-1][0], 0.0) + stay, pitch, yaw))
