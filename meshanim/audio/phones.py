"""Encoders on pocketsphinx's phone decoder: alone, in the role of DeepSpeech, and with the viseme net."""

import torch
from jaxtyping import Float32
from torch import Tensor

from meshanim.audio.encoders import SpeechEncoder
from meshanim.audio.features import frame_count
from meshanim.audio.phonemes import (
    PHONEMES,
    VISEME_OF_PHONEME,
    VISEMES,
    phoneme_frames,
    recognize_phonemes,
    recognizer,
)
from meshanim.audio.visemes import VisemeEncoder
from meshanim.audio.waveform import Waveform
from meshanim.errors import OptionError

__all__ = ["FusedEncoder", "PhoneEncoder"]

RATE = 50.0
_DOUBT = 0.02


def _visemes_of(phonemes: Float32[Tensor, "frames phonemes"]) -> Float32[Tensor, "frames visemes"]:
    """Probabilities of phonemes summed over the classes that look alike."""
    sums = phonemes.new_zeros(len(phonemes), len(VISEMES))
    return sums.index_add_(1, torch.from_numpy(VISEME_OF_PHONEME), phonemes)


class PhoneEncoder(SpeechEncoder):
    """Best phones of pocketsphinx's decoder as soft posteriors: 40 phonemes, 13 visemes, 50 frames a second.

    Its acoustic model was trained on recorded people: on clean speech better than the viseme net, in noise
    worse. Needs the whole utterance. A decoded phone has probability 0.98 and the rest is shared;
    neighbours in time are mixed (1/4, 1/2, 1/4).

    Raises
    ------
    DependencyError
        If pocketsphinx is not installed (extra `speech`).
    """

    def __init__(self) -> None:
        recognizer()
        self.name = "phones"
        self.rate = RATE
        self.dim = len(PHONEMES) + len(VISEMES)

    def __call__(self, waveform: Waveform) -> Float32[Tensor, "frames dim"]:
        count = frame_count(waveform, self.rate)
        best = torch.from_numpy(phoneme_frames(recognize_phonemes(waveform), count, self.rate))
        certain = torch.full((count, len(PHONEMES)), _DOUBT / len(PHONEMES))
        certain[torch.arange(count), best] += 1 - _DOUBT
        padded = torch.cat([certain[:1], certain, certain[-1:]])
        phonemes = 0.25 * padded[:-2] + 0.5 * padded[1:-1] + 0.25 * padded[2:]
        return torch.cat([phonemes, _visemes_of(phonemes)], dim=1)


class FusedEncoder(SpeechEncoder):
    """The viseme net and the phone decoder together: log p = log p_net + weight log p_decoder, normalised.

    The best of both on clean recordings; in noise leave the decoder out. Needs the whole utterance.

    Parameters
    ----------
    visemes : VisemeEncoder, optional
        Gives posteriors; the packaged one with utterance statistics by default.
    weight : float
        Of the phone decoder, 0 to 1; 0.3 was best on recorded speech.

    Raises
    ------
    OptionError
        If the weight is out of range or the viseme encoder gives something else than posteriors.
    DependencyError
        If pocketsphinx is not installed (extra `speech`).
    """

    def __init__(self, visemes: VisemeEncoder | None = None, weight: float = 0.3):
        if not 0 <= weight <= 1:
            raise OptionError(f"weight is {weight}; expected 0 to 1")
        self.visemes = VisemeEncoder(normalization="utterance") if visemes is None else visemes
        if self.visemes.outputs != "posteriors":
            raise OptionError(f"viseme outputs are {self.visemes.outputs}; expected posteriors to fuse")
        self.decoder = PhoneEncoder()
        self.weight = weight
        self.name = "visemes+phones"
        self.rate = RATE
        self.dim = self.decoder.dim

    def __call__(self, waveform: Waveform) -> Float32[Tensor, "frames dim"]:
        logs = torch.log(self.visemes(waveform).clamp_min(1e-9))
        other = torch.log(self.decoder(waveform).clamp_min(1e-9))
        count = min(len(logs), len(other))
        fused = logs[:count] + self.weight * other[:count]
        split = len(PHONEMES)
        return torch.cat([torch.softmax(fused[:, :split], 1), torch.softmax(fused[:, split:], 1)], dim=1)
