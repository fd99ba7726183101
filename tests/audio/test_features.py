"""Log-mel, autocorrelation, windows and normalisation against definitions written out again."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from meshanim.audio import MelConfig, Waveform, autocorrelation, feature_windows, load_encoder, log_mel
from meshanim.audio.features import RunningNormalization, mel_filters, utterance_normalization
from meshanim.errors import FileFormatError, OptionError, ShapeError


def noise(samples, seed=0):
    return Waveform(0.1 * np.random.default_rng(seed).normal(size=samples), 16000)


def test_log_mel_equals_the_definition_frame_by_frame():
    waveform = noise(3333)
    found = log_mel(waveform).numpy()
    assert found.shape == (21, 80)
    padded = np.pad(waveform.samples.astype(np.float64), 1000)
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(400) / 400)
    for k in (0, 7, 20):
        start = 1000 + k * 160 + 80 - 200
        power = np.abs(np.fft.rfft(padded[start : start + 400] * window, 512)) ** 2
        np.testing.assert_allclose(found[k], np.log(power @ mel_filters().double().numpy() + 1e-6), atol=1e-4)


@pytest.mark.parametrize("frequency", [200.0, 1000.0, 5000.0])
def test_a_tone_peaks_in_its_band(frequency):
    tone = Waveform(np.sin(2 * np.pi * frequency * np.arange(8000) / 16000), 16000)
    mel = lambda f: 2595 * np.log10(1 + f / 700)  # noqa: E731
    centre = (mel(frequency) - mel(60)) / (mel(7600) - mel(60)) * 81 - 1
    assert abs(int(log_mel(tone)[20].argmax()) - centre) <= 1


def test_an_impulse_lands_in_the_frame_of_its_time():
    samples = np.zeros(16000)
    samples[int(0.305 * 16000)] = 1
    assert int(log_mel(Waveform(samples, 16000)).sum(1).argmax()) == 30


def test_filters_form_a_partition_between_first_and_last_centre():
    filters = mel_filters(MelConfig(size=1 << 14))
    inner = filters.sum(1)[200:7000]
    torch.testing.assert_close(inner, torch.ones_like(inner), atol=1e-4, rtol=0)
    assert (mel_filters(warp=1.15) != mel_filters()).any()
    with pytest.raises(OptionError):
        mel_filters(MelConfig(high=9000.0))


@pytest.mark.parametrize("fps", [30.0, 50.0])
def test_autocorrelation_equals_its_sum(fps):
    waveform = noise(5000)
    found = autocorrelation(waveform, fps).numpy()
    k = 3
    start = round((k + 0.5) * 16000 / fps - 320)
    frame = waveform.samples[start : start + 640].astype(np.float64)
    frame = (frame - frame.mean()) * np.hanning(640)
    expected = [8.912 / 640 * (frame[lag:] * frame[: 640 - lag]).sum() for lag in range(32)]
    np.testing.assert_allclose(found[k], expected, atol=1e-6)
    with pytest.raises(OptionError):
        autocorrelation(waveform, fps, lags=0)


@settings(max_examples=30, deadline=None)
@given(
    rate=st.floats(20, 120),
    fps=st.floats(10, 120),
    frames=st.integers(0, 40),
    width=st.integers(1, 20),
)
def test_windows_of_a_ramp_read_its_times(rate, fps, frames, width):
    steps = 300
    times = (torch.arange(steps, dtype=torch.float64) + 0.5) / rate
    windows = feature_windows(times[:, None], rate, fps, frames, width)
    assert windows.shape == (frames, width, 1)
    expected = (np.arange(frames)[:, None] + 0.5) / fps + (np.arange(width) - (width - 1) / 2) / rate
    expected = np.clip(expected, float(times[0]), float(times[-1]))
    np.testing.assert_allclose(windows[..., 0].numpy(), expected, atol=1e-9)


def test_windows_at_the_features_own_rate_copy_them():
    features = torch.randn(20, 3)
    torch.testing.assert_close(feature_windows(features, 50.0, 50.0, 20, width=1)[:, 0], features)
    windows = feature_windows(features, 50.0, 50.0, 20, width=5)
    torch.testing.assert_close(windows[10], features[8:13])
    with pytest.raises(ShapeError):
        feature_windows(features[:0], 50.0, 50.0, 3)
    with pytest.raises(OptionError):
        feature_windows(features, 0.0, 50.0, 3)


@settings(max_examples=40, deadline=None)
@given(
    frames=st.integers(1, 90),
    weight=st.floats(1, 40),
    memory=st.floats(40, 60),
    cuts=st.lists(st.integers(0, 90), max_size=4),
)
def test_running_normalisation_equals_its_recursion_in_any_blocks(frames, weight, memory, cuts):
    values = np.random.default_rng(frames).normal(3, 2, (frames, 4)).astype(np.float32)
    mean, variance, n = np.zeros(4), np.ones(4), weight
    expected = []
    for value in values.astype(np.float64):
        n = min(n + 1, memory)
        previous, mean = mean, mean + (value - mean) / n
        variance = variance + ((value - previous) * (value - mean) - variance) / n
        expected.append((value - mean) / np.sqrt(variance + 0.1))
    running = RunningNormalization(np.zeros(4), np.ones(4), weight, memory)
    found = [running(block) for block in np.split(values, sorted(min(c, frames) for c in cuts))]
    np.testing.assert_allclose(np.concatenate(found), expected, atol=1e-5)


def test_running_normalisation_forgets_its_prior():
    values = np.random.default_rng(0).normal(-5, 2, (3000, 2)).astype(np.float32)
    settled = RunningNormalization(np.full(2, 9.0), np.full(2, 30.0))(values)[1500:]
    assert abs(settled.mean()) < 0.1
    assert abs(settled.std() - 1) < 0.1
    with pytest.raises(OptionError):
        RunningNormalization(np.zeros(2), np.ones(2), weight=0.5)


def test_utterance_normalisation():
    features = utterance_normalization(3 + 2 * torch.randn(500, 4))
    assert features.mean(0).abs().max() < 1e-5
    assert (features.std(0) - 1).abs().max() < 0.25


@settings(max_examples=25, deadline=None)
@given(samples=st.integers(1, 3000), cuts=st.lists(st.integers(0, 3000), max_size=6))
def test_mel_streams_as_it_reads_files(samples, cuts):
    waveform = noise(samples, samples)
    encoder = load_encoder("mel")
    stream = encoder.stream()
    blocks = np.split(waveform.samples, sorted(min(c, samples) for c in cuts))
    found = torch.cat([*(stream.push(block) for block in blocks), stream.finish()])
    torch.testing.assert_close(found, encoder(waveform), atol=1e-5, rtol=1e-5)


def test_streams_refuse_what_files_refuse():
    stream = load_encoder("mel").stream()
    with pytest.raises(ShapeError):
        stream.push(np.array([0.0, np.nan], np.float32))
    with pytest.raises(ShapeError):
        stream.finish()
    stream.push(np.zeros(10, np.float32))
    stream.finish()
    with pytest.raises(OptionError):
        stream.push(np.zeros(10, np.float32))


def test_precomputed_features_load_as_they_are(tmp_path):
    windows = np.random.default_rng(0).normal(size=(50, 16, 29)).astype(np.float64)
    np.save(tmp_path / "deepspeech.npy", windows)
    encoder = load_encoder(f"features:{tmp_path / 'deepspeech.npy'}@30")
    assert encoder.rate == 30
    assert encoder.dim == 29
    np.testing.assert_array_equal(encoder.windows.numpy(), windows.astype(np.float32))
    np.testing.assert_array_equal(encoder(noise(10)).numpy(), windows[:, 8].astype(np.float32))


def test_precomputed_features_that_are_none(tmp_path):
    (tmp_path / "text.npy").write_text("no array")
    np.save(tmp_path / "objects.npy", np.array([{}], dtype=object))
    for name in ("text.npy", "objects.npy", "missing.npy"):
        with pytest.raises(FileFormatError):
            load_encoder(f"features:{tmp_path / name}")
    np.save(tmp_path / "flat.npy", np.zeros(5))
    np.save(tmp_path / "nan.npy", np.full((5, 2), np.nan))
    for name in ("flat.npy", "nan.npy"):
        with pytest.raises(ShapeError):
            load_encoder(f"features:{tmp_path / name}")


@pytest.mark.parametrize("name", ["deepspeech", "", "mel:path", "features", "features:file.npy@fast"])
def test_unknown_encoders(name):
    with pytest.raises(OptionError):
        load_encoder(name)
