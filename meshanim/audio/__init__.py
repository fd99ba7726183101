"""Speech: waveforms, features, encoders, phonemes and synthetic voices."""

from meshanim.audio.encoders import EncoderStream, SpeechEncoder, load_encoder
from meshanim.audio.features import MelConfig, autocorrelation, feature_windows, log_mel
from meshanim.audio.phonemes import PHONEMES, VISEMES, Phoneme, align, phoneme_frames, recognize_phonemes
from meshanim.audio.prosody import loudness, pitch
from meshanim.audio.synthesis import speak, synthesize_speech, voices
from meshanim.audio.waveform import Waveform, load_waveform, save_waveform

__all__ = [
    "PHONEMES",
    "VISEMES",
    "EncoderStream",
    "MelConfig",
    "Phoneme",
    "SpeechEncoder",
    "Waveform",
    "align",
    "autocorrelation",
    "feature_windows",
    "load_encoder",
    "load_waveform",
    "log_mel",
    "loudness",
    "phoneme_frames",
    "pitch",
    "recognize_phonemes",
    "save_waveform",
    "speak",
    "synthesize_speech",
    "voices",
]
