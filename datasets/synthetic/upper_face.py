"""Brows, blinks and gaze, driven by prosody and chance."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from meshanim.datasets.synthetic.articulation import Segment
from meshanim.datasets.synthetic.visemes import SILENCE
from meshanim.motion.idle import gaze_weights, lid_closure, saccade, smoothstep
from meshanim.motion.pose import CONTROL_RATE, wander

__all__ = ["blinks", "brows", "gaze"]


def blinks(
    at: Float[np.ndarray, " frames"],
    duration: float,
    parts: Sequence[Segment],
    rate: float,
    generator: np.random.Generator,
) -> Float[np.ndarray, " frames"]:
    """Lid closure at the given seconds: a Poisson process pulled to the beginning of pauses.

    Parameters
    ----------
    at : (T,)
        Seconds.
    duration : float
        Seconds.
    parts : sequence of Segment
        For the pauses.
    rate : float
        Blinks a second; 0 for none.
    generator : numpy.random.Generator
        Chance.
    """
    silent = [part for part in parts if part.phoneme == SILENCE and part.end - part.start > 0.08]
    pauses = np.array([part.start for part in silent if part.start > 0])
    result = np.zeros(len(at))
    if rate <= 0:
        return result
    refractory = 0.6
    moment = generator.uniform(0.2, 1.0 / rate)
    while moment < duration:
        near = pauses[np.abs(pauses - moment) < 0.45]
        centre = near[np.argmin(np.abs(near - moment))] + 0.05 if len(near) else moment
        result = np.maximum(result, generator.uniform(0.94, 1.0) * lid_closure(at - centre))
        moment = max(centre, moment) + refractory + generator.exponential(max(1 / rate - refractory, 0.05))
    return result


def brows(
    count: int,
    accent: Float[np.ndarray, " times"],
    contour: Float[np.ndarray, " times"],
    generator: np.random.Generator,
) -> dict[str, Float[np.ndarray, " times"]]:
    """Brow weights at `CONTROL_RATE`: raised with pitch and accents, sometimes knitted for emphasis instead.

    Parameters
    ----------
    count : int
        Samples.
    accent, contour : (N,)
        Accent from 0 to 1 and pitch contour in deviations.
    generator : numpy.random.Generator
        Chance: slow drift, and which accents are frowned.
    """
    smooth = gaussian_filter1d(accent, 0.05 * CONTROL_RATE)
    mood = wander(count, 1.0, 2.5, generator)
    frown = smoothstep((mood - 0.7) / 0.8)
    raised = np.clip(0.10 * gaussian_filter1d(contour, 0.08 * CONTROL_RATE), -0.05, 0.25) + 0.22 * smooth
    drift = 0.04 * wander(count, 1.0, 1.5, generator)
    inner = np.maximum(raised * (1 - frown) + drift, 0)
    side = 0.12 * wander(count, 1.0, 3.0, generator)
    return {
        "browInnerUp": inner,
        "browOuterUpLeft": np.maximum(0.62 * inner * (1 + side), 0),
        "browOuterUpRight": np.maximum(0.62 * inner * (1 - side), 0),
        "browDownLeft": np.maximum(frown * (0.05 + 0.25 * smooth) * (1 + side), 0),
        "browDownRight": np.maximum(frown * (0.05 + 0.25 * smooth) * (1 - side), 0),
    }


def gaze(
    at: Float[np.ndarray, " frames"],
    duration: float,
    head: Float[np.ndarray, "frames 3"],
    rest: tuple[float, float],
    amount: float,
    generator: np.random.Generator,
) -> dict[str, Float[np.ndarray, " frames"]]:
    """Eye weights: fixations of 0.3 to 2 s near a listener in front, saccades between them.

    The eyes turn against the head, so that the gaze stays where it is.

    Parameters
    ----------
    at : (T,)
        Seconds.
    duration : float
        Seconds.
    head : (T, 3)
        Head pose, axis-angle, radians.
    rest : (pitch, yaw)
        Radians of the gaze's centre; pitch positive looks down, yaw positive to the subject's left.
    amount : float
        Gain on the size of shifts.
    generator : numpy.random.Generator
        Chance.
    """
    pitch, yaw = np.full(len(at), rest[0]), np.full(len(at), rest[1])
    here = np.array(rest, float)
    moment = generator.uniform(0.2, 0.9)
    while moment < duration:
        away = generator.random() < 0.12
        deviation = np.array([0.07, 0.14]) if away else np.array([0.018, 0.032])
        there = np.asarray(rest) + amount * generator.normal(size=2) * deviation
        step = saccade(at - moment, float(np.linalg.norm(there - here)))
        pitch += (there[0] - here[0]) * step
        yaw += (there[1] - here[1]) * step
        here = there
        moment += float(np.clip(generator.gamma(2.2, 0.22 if away else 0.42), 0.25, 2.5))
    return gaze_weights(pitch - 0.85 * head[:, 0], yaw - 0.85 * head[:, 1])
