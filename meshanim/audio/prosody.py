"""Loudness and pitch of speech, frame by frame: what moves head, brows and the width of articulation."""

import numpy as np
from jaxtyping import Float32

from meshanim.audio.features import centred_windows
from meshanim.audio.waveform import Waveform
from meshanim.errors import OptionError

__all__ = ["loudness", "pitch"]


def loudness(waveform: Waveform, fps: float, window: float = 0.05) -> Float32[np.ndarray, " frames"]:
    """Root mean square of the samples around each frame.

    Parameters
    ----------
    waveform : Waveform
        Speech.
    fps : float
        Frames a second; frame k describes time (k + 0.5) / fps.
    window : float
        Seconds, Hann weighted.

    Returns
    -------
    (frames,) float32
        Amplitude, full scale 1 (a full-scale sine has 0.707). In decibels: 20 log10.

    Raises
    ------
    OptionError
        If fps or window is not positive.
    """
    if not window > 0:
        raise OptionError(f"window is {window} s; expected seconds above 0")
    width = max(1, round(window * waveform.rate))
    weights = np.hanning(width + 2)[1:-1]
    power = np.square(centred_windows(waveform, fps, width), dtype=np.float64) @ (weights / weights.sum())
    return np.sqrt(power).astype(np.float32)


def pitch(
    waveform: Waveform,
    fps: float,
    minimum: float = 60.0,
    maximum: float = 500.0,
    threshold: float = 0.2,
) -> Float32[np.ndarray, " frames"]:
    """Fundamental frequency by YIN, zero where a frame has no voice.

    The cumulative-mean-normalised difference function, its first dip under `threshold`, and a parabola
    through the dip's neighbours (de Cheveigne and Kawahara, JASA 2002, steps 2 to 5). Frames quieter than
    a thousandth of the loudest one (-60 dB) count as unvoiced.

    Parameters
    ----------
    waveform : Waveform
        Speech; analysed at 16 kHz or below.
    fps : float
        Frames a second; frame k describes time (k + 0.5) / fps.
    minimum, maximum : float
        Range of the search, Hz.
    threshold : float
        Largest aperiodicity of a voiced frame, 0 to 1.

    Returns
    -------
    (frames,) float32
        Hz; 0 where unvoiced.

    Raises
    ------
    OptionError
        If fps is not positive or the range is empty or reaches half the rate.
    """
    if waveform.rate > 16000:
        waveform = waveform.resampled(16000)
    rate = waveform.rate
    if not 0 < minimum < maximum < rate / 2:
        raise OptionError(
            f"pitch range is {minimum} to {maximum} Hz; expected 0 < minimum < maximum < {rate / 2}"
        )
    longest = int(np.ceil(rate / minimum)) + 1
    shortest = int(rate // maximum)
    integration = longest
    frames = centred_windows(waveform, fps, integration + longest).astype(np.float64)

    size = 1 << int(np.ceil(np.log2(2 * integration + longest)))  # no wrap-around
    head = np.fft.rfft(frames[:, :integration], size)
    correlation = np.fft.irfft(np.fft.rfft(frames, size) * np.conj(head), size)[:, : longest + 1]
    energy = np.concatenate([np.zeros((len(frames), 1)), np.cumsum(frames**2, axis=1)], axis=1)
    lags = np.arange(longest + 1)
    power = energy[:, lags + integration] - energy[:, lags]
    difference = np.maximum(power[:, :1] + power - 2 * correlation, 0)
    mean = np.cumsum(difference[:, 1:], axis=1) / lags[1:]
    normalised = np.ones_like(difference)
    np.divide(difference[:, 1:], mean, out=normalised[:, 1:], where=mean > 1e-12 * (1 + power[:, :1]))

    inner = normalised[:, shortest:longest]
    dip = (inner < threshold) & (inner <= normalised[:, shortest - 1 : longest - 1])
    dip &= inner <= normalised[:, shortest + 1 : longest + 1]
    lag = shortest + np.argmax(dip, axis=1)
    rows = np.arange(len(frames))
    before, here, after = (difference[rows, lag + k] for k in (-1, 0, 1))
    curvature = before - 2 * here + after
    shift = np.where(curvature > 0, 0.5 * (before - after) / np.where(curvature > 0, curvature, 1), 0.0)
    level = power[:, 0]
    voiced = dip.any(axis=1) & (level > 1e-6 * level.max())
    return np.where(voiced, rate / (lag + np.clip(shift, -0.5, 0.5)), 0.0).astype(np.float32)
