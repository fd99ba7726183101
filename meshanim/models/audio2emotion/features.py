"""Stretches of sound to what the classifier reads: z-normalised, with neutral speech before them or alone."""

import math

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from meshanim.audio import SpeechEncoder, Waveform, load_encoder, loudness, pitch
from meshanim.errors import OptionError
from meshanim.models.audio2emotion.network import Audio2EmotionConfig
from meshanim.models.audio2face.speech import features_at

__all__ = ["EmotionFeatures", "feature_width", "loudest"]

RATE = 16000
PROSODY = 3
REFERENCE_STEP = 0.08
"""Seconds between frames of a reference: it is only pooled."""


def feature_width(encoder: SpeechEncoder, prosody: bool) -> int:
    """Numbers a frame."""
    return encoder.dim + PROSODY * prosody


def loudest(samples: Float32[np.ndarray, " samples"], count: int) -> Float32[np.ndarray, " count"]:
    """The `count` samples with the most energy, to 0.1 s; zeros behind a sound that is too short."""
    if len(samples) <= count:
        return np.pad(samples, (0, count - len(samples)))
    energy = np.concatenate([[0.0], np.cumsum(np.square(samples, dtype=np.float64))])
    starts = np.arange(0, len(samples) - count + 1, RATE // 10)
    start = int(starts[np.argmax(energy[starts + count] - energy[starts])])
    return samples[start : start + count]


class EmotionFeatures:
    """Features of stretches of `config.crop` seconds.

    Parameters
    ----------
    config : Audio2EmotionConfig
    encoder : SpeechEncoder, optional
        Loaded by the config's name if not given.

    Raises
    ------
    OptionError
        If the encoder does not fit the config.
    """

    def __init__(self, config: Audio2EmotionConfig, encoder: SpeechEncoder | None = None):
        self.config = config
        self.encoder = load_encoder(config.encoder) if encoder is None else encoder
        if feature_width(self.encoder, config.prosody) != config.feature_dim:
            raise OptionError(
                f"encoder {self.encoder.name} gives {feature_width(self.encoder, config.prosody)} features a "
                f"frame, the network reads {config.feature_dim}: it was trained with {config.encoder}"
            )
        self.crop = round(config.crop * RATE)
        self.steps = math.ceil(config.crop * self.encoder.rate)
        self.reference = round(config.reference * RATE)
        self.reference_steps = round(config.reference / REFERENCE_STEP)

    def alone(self, samples: Float32[np.ndarray, " samples"]) -> Float32[Tensor, "steps dim"]:
        """Of a stretch without a reference; zeros are put behind one that is too short."""
        part = np.pad(samples[: self.crop], (0, max(0, self.crop - len(samples))))
        return self._at(self._features(part), 0.0, self.steps, 1 / self.encoder.rate)

    def after(
        self, samples: Float32[np.ndarray, " samples"], neutral: Float32[np.ndarray, " neutral"]
    ) -> tuple[Float32[Tensor, "steps dim"], Float32[Tensor, "reference_steps dim"]]:
        """Of a stretch behind neutral speech and silence (App. A.4), and of that speech.

        Parameters
        ----------
        samples : (S,)
            16 kHz.
        neutral : (N,)
            Of the same voice, 16 kHz; its loudest `config.reference` seconds are taken.
        """
        part = np.pad(samples[: self.crop], (0, max(0, self.crop - len(samples))))
        pause = np.zeros(round(self.config.silence * RATE), np.float32)
        features = self._features(np.concatenate([loudest(neutral, self.reference), pause, part]))
        begin = (self.reference + len(pause)) / RATE
        return (
            self._at(features, begin, self.steps, 1 / self.encoder.rate),
            self._at(features, 0.0, self.reference_steps, REFERENCE_STEP),
        )

    def _at(self, features: Float32[Tensor, "frames dim"], begin: float, count: int, step: float) -> Tensor:
        times = begin + (torch.arange(count, dtype=torch.float64) + 0.5) * step
        return features_at(features, self.encoder.rate, times)

    def _features(self, samples: Float32[np.ndarray, " samples"]) -> Float32[Tensor, "frames dim"]:
        deviation = max(float(samples.std(dtype=np.float64)), 1e-5)
        wave = Waveform((samples - samples.mean(dtype=np.float64)) / deviation, RATE)
        features = self.encoder(wave).float()
        if not self.config.prosody:
            return features
        rate = self.encoder.rate
        tone, level = pitch(wave, rate), loudness(wave, rate)
        voiced = tone > 0
        octave = np.where(voiced, np.log2(np.maximum(tone, 1.0) / 150), 0.0)
        beside = np.stack([octave, voiced, np.log10(level + 1e-3)], 1).astype(np.float32)
        count = min(len(features), len(beside))
        return torch.cat([features[:count], torch.from_numpy(beside[:count])], 1)
