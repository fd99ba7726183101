"""Head pose tracks: made from prosody where none was recorded, and smoothed."""

import numpy as np
import roma
import torch
from jaxtyping import Float
from scipy.ndimage import correlate1d, gaussian_filter1d

from meshanim.errors import OptionError, ShapeError

__all__ = ["pose_from_prosody", "prosodic_accents", "smooth_rotations"]

CONTROL_RATE = 240.0
"""Hz at which motion is generated before it is sampled at frame times, whatever the frame rate."""


def _contour(values: np.ndarray, rate: float, sigma: float) -> np.ndarray:
    """Smoothed and scaled to zero mean and unit deviation; a flat contour becomes zeros."""
    smooth = gaussian_filter1d(np.asarray(values, float), sigma * rate, mode="nearest")
    deviation = smooth.std()
    return (smooth - smooth.mean()) / deviation if deviation > 1e-9 else np.zeros_like(smooth)


def pitch_contour(pitch: Float[np.ndarray, " times"], rate: float) -> Float[np.ndarray, " times"]:
    """Fundamental frequency as a smooth contour in standard deviations of log frequency.

    Parameters
    ----------
    pitch : (N,)
        Hz; 0 where unvoiced. Unvoiced stretches are bridged.
    rate : float
        Samples of `pitch` a second.
    """
    voiced = pitch > 0
    if voiced.sum() < 2:
        return np.zeros(len(pitch))
    positions = np.arange(len(pitch))
    logarithm = np.interp(positions, positions[voiced], np.log2(pitch[voiced]))
    return np.clip(_contour(logarithm, rate, 0.06), -2.5, 2.5)


def relative_loudness(loudness: Float[np.ndarray, " times"]) -> Float[np.ndarray, " times"]:
    """Amplitude on a scale of decibels, 0 (35 dB below the loudest speech, or silence) to 1 (the loudest).

    The loudest is the 95th percentile, so that a click does not rescale a sentence.
    """
    decibels = 20 * np.log10(np.maximum(np.asarray(loudness, float), 1e-6))
    if len(decibels) == 0 or decibels.max() <= -80:
        return np.zeros(len(decibels))
    return np.clip(1 + (decibels - np.percentile(decibels, 95)) / 35, 0, 1)


def prosodic_accents(
    loudness: Float[np.ndarray, " times"], pitch: Float[np.ndarray, " times"] | None, rate: float
) -> tuple[Float[np.ndarray, " accents"], Float[np.ndarray, " accents"]]:
    """Times and strengths of prosodic prominence: peaks of loudness and pitch together.

    Parameters
    ----------
    loudness : (N,)
        Amplitude, as `meshanim.audio.loudness` gives it.
    pitch : (N,), optional
        Hz; 0 where unvoiced.
    rate : float
        Samples a second of both.

    Returns
    -------
    times : (A,)
        Seconds; at least 0.22 s apart.
    strengths : (A,)
        From 0 to 1.
    """
    if pitch is not None and pitch.shape != loudness.shape:
        raise ShapeError(f"loudness has {len(loudness)} values and pitch {len(pitch)}: they must be aligned")
    from scipy.signal import find_peaks  # slow to load, and only motion needs it

    if len(loudness) < 3:
        return np.zeros(0), np.zeros(0)
    prominence = _contour(relative_loudness(loudness), rate, 0.045)
    if pitch is not None:
        prominence = prominence + 0.7 * pitch_contour(pitch, rate)
    peaks, found = find_peaks(prominence, prominence=0.35, distance=max(1, round(0.22 * rate)))
    strengths = np.clip(found["prominences"] / 2.5, 0.1, 1.0) * (prominence[peaks] > 0)
    kept = strengths > 0
    return (peaks[kept] + 0.5) / rate, strengths[kept]


def wander(
    samples: int, deviation: float, time_constant: float, generator: np.random.Generator
) -> Float[np.ndarray, " samples"]:
    """Ornstein-Uhlenbeck noise at `CONTROL_RATE`, stationary from the first sample, low-passed at 0.1 s."""
    from scipy.signal import lfilter  # slow to load, and only motion needs it

    lead = round(CONTROL_RATE)
    keep = np.exp(-1 / (CONTROL_RATE * time_constant))
    noise = generator.normal(size=lead + samples)
    noise[0] /= np.sqrt(1 - keep * keep)
    track = lfilter([np.sqrt(1 - keep * keep)], [1, -keep], noise)
    return deviation * gaussian_filter1d(track, 0.1 * CONTROL_RATE)[lead:]


def pulses(
    times: np.ndarray, centres: np.ndarray, strengths: np.ndarray, rise: float, fall: float
) -> Float[np.ndarray, " times"]:
    """Maximum over bell-shaped pulses that rise and fall within the given seconds."""
    result = np.zeros(len(times))
    for centre, strength in zip(centres, strengths):
        offset = times - centre
        width = np.where(offset < 0, rise, fall)
        result = np.maximum(result, strength * np.exp(-0.5 * (offset / (0.45 * width)) ** 2))
    return result


