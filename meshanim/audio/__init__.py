"""Speech: waveforms, features, encoders, phonemes and synthetic voices."""

from meshanim.audio.waveform import Waveform

__all__ = ["Waveform"]
