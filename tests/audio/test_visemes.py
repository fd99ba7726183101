"""The viseme encoder: streams equal files, look-ahead is bounded, recorded speech is understood."""

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from meshanim.audio import PHONEMES, VISEMES, Waveform, load_encoder, load_waveform
from meshanim.audio.viseme_evaluation import CONDITIONS, degraded, evaluate, load_clips
from meshanim.audio.visemes import VisemeEncoder, VisemeNet, VisemeNetConfig, load_viseme_net, save_viseme_net
from meshanim.errors import FileFormatError, OptionError, ShapeError

DATA = Path(__file__).parent / "data"


@pytest.fixture(scope="module")
def encoder():
    return load_encoder("visemes")


def speech(samples):
    recorded = load_waveform(DATA / "librivox_0930.flac").samples
    return Waveform(np.resize(recorded, samples), 16000)


@settings(max_examples=25, deadline=None)
@given(samples=st.integers(1, 40000), cuts=st.lists(st.integers(0, 40000), max_size=12))
def test_streams_equal_files(encoder, samples, cuts):
    waveform = speech(samples)
    stream = encoder.stream()
    blocks = np.split(waveform.samples, sorted(min(c, samples) for c in cuts))
    found = torch.cat([*(stream.push(block) for block in blocks), stream.finish()])
    torch.testing.assert_close(found, encoder(waveform), atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("outputs", ["posteriors", "logarithms", "hidden"])
def test_small_steady_blocks(outputs):
    encoder = VisemeEncoder(outputs=outputs)
    waveform = speech(24000)
    stream = encoder.stream()
    blocks = np.split(waveform.samples, np.arange(100, 24000, 100))
    found = torch.cat([*(stream.push(block) for block in blocks), stream.finish()])
    assert found.shape == (75, encoder.dim)
    torch.testing.assert_close(found, encoder(waveform), atol=2e-4, rtol=1e-4)


def test_what_a_stream_gives_is_at_most_110_ms_late(encoder):
    stream = encoder.stream()
    given_frames = 0
    for block in range(100):
        given_frames += len(stream.push(np.zeros(160, np.float32)))
        spoken = (block + 1) * 0.01
        assert given_frames >= (spoken - 0.11) * 50


def test_later_samples_do_not_change_earlier_frames(encoder):
    waveform = speech(32000)
    changed = waveform.samples.copy()
    changed[16000:] = np.random.default_rng(0).normal(0, 0.3, 16000)
    first, second = encoder(waveform), encoder(Waveform(changed, 16000))
    unaffected = int((1.0 - 0.0975) * 50)
    torch.testing.assert_close(first[:unaffected], second[:unaffected], atol=1e-5, rtol=1e-4)
    assert (first[unaffected + 6 :] - second[unaffected + 6 :]).abs().max() > 0.1


def test_posteriors_are_probabilities(encoder):
    features = encoder(speech(16000))
    assert encoder.dim == len(PHONEMES) + len(VISEMES) == features.shape[1]
    assert encoder.rate == 50
    assert features.shape[0] == 50
    torch.testing.assert_close(features[:, :40].sum(1), torch.ones(50))
    torch.testing.assert_close(features[:, 40:].sum(1), torch.ones(50))
    logarithms = VisemeEncoder(outputs="logarithms")(speech(16000))
    torch.testing.assert_close(logarithms.exp(), features)


@pytest.mark.parametrize("samples", [1, 100, 320, 321, 800])
def test_speech_of_milliseconds(encoder, samples):
    assert encoder(speech(samples)).shape == (-(-samples // 320), 53)


def test_silence_is_silence(encoder):
    silent = encoder(Waveform(np.zeros(32000), 16000))
    assert (silent[25:, 40:].argmax(1) == VISEMES.index("sil")).float().mean() > 0.9


def test_recorded_speech_is_understood():
    pytest.importorskip("pocketsphinx")
    clips = load_clips(DATA)
    for normalization in ("running", "utterance"):
        encoder = VisemeEncoder(normalization=normalization)

        def posteriors(waveform, encoder=encoder):
            features = encoder(waveform).numpy()
            return features[:, :40], features[:, 40:]

        found, groups = evaluate(clips, posteriors)
        assert found["viseme_accuracy"] > 0.55
        assert found["silence_f1"] > 0.7
        assert set(groups) == {"arctic", "librivox"}
        assert evaluate(clips, posteriors, "noise10")[0]["viseme_accuracy"] > 0.4


def test_conditions_change_speech_and_keep_its_length():
    waveform = speech(16000)
    for condition in CONDITIONS:
        changed = degraded(waveform, condition, np.random.default_rng(0))
        assert len(changed.samples) == 16000
        assert (condition == "clean") == np.array_equal(changed.samples, waveform.samples)
    with pytest.raises(OptionError):
        degraded(waveform, "underwater", np.random.default_rng(0))


def test_fusion_with_the_phone_decoder():
    pytest.importorskip("pocketsphinx")
    waveform = speech(32000)
    phones, fused = load_encoder("phones"), load_encoder("visemes+phones")
    alone, both = phones(waveform), fused(waveform)
    assert alone.shape == both.shape == (100, 53)
    for features in (alone, both):
        torch.testing.assert_close(features[:, 40:].sum(1), torch.ones(100), atol=1e-4, rtol=0)
    net = VisemeEncoder(normalization="utterance")(waveform)
    expected = torch.log(net[:, 40:]) + 0.3 * torch.log(alone[:, 40:])
    torch.testing.assert_close(both[:, 40:], torch.softmax(expected, 1), atol=1e-4, rtol=1e-3)
    for encoder in (phones, fused):
        with pytest.raises(OptionError, match="whole utterance"):
            encoder.stream()


def test_nets_are_saved_and_loaded(tmp_path):
    net = VisemeNet(VisemeNetConfig(width=16, dilations=(1, 2), future=(1, 0))).eval()
    path = tmp_path / "net.safetensors"
    save_viseme_net(net, path, {"steps": 3})
    again = load_viseme_net(path)
    mel = torch.randn(1, 80, 50)
    torch.testing.assert_close(again(mel)[1], net(mel)[1], atol=1e-2, rtol=1e-2)
    waveform = speech(5000)
    assert VisemeEncoder(again, outputs="hidden")(waveform).shape == (16, 16)


def test_weights_that_are_none(tmp_path):
    path = tmp_path / "net.safetensors"
    with pytest.raises(FileFormatError):
        load_viseme_net(path)
    save_viseme_net(VisemeNet(VisemeNetConfig(width=16)), path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(FileFormatError):
        load_viseme_net(path)
    save_viseme_net(VisemeNet(VisemeNetConfig(width=8)), tmp_path / "other.safetensors")
    path.write_bytes((tmp_path / "other.safetensors").read_bytes())
    with pytest.raises(FileFormatError) as caught:
        load_viseme_net(path)
    assert "\n" not in str(caught.value)


def test_bad_options(encoder):
    for options in ({"outputs": "text"}, {"normalization": "none"}, {"prior": 0.0}):
        with pytest.raises(Exception, match=r"expected|parameter"):
            VisemeEncoder(encoder.net, **options)
    with pytest.raises(OptionError, match="whole utterance"):
        VisemeEncoder(encoder.net, normalization="utterance").stream()
    with pytest.raises(OptionError, match="expected one each"):
        VisemeNet(VisemeNetConfig(future=(2,)))
    with pytest.raises(ShapeError):
        encoder.stream().push(np.array([np.inf], np.float32))