def pose_from_prosody(
    frames: int,
    fps: float,
    seed: int = 0,
    loudness: Float[np.ndarray, " times"] | None = None,
    pitch: Float[np.ndarray, " times"] | None = None,
    rate: float = 100.0,
    amount: float = 1.0,
    rest: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Float[np.ndarray, "frames 3"]:
    """Head rotation of a speaker: slow wandering, a nod on each accent, pitch of the voice lifts the head.

    Head motion follows pitch and accents (Yehia et al., "Linking facial animation, head motion and speech
    acoustics", 2002; Graf et al., "Visual prosody", 2002); the amounts here are this project's choice.

    Parameters
    ----------
    frames : int
        Frames to make; frame i is at (i + 0.5) / fps seconds. The same seed gives the same motion in time at
        every frame rate.
    fps : float
        Frames a second.
    seed : int
        Of the random part.
    loudness, pitch : (N,), optional
        Amplitude, and Hz with 0 where unvoiced; without loudness the head only wanders.
    rate : float
        Values of `loudness` and `pitch` a second.
    amount : float
        Gain on all movement.
    rest : (pitch, yaw, roll)
        Radians around which the head moves.

    Returns
    -------
    (T, 3) float32
        Axis-angle, radians; x nods (positive: chin down), y turns (positive: to the subject's left), z tilts.
    """
    if not fps > 0 or frames < 0:
        raise OptionError(f"fps must be positive and frames not negative, not {fps} and {frames}")
    count = int(np.ceil(frames / fps * CONTROL_RATE)) + 2
    times = np.arange(count) / CONTROL_RATE
    # One stream a component, so that a longer track begins as a shorter one does.
    streams = [np.random.default_rng([seed, 0x9051, axis]) for axis in range(4)]
    angles = np.stack(
        [
            wander(count, 0.024, 1.0, streams[0]),
            wander(count, 0.050, 1.3, streams[1]),
            wander(count, 0.026, 1.5, streams[2]),
        ],
        axis=-1,
    )
    if loudness is not None:
        centres, strengths = prosodic_accents(loudness, pitch, rate)
        side = streams[3].choice([-1.0, 1.0], size=len(centres))
        nods = pulses(times, centres + 0.05, strengths, rise=0.22, fall=0.34)
        angles[:, 0] += 0.060 * gaussian_filter1d(nods, 0.04 * CONTROL_RATE)
        angles[:, 1] += 0.018 * gaussian_filter1d(
            pulses(times, centres, strengths * (side > 0), 0.3, 0.5)
            - pulses(times, centres, strengths * (side < 0), 0.3, 0.5),
            0.06 * CONTROL_RATE,
        )
        if pitch is not None:
            contour = np.interp(times, (np.arange(len(pitch)) + 0.5) / rate, pitch_contour(pitch, rate))
            angles[:, 0] -= 0.016 * gaussian_filter1d(contour, 0.12 * CONTROL_RATE)
    limit = np.array([0.30, 0.40, 0.25])
    angles = limit * np.tanh(amount * angles / limit) + np.asarray(rest)
    at = (np.arange(frames) + 0.5) / fps
    return np.stack([np.interp(at, times, angle) for angle in angles.T], axis=-1).astype(np.float32)


def smooth_rotations(
    rotations: Float[np.ndarray, "frames 3"], sigma: float = 1.0, window: int = 15
) -> Float[np.ndarray, "frames 3"]:
    """Gaussian filter of a rotation track, in the tangent space at the track's mean rotation.

    Rotations that pass through pi come out as smooth as any others (GAVA, Sec. III-B: sigma 1, window 15).

    Parameters
    ----------
    rotations : (T, 3)
        Axis-angle, radians.
    sigma : float
        Frames.
    window : int
        Odd number of frames; the Gaussian is cut there and renormalised, edges are reflected.

    Returns
    -------
    (T, 3), of the input's dtype
        Axis-angle, radians, angles in [0, pi].
    """
    if window % 2 == 0 or window < 1 or not sigma > 0:
        raise OptionError(
            f"window must be odd and positive and sigma positive, not {window} frames and {sigma}"
        )
    if len(rotations) == 0:
        return rotations
    matrices = roma.rotvec_to_rotmat(torch.as_tensor(np.asarray(rotations, np.float64)))
    mean = roma.special_procrustes(matrices.sum(0))
    tangent = roma.rotmat_to_rotvec(mean.T @ matrices).numpy()
    offsets = np.arange(window) - window // 2
    weights = np.exp(-0.5 * (offsets / sigma) ** 2)
    smooth = correlate1d(tangent, weights / weights.sum(), axis=0, mode="reflect")
    result = roma.rotmat_to_rotvec(mean @ roma.rotvec_to_rotmat(torch.from_numpy(smooth)))
    return result.numpy().astype(rotations.dtype)
