"""Speech: waveforms, features, encoders, phonemes and synthetic voices."""

from meshanim.audio.encoders import EncoderStream, SpeechEncoder, load_encoder
from meshanim.audio.features import MelConfig, autocorrelation, feature_windows, log_mel
from meshanim.audio.prosody import loudness, pitch
from meshanim.audio.waveform import Waveform, load_waveform, save_waveform

__all__ = [
    "EncoderStream",
    "MelConfig",
    "SpeechEncoder",
    "Waveform",
    "autocorrelation",
    "feature_windows",
    "load_encoder",
    "load_waveform",
    "log_mel",
    "loudness",
    "pitch",
    "save_waveform",
]
