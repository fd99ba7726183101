"""Loudness and pitch on sounds whose answer is known."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from meshanim.audio import Waveform, loudness, pitch
from meshanim.errors import OptionError


def glottal(frequency, rate=16000, harmonics=20):
    """A pulse train's harmonics, 1/k, at a frequency that may change with time."""
    phase = 2 * np.pi * np.cumsum(frequency) / rate
    return sum(np.sin(k * phase) / k for k in range(1, harmonics)) / 4


@settings(max_examples=15, deadline=None)
@given(frequency=st.floats(75, 400), rate=st.sampled_from([8000, 16000, 48000]))
def test_pitch_of_steady_tones(frequency, rate):
    waveform = Waveform(glottal(np.full(rate // 2, frequency), rate, 8), rate)
    found = pitch(waveform, 50.0)[4:-4]
    np.testing.assert_allclose(found, frequency, rtol=0.01)


def test_pitch_follows_a_glide_at_the_frame_times():
    rate, fps = 16000, 30.0
    times = np.arange(2 * rate) / rate
    found = pitch(Waveform(glottal(120 + 40 * times), rate), fps)
    expected = 120 + 40 * (np.arange(60) + 0.5) / fps
    np.testing.assert_allclose(found[2:-2], expected[2:-2], atol=1.5)


def test_noise_and_silence_have_no_pitch():
    noise = np.random.default_rng(0).normal(size=16000)
    assert (pitch(Waveform(noise, 16000), 50.0) == 0).mean() > 0.9
    assert not pitch(Waveform(np.zeros(16000), 16000), 50.0).any()


def test_silence_beside_voice_is_unvoiced():
    voice = glottal(np.full(8000, 130.0))
    hum = 1e-5 * np.sin(2 * np.pi * 100 * np.arange(8000) / 16000)
    found = pitch(Waveform(np.concatenate([voice, hum]), 16000), 50.0)
    assert (found[2:22] > 0).all()
    assert not found[28:].any()


def test_loudness_of_a_sine_and_a_step():
    sine = np.sin(2 * np.pi * 500 * np.arange(16000) / 16000)
    levels = loudness(Waveform(np.concatenate([np.zeros(16000), sine]), 16000), 25.0)
    assert len(levels) == 50
    assert not levels[:24].any()
    np.testing.assert_allclose(levels[26:-1], np.sqrt(0.5), rtol=2e-3)


@pytest.mark.parametrize("samples", [1, 100, 801])
@pytest.mark.parametrize("fps", [24.0, 29.97, 60.0])
def test_frames_cover_short_waveforms(samples, fps):
    waveform = Waveform(np.full(samples, 0.1), 16000)
    frames = int(np.ceil(samples * fps / 16000))
    assert len(loudness(waveform, fps)) == len(pitch(waveform, fps)) == frames


def test_bad_options():
    waveform = Waveform(np.zeros(100), 16000)
    with pytest.raises(OptionError, match="fps"):
        loudness(waveform, 0.0)
    with pytest.raises(OptionError, match="window"):
        loudness(waveform, 30.0, window=0.0)
    with pytest.raises(OptionError, match="range"):
        pitch(waveform, 30.0, minimum=400.0, maximum=100.0)
