"""Rooms, microphones, noise and lines that training speech is sent through, so that real speech fits."""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Complex64, Float32, Float64
from torch import Tensor

__all__ = ["degrade", "mask_features", "resample_clip"]

RATE = 16000
Noise = Callable[[np.random.Generator, int], Float32[np.ndarray, " samples"]]


def resample_clip(
    samples: Float32[np.ndarray, " samples"], count: int, speed: float
) -> Float32[np.ndarray, " count"]:
    """`count` samples read at `speed`, by linear interpolation: tempo, pitch and formants change together."""
    position = np.arange(count) * speed
    lower = position.astype(np.int64)
    weight = (position - lower).astype(np.float32)
    return samples[lower] * (1 - weight) + samples[np.minimum(lower + 1, len(samples) - 1)] * weight


def _response(generator: np.random.Generator, size: int) -> Complex64[np.ndarray, " bins"]:
    """Equaliser, band limits and room, as one frequency response."""
    frequency = np.linspace(0, RATE / 2, size // 2 + 1)
    response = np.ones(len(frequency), np.complex128)
    if generator.random() < 0.6:
        points = int(generator.integers(4, 9))
        knots = np.log(50 + np.linspace(0, RATE / 2, points))
        response *= 10 ** (np.interp(np.log(50 + frequency), knots, generator.normal(0, 4.5, points)) / 20)
    if generator.random() < 0.35:
        cutoff, order = generator.uniform(3000, 7500), 2 * int(generator.integers(4, 12))
        response /= np.sqrt(1 + (frequency / cutoff) ** order)
    if generator.random() < 0.3:
        cutoff = generator.uniform(40, 350)
        response *= (frequency / (frequency + cutoff)) ** 2
    if generator.random() < 0.5:
        response *= np.fft.rfft(_room(generator), size)
    return response.astype(np.complex64)


def _room(generator: np.random.Generator, seconds: float = 0.4) -> Float64[np.ndarray, " samples"]:
    """Direct sound and an exponential tail of noise: RT60 80 to 600 ms, reverberation -16 to +2 dB."""
    time = np.arange(int(seconds * RATE)) / RATE
    tail = generator.normal(0, 1, len(time)) * np.exp(-6.9 * time / generator.uniform(0.08, 0.6))
    tail[: int(generator.uniform(16, 200))] = 0
    tail *= 10 ** (generator.uniform(-16, 2) / 20) / (np.sqrt((tail**2).sum()) + 1e-9)
    tail[0] = 1
    return tail


def _noise(generator: np.random.Generator, count: int, babble: Noise) -> tuple[np.ndarray, float]:
    """Noise and the ratio of speech to it in decibels: coloured, hum, or other voices."""
    kind = generator.random()
    if kind < 0.45:
        spectrum = np.fft.rfft(generator.normal(0, 1, count))
        slope = (np.arange(len(spectrum)) + 20.0) ** -generator.uniform(0, 1.2)
        return np.fft.irfft(spectrum * slope, count), generator.uniform(3, 40)
    if kind < 0.6:
        phase = 2 * np.pi * generator.uniform(40, 400) * np.arange(count) / RATE
        hum = sum(generator.random() * np.sin(k * phase + 6 * generator.random()) for k in range(1, 6))
        return hum + 0.1 * generator.normal(0, 1, count), generator.uniform(3, 40)
    return babble(generator, count), generator.uniform(6, 35)


def _quantised(
    samples: Float32[np.ndarray, " samples"], generator: np.random.Generator
) -> Float32[np.ndarray, " samples"]:
    """Telephone (mu-law) or 6 to 9 bits."""
    peak = np.abs(samples).max() + 1e-9
    value = samples / peak
    if generator.random() < 0.5:
        level = np.round(np.sign(value) * np.log1p(255 * np.abs(value)) / np.log(256) * 127) / 127
        value = np.sign(level) * (256 ** np.abs(level) - 1) / 255
    else:
        steps = 2.0 ** (int(generator.integers(6, 10)) - 1)
        value = np.round(value * steps) / steps
    return (value * peak).astype(np.float32)


def degrade(
    clips: Float32[np.ndarray, "batch samples"], generator: np.random.Generator, babble: Noise
) -> Float32[Tensor, "batch samples"]:
    """Each clip through a room and microphone, with noise, quantised at times, at another level.

    Parameters
    ----------
    clips : (batch, samples) float32
        Clean speech, 16 kHz.
    generator : numpy Generator
        Decides all.
    babble : callable
        (generator, samples) to a sum of other voices.

    Returns
    -------
    (batch, samples) tensor
        Peaks at 0.7 times -34 to +6 dB.
    """
    batch, count = clips.shape
    size = 1 << (count + 8000 - 1).bit_length()
    responses = torch.from_numpy(np.stack([_response(generator, size) for _ in range(batch)]))
    spectra = torch.fft.rfft(torch.from_numpy(clips), size) * responses
    out = torch.fft.irfft(spectra, size)[:, :count].numpy().copy()
    for samples in out:
        if generator.random() < 0.75:
            noise, ratio = _noise(generator, count, babble)
            power = max(float(np.mean(samples**2)), 1e-8) / 10 ** (ratio / 10)
            samples += (noise * np.sqrt(power / max(float(np.mean(noise**2)), 1e-9))).astype(np.float32)
        if generator.random() < 0.15:
            samples[:] = _quantised(samples, generator)
        samples *= 0.7 * 10 ** (generator.uniform(-34, 6) / 20) / (np.abs(samples).max() + 1e-4)
    return torch.from_numpy(out)


def mask_features(features: Float32[Tensor, "batch frames bands"], generator: np.random.Generator) -> None:
    """Blank a stripe of bands and a stripe of time in place (SpecAugment, Park et al. 2019)."""
    _, frames, bands = features.shape
    for clip in features:
        if generator.random() < 0.6:
            width = int(generator.integers(1, max(2, bands // 6)))
            start = int(generator.integers(0, bands - width))
            clip[:, start : start + width] = 0
        if generator.random() < 0.4:
            width = int(generator.integers(2, 12))
            start = int(generator.integers(0, frames - width))
            clip[start : start + width] = 0
