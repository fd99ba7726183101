"""Speech features without weights: log-mel, autocorrelation, windows at any frame rate, normalisation.

Frame k of a feature at `rate` frames a second describes time (k + 0.5) / rate, everywhere in this package.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64
from torch import Tensor

from meshanim.audio.waveform import Waveform
from meshanim.errors import OptionError, ShapeError

__all__ = [
    "MelConfig",
    "RunningNormalization",
    "autocorrelation",
    "centred_windows",
    "feature_windows",
    "frame_count",
    "log_mel",
    "mel_filters",
    "utterance_normalization",
]


@dataclass(frozen=True)
class MelConfig:
    """Log-mel analysis.

    Parameters
    ----------
    rate : int
        Samples a second that the input is brought to.
    bands : int
        Mel bands.
    low, high : float
        Range of the bands, Hz.
    window, hop : int
        Hann window and step, samples: 25 and 10 ms.
    size : int
        Points of the Fourier transform.
    floor : float
        Added to the power before the logarithm, relative to full scale 1.
    """

    rate: int = 16000
    bands: int = 80
    low: float = 60.0
    high: float = 7600.0
    window: int = 400
    hop: int = 160
    size: int = 512
    floor: float = 1e-6

    @property
    def fps(self) -> float:
        """Frames a second."""
        return self.rate / self.hop

    @property
    def margin(self) -> int:
        """Samples of a frame's window before (and after) the frame's own `hop` samples."""
        return (self.window - self.hop) // 2


DEFAULT_MEL = MelConfig()


@lru_cache(maxsize=64)
def mel_filters(config: MelConfig = DEFAULT_MEL, warp: float = 1.0) -> Float32[Tensor, "bins bands"]:
    """Triangles on the mel scale 2595 log10(1 + f / 700), peak 1.

    Parameters
    ----------
    config : MelConfig
        Bands and transform.
    warp : float
        Factor on the centre frequencies up to 4.8 kHz, then a line to half the rate: another length of the
        vocal tract (vocal tract length perturbation, Jaitly and Hinton 2013).

    Raises
    ------
    OptionError
        If the range of the bands does not fit the rate.
    """
    nyquist = config.rate / 2
    if not 0 <= config.low < config.high <= nyquist:
        raise OptionError(f"bands from {config.low} to {config.high} Hz; expected within 0 to {nyquist} Hz")
    mel = 2595 * np.log10(1 + np.array([config.low, config.high]) / 700)
    corners = 700 * (10 ** (np.linspace(mel[0], mel[1], config.bands + 2) / 2595) - 1)
    if warp != 1:
        knee = 0.6 * nyquist * min(1.0, 1 / warp)
        upper = knee * warp + (corners - knee) * (nyquist - knee * warp) / (nyquist - knee)
        corners = np.where(corners <= knee, corners * warp, upper)
    bins = np.linspace(0, nyquist, config.size // 2 + 1)[:, None]
    rising = (bins - corners[:-2]) / (corners[1:-1] - corners[:-2])
    falling = (corners[2:] - bins) / (corners[2:] - corners[1:-1])
    return torch.from_numpy(np.clip(np.minimum(rising, falling), 0, None).astype(np.float32))


def power_frames(
    samples: Float32[Tensor, "*batch samples"], config: MelConfig
) -> Float32[Tensor, "*batch frames bins"]:
    """Power spectra of every full window in `samples`, the first one starting at its first sample."""
    windows = samples.unfold(-1, config.window, config.hop) * torch.hann_window(config.window)
    spectrum = torch.view_as_real(torch.fft.rfft(windows, config.size))
    return spectrum.square().sum(-1)


def mel_frame_count(samples: int, config: MelConfig) -> int:
    """Frames that cover `samples` samples; the last one may be partly filled."""
    return -(-samples // config.hop)


def log_mel(waveform: Waveform, config: MelConfig = DEFAULT_MEL) -> Float32[Tensor, "frames bands"]:
    """Logarithm of the power in mel bands, 100 frames a second with the default configuration.

    Parameters
    ----------
    waveform : Waveform
        Speech; resampled to `config.rate`.
    config : MelConfig
        Window, bands, range.

    Returns
    -------
    (frames, bands) float32
        log(power + floor). Frame k is centred on (k + 0.5) / config.fps; beyond its ends the waveform is
        taken as silence; frames = ceil(duration * config.fps).
    """
    samples = torch.from_numpy(waveform.resampled(config.rate).samples)
    count = mel_frame_count(len(samples), config)
    after = (count - 1) * config.hop + config.window - config.margin - len(samples)
    padded = torch.nn.functional.pad(samples, (config.margin, after))
    return torch.log(power_frames(padded, config) @ mel_filters(config) + config.floor)


def frame_count(waveform: Waveform, fps: float) -> int:
    """Frames that cover the waveform at `fps`: the last one may be partly filled.

    Raises
    ------
    OptionError
        If fps is not positive.
    """
    if not fps > 0:
        raise OptionError(f"fps is {fps}; expected frames a second above 0")
    return max(1, int(np.ceil(len(waveform.samples) * fps / waveform.rate - 1e-9)))


def centred_windows(waveform: Waveform, fps: float, width: int) -> Float32[np.ndarray, "frames width"]:
    """Windows of `width` samples, the k-th centred on (k + 0.5) / fps; zeros beyond the ends."""
    count = frame_count(waveform, fps)
    starts = np.round((np.arange(count) + 0.5) * waveform.rate / fps - width / 2).astype(np.int64) + width
    missing = max(0, int(starts[-1]) + width - (width + len(waveform.samples)))
    padded = np.pad(waveform.samples, (width, missing))
    return padded[starts[:, None] + np.arange(width)]


def autocorrelation(
    waveform: Waveform,
    fps: float = 50.0,
    window: int = 640,
    lags: int = 32,
    rate: int = 16000,
    scale: float = 8.912,
) -> Float32[Tensor, "frames lags"]:
    """Autocorrelation of Hann-windowed frames with the mean removed: formants without a transform.

    Audio2Face's second input: Karras et al., SIGGRAPH 2017, Sec. 3.2, with the window, step and scale of
    Audio2Face-3D's regression net (640 samples, 320 apart, 32 lags, factor 8.912).

    Parameters
    ----------
    waveform : Waveform
        Speech; resampled to `rate`.
    fps : float
        Frames a second; frame k is centred on (k + 0.5) / fps, silence beyond the ends.
    window, lags : int
        Samples of a window and coefficients kept, lag 0 first.
    rate : int
        Samples a second.
    scale : float
        Factor on the coefficients, which are sums over the window divided by its length.

    Raises
    ------
    OptionError
        If lags does not lie between 1 and window, or fps is not positive.
    """
    if not 1 <= lags <= window:
        raise OptionError(f"lags is {lags}; expected 1 to window = {window}")
    frames = centred_windows(waveform.resampled(rate), fps, window).astype(np.float64)
    frames = (frames - frames.mean(axis=1, keepdims=True)) * np.hanning(window)
    spectrum = np.fft.rfft(frames, 2 * window)
    sums = np.fft.irfft(spectrum.real**2 + spectrum.imag**2, 2 * window)[:, :lags]
    return torch.from_numpy((sums * (scale / window)).astype(np.float32))


def feature_windows(
    features: Float[Tensor, "steps dim"],
    rate: float,
    fps: float,
    frames: int,
    width: int = 16,
    first: int = 0,
    offset: int = 0,
) -> Float[Tensor, "frames width dim"]:
    """For each animation frame the `width` feature frames around it, by linear interpolation in time.

    Entry j of frame i is the feature at (i + 0.5) / fps + (j - (width - 1) / 2) / rate: steps of the
    feature's own rate, centred on the frame at any fps. Times before the first or after the last feature
    frame take that frame's value.

    Parameters
    ----------
    features : (steps, dim) tensor
        Frame k describes time (k + 0.5) / rate.
    rate, fps : float
        Feature frames and animation frames a second.
    frames : int
        Animation frames.
    width : int
        Feature frames a window; 16 in VOCA and GAVA.
    first : int
        The first animation frame, where only a part of the speech is asked for.
    offset : int
        Which feature frame of the speech `features[0]` is, where earlier ones are no longer at hand.

    Returns
    -------
    (frames, width, dim) tensor

    Raises
    ------
    ShapeError
        If there are no features.
    OptionError
        If a rate or the width is not positive, or frames is negative.
    """
    if len(features) == 0:
        raise ShapeError("features have no frames; expected (steps, dim) with steps > 0")
    if not (rate > 0 and fps > 0 and width > 0 and frames >= 0):
        raise OptionError(
            f"rate {rate}, fps {fps}, width {width}, frames {frames}; expected positive numbers"
        )
    centres = (torch.arange(first, first + frames, dtype=torch.float64) + 0.5) * (rate / fps) - 0.5 - offset
    position = centres[:, None] + torch.arange(width, dtype=torch.float64) - (width - 1) / 2
    position = position.clamp(0, len(features) - 1).to(features.device)
    lower = position.floor().long()
    upper = (lower + 1).clamp(max=len(features) - 1)
    weight = (position - lower).to(features.dtype)[..., None]
    return features[lower] * (1 - weight) + features[upper] * weight


def utterance_normalization(features: Float[Tensor, "frames dim"]) -> Float[Tensor, "frames dim"]:
    """Each dimension with its mean over the utterance removed and divided by its deviation + 0.3."""
    return (features - features.mean(0)) / (features.std(0, unbiased=False) + 0.3)


class RunningNormalization:
    """Mean and variance normalisation that looks only back: the same for files and for streams.

    Mean and variance follow the input with weight 1 / n, where n grows by one a frame from `weight` frames
    of prior up to `memory` frames, and then stays: m += (y - m) / n, v += ((y - m_old)(y - m) - v) / n
    (Welford's update with exponential forgetting). Both are first-order recurrences: while n grows, sums;
    then a fixed recursive filter. Either is one call a block.

    Parameters
    ----------
    mean, variance : (dim,) arrays
        Prior.
    weight : float
        What the prior is worth, frames; at least 1.
    memory : float
        Largest n, frames.
    floor : float
        Added to the variance.

    Raises
    ------
    OptionError
        If weight is below 1 or above memory.
    """

    def __init__(
        self,
        mean: Float64[np.ndarray, " dim"],
        variance: Float64[np.ndarray, " dim"],
        weight: float = 100.0,
        memory: float = 300.0,
        floor: float = 0.1,
    ):
        if not 1 <= weight <= memory:
            raise OptionError(f"weight is {weight} frames; expected 1 to memory = {memory}")
        self.mean = np.array(mean, np.float64)
        self.variance = np.array(variance, np.float64)
        self.count = float(weight)
        self.memory = float(memory)
        self.floor = floor

    def _follow(
        self, values: Float64[np.ndarray, "frames dim"], state: Float64[np.ndarray, " dim"]
    ) -> Float64[np.ndarray, "frames dim"]:
        """s_t = s_{t-1} + (values_t - s_{t-1}) / n_t from `state`, with n as it stands."""
        growing = min(len(values), max(0, math.ceil(self.memory - self.count - 1e-9)))
        out = np.empty_like(values)
        if growing:
            counts = np.minimum(self.count + np.arange(1, growing + 1), self.memory)
            sums = np.cumsum(np.concatenate([self.count * state[None], values[:growing]]), axis=0)[1:]
            out[:growing] = sums / counts[:, None]
            if self.count + growing > self.memory and growing > 0:
                before = out[growing - 2] if growing > 1 else state
                out[growing - 1] = before + (values[growing - 1] - before) / self.memory
            state = out[growing - 1]
        if growing < len(values):
            from scipy.signal import lfilter  # slow to load, and only motion needs it

            keep = 1 - 1 / self.memory
            out[growing:] = lfilter(
                [1 / self.memory], [1, -keep], values[growing:], axis=0, zi=(keep * state)[None]
            )[0]
        return out

    def __call__(self, features: Float32[np.ndarray, "frames dim"]) -> Float32[np.ndarray, "frames dim"]:
        """Normalise the next frames of the stream and remember their statistics."""
        if len(features) == 0:
            return features
        values = features.astype(np.float64)
        means = self._follow(values, self.mean)
        previous = np.concatenate([self.mean[None], means[:-1]])
        variances = self._follow((values - previous) * (values - means), self.variance)
        self.mean, self.variance = means[-1], variances[-1]
        self.count = min(self.count + len(features), self.memory)
        return ((values - means) / np.sqrt(variances + self.floor)).astype(np.float32)
