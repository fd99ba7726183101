"""Another voice saying the same at the same times: pitch and vocal tract changed, timing kept."""

import numpy as np
from jaxtyping import Complex128, Float64

from meshanim.audio.waveform import Waveform
from meshanim.errors import OptionError

__all__ = ["change_voice", "stretch_time"]

SIZE, HOP = 1024, 128
"""Samples of a window and between two; scaled with the rate from 16 kHz."""
LIFTER = 0.0025
"""Seconds of the cepstrum that are the vocal tract and not the voice: pitches up to 400 Hz."""


def change_voice(waveform: Waveform, semitones: float = 0.0, tract: float = 1.0) -> Waveform:
    """The same speech at another pitch, or by another vocal tract, sample for sample at the same times.

    The sound is read faster or slower (pitch and formants move together) and stretched back to its length;
    the spectral envelope, from the low part of the cepstrum, is then put where `tract` wants it.

    Parameters
    ----------
    waveform : Waveform
        Speech.
    semitones : float
        Change of the pitch, -12 to 12.
    tract : float
        Factor on the formants, 0.7 to 1.4: above 1 a shorter vocal tract. 1 keeps the speaker's own.

    Raises
    ------
    OptionError
        If a number is out of range.
    """
    if not -12 <= semitones <= 12 or not 0.7 <= tract <= 1.4:
        raise OptionError(f"{semitones} semitones and tract {tract}; expected -12 to 12 and 0.7 to 1.4")
    factor = 2 ** (semitones / 12)
    samples = waveform.samples.astype(np.float64)
    if semitones:
        shifted = stretch_time(_read_faster(waveform, factor), len(samples), waveform.rate)
    else:
        shifted = samples
    if semitones or tract != 1:
        shifted = _with_envelope(shifted, waveform.rate, tract / factor)
    loudness = np.sqrt(np.mean(np.square(samples)) / max(float(np.mean(np.square(shifted))), 1e-20))
    changed = shifted * loudness
    peak = max(float(np.abs(changed).max(initial=0)), 1e-9)
    return Waveform((changed * min(1.0, 0.99 / peak)).astype(np.float32), waveform.rate)


def _read_faster(waveform: Waveform, factor: float) -> Float64[np.ndarray, " samples"]:
    """Every `factor`-th sample, band-limited."""
    whole = 48000
    slower = Waveform(waveform.samples, round(whole * factor)).resampled(whole)
    return slower.samples.astype(np.float64)


def stretch_time(
    samples: Float64[np.ndarray, " samples"], count: int, rate: int
) -> Float64[np.ndarray, " count"]:
    """The same sound lasting `count` samples: a phase vocoder (Flanagan and Golden 1966).

    Phases around a spectral peak keep their relation to it (Laroche and Dolson 1999).

    Parameters
    ----------
    samples : (N,) array
        Sound.
    count : int
        Samples of the result, within a factor of 4 of N.
    rate : int
        Samples a second.

    Raises
    ------
    OptionError
        If the factor is out of range.
    """
    if not len(samples) or not 0.25 <= count / len(samples) <= 4:
        raise OptionError(f"{len(samples)} samples to last {count}; expected a factor of 1/4 to 4")
    hop, spectra = _analysis(samples, rate)
    steps = np.arange(-(-count // hop) + 1) * (len(samples) / count)
    lower = np.minimum(steps.astype(np.int64), len(spectra) - 2)
    part = np.clip(steps - lower, 0, 1)[:, None]
    magnitude = (1 - part) * np.abs(spectra[lower]) + part * np.abs(spectra[lower + 1])
    angle = np.angle(spectra)
    advance = angle[lower + 1] - angle[lower]
    bins = np.arange(spectra.shape[1])
    expected = 2 * np.pi * hop * bins / (2 * (spectra.shape[1] - 1))
    advance = expected + (advance - expected + np.pi) % (2 * np.pi) - np.pi
    phase = angle[0]
    out = np.empty((len(steps), spectra.shape[1]), np.complex128)
    for k, row in enumerate(lower):
        if k:
            phase = phase + advance[k - 1]
            peaks = _peaks(magnitude[k])
            if len(peaks):
                owner = peaks[np.searchsorted((peaks[1:] + peaks[:-1]) / 2, bins)]
                phase = phase[owner] + angle[row] - angle[row, owner]
        out[k] = magnitude[k] * np.exp(1j * phase)
    return _synthesis(out, hop, count)


def _peaks(magnitude: Float64[np.ndarray, " bins"]) -> np.ndarray:
    inner = magnitude[2:-2]
    higher = [inner > magnitude[2 + shift : len(magnitude) - 2 + shift] for shift in (-2, -1, 1, 2)]
    return np.flatnonzero(np.logical_and.reduce(higher)) + 2


def _analysis(
    samples: Float64[np.ndarray, " samples"], rate: int
) -> tuple[int, Complex128[np.ndarray, "frames bins"]]:
    scale = max(1, round(rate / 16000))
    size, hop = SIZE * scale, HOP * scale
    frames = -(-len(samples) // hop) + 2
    padded = np.pad(samples, (size // 2, size + hop * frames - len(samples)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, size)[::hop][:frames]
    return hop, np.fft.rfft(windows * np.hanning(size + 1)[:-1], axis=1)


def _synthesis(
    spectra: Complex128[np.ndarray, "frames bins"], hop: int, count: int
) -> Float64[np.ndarray, " count"]:
    """Overlap and add, divided by the sum of squared windows."""
    size = 2 * (spectra.shape[1] - 1)
    window = np.hanning(size + 1)[:-1]
    pieces = np.fft.irfft(spectra, size, axis=1) * window
    total = size + hop * len(pieces)
    out, weight = np.zeros(total), np.zeros(total)
    for k, piece in enumerate(pieces):
        out[k * hop : k * hop + size] += piece
        weight[k * hop : k * hop + size] += window**2
    out = (out / np.maximum(weight, 1e-3))[size // 2 :]
    return np.pad(out, (0, max(0, count - len(out))))[:count]


def _with_envelope(
    samples: Float64[np.ndarray, " samples"], rate: int, factor: float
) -> Float64[np.ndarray, " samples"]:
    """Formants moved by a factor, pitch and times kept."""
    hop, spectra = _analysis(samples, rate)
    logs = np.log(np.abs(spectra) + 1e-6 * (np.abs(spectra).max() + 1e-12))
    cepstrum = np.fft.irfft(logs, axis=1)
    keep = max(2, round(LIFTER * rate))
    cepstrum[:, keep:-keep] = 0
    envelope = np.fft.rfft(cepstrum, axis=1).real
    bins = np.arange(envelope.shape[1])
    source = np.clip(bins / factor, 0, len(bins) - 1)
    lower = np.minimum(source.astype(np.int64), len(bins) - 2)
    part = source - lower
    moved = envelope[:, lower] * (1 - part) + envelope[:, lower + 1] * part
    gain = np.exp(np.clip(moved - envelope, -7, 7))
    return _synthesis(spectra * gain, hop, len(samples))
