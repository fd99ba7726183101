import numpy as np
import pytest
import torch
from audio2face_small import noise, small_regression

from meshanim.audio import Waveform, autocorrelation, load_encoder
from meshanim.errors import FileFormatError, OptionError, ShapeError
from meshanim.models.audio2face import Audio2FaceRegression, EmotionTrack, RegressionConfig, RegressionStream
from meshanim.models.audio2face.regression import STEP_TIMES, STEPS, WINDOW, window_autocorrelation
from meshanim.models.audio2face.regression_stream import animate_regression
from meshanim.models.audio2face.speech import features_at, hearing, window_features


@pytest.fixture(scope="module")
def network():
    return small_regression()


def inputs(network, batch=3, seed=0):
    generator = torch.Generator().manual_seed(seed)
    config = network.config
    return (
        torch.randn(batch, WINDOW, generator=generator),
        torch.randn(batch, STEPS, config.feature_dim, generator=generator),
        torch.rand(batch, len(config.emotions), generator=generator),
        torch.randn(batch, config.implicit, generator=generator),
    )


def test_the_shapes_are_the_papers(network):
    out = network(*inputs(network))
    assert out.states.shape == (3, 169)
    assert {name: logits.shape for name, logits in out.phonemes.items()} == {
        "en": (3, 25, 40),
        "zh": (3, 25, 40),
    }
    assert WINDOW / 16000 == 0.52
    assert network.encoder(*inputs(network)[:2]).shape == (3, 512, 25)
    assert network.skin.out_features == 140
    assert STEP_TIMES[[0, 12, 24]] == pytest.approx([-0.24, 0, 0.24])


def test_autocorrelation_is_that_of_the_audio_package():
    waveform = noise(1.0)
    windows = torch.from_numpy(waveform.samples[None, :WINDOW])
    found = window_autocorrelation(windows.double())[0]
    # Its windows are centred 20 ms apart from 20 ms on; those of the package from 10 ms on at 50 a second.
    shifted = Waveform(waveform.samples[160 : 160 + WINDOW], 16000)
    expected = autocorrelation(shifted, 50.0)
    torch.testing.assert_close(found[:24].float(), expected[:24], atol=1e-5, rtol=1e-5)
    assert found.shape == (25, 32)


def plain(network, encoder, waveform, fps, frames, emotions, implicit):
    """Frame by frame from the definition: a window of samples, features at its steps, one state."""
    samples = np.pad(waveform.samples, WINDOW)
    features = encoder(waveform)
    states = []
    for frame in range(frames):
        time = (frame + 0.5) / fps
        start = round(time * 16000 - WINDOW / 2) + WINDOW
        window = torch.from_numpy(samples[start : start + WINDOW])[None]
        if network.config.hearing == "window":
            read = window_features(encoder, window, torch.from_numpy(STEP_TIMES + 0.26))
        else:
            read = features_at(features, encoder.rate, torch.from_numpy(time + STEP_TIMES))[None]
        with torch.no_grad():
            out = network(window, read, emotions.at(np.array([time])), implicit[None])
        states.append(out.states[0])
    return torch.stack(states)


@pytest.mark.parametrize(
    ("heard", "fps"), [("speech", 30.0), ("speech", 24.0), ("speech", 59.94), ("window", 25.0)]
)
def test_streams_and_files_are_the_definition(heard, fps):
    network, encoder, waveform = small_regression(hearing=heard), load_encoder("mel"), noise(0.9)
    emotions = EmotionTrack.of(network.config.emotions, (0.2, {"joy": 1.0}), (0.7, {"anger": 0.5}))
    implicit = network.implicit_of(clip="a", frame=3)
    frames = int(np.ceil(0.9 * fps - 1e-9))
    expected = plain(network, encoder, waveform, fps, frames, emotions, implicit)
    file = animate_regression(network, encoder, waveform, fps, emotions, implicit)
    torch.testing.assert_close(file, expected, atol=2e-5, rtol=0)
    for blocks in ([160], [4000, 1, 777], [100000]):
        stream = RegressionStream(network, encoder, fps, emotions, implicit, chunk=7)
        parts, at, k = [], 0, 0
        while at < len(waveform.samples):
            count = blocks[k % len(blocks)]
            parts.append(stream.push(waveform.samples[at : at + count]))
            # No frame waits longer than it has to: 0.26 s, and 12.5 ms of the mel windows beyond 0.24 s.
            at, k = min(at + count, len(waveform.samples)), k + 1
            assert stream.given >= int((at / 16000 - 0.27) * fps - 0.5)
        parts.append(stream.finish())
        torch.testing.assert_close(torch.cat(parts), file, atol=2e-5, rtol=0)
        assert len(stream.reader.samples) < 2 * WINDOW + 100000


def test_memory_of_a_stream_does_not_grow(network):
    stream = RegressionStream(network, load_encoder("mel"))
    waveform = noise(4.0)
    for first in range(0, 64000, 1600):
        stream.push(waveform.samples[first : first + 1600])
        assert len(stream.reader.samples) <= WINDOW + 2 * 1600
        assert len(stream.reader.features) < 80


def test_emotions_matter_and_neutral_is_none(network):
    windows, features, _, implicit = inputs(network)
    rows = [
        EmotionTrack.of(network.config.emotions, constant=name).at(np.zeros(3)) for name in ("neutral", "joy")
    ]
    assert not rows[0].any()
    neutral, joy = (network(windows, features, row, implicit).states for row in rows)
    assert (neutral - joy).abs().max() > 1e-3
    assert (network(windows, features, rows[0], implicit + 1).states - neutral).abs().max() > 1e-3


def test_emotion_tracks(unchecked):
    track = EmotionTrack.of(("joy", "anger"), (1.0, {"joy": 1.0}), (3.0, {"anger": 0.5, "neutral": 1.0}))
    np.testing.assert_allclose(
        track.at(np.array([0.0, 1.0, 2.0, 9.0])), [[1, 0], [1, 0], [0.5, 0.25], [0, 0.5]]
    )
    with pytest.raises(OptionError, match="no emotion 'love'"):
        EmotionTrack.of(("joy",), (0.0, {"love": 1.0}))
    with pytest.raises(ShapeError, match="must not fall"):
        EmotionTrack(np.array([1.0, 0.0]), np.zeros((2, 1)))
    with pytest.raises(ShapeError, match="expected"):
        EmotionTrack(np.array([1.0]), np.zeros((2, 1)))


def test_implicit_emotions_by_clip_and_emotion(network):
    rows = network.implicit.weight.detach()
    torch.testing.assert_close(network.implicit_of("joy"), rows[20:].mean(0))
    torch.testing.assert_close(network.implicit_of(clip="b", frame=2), rows[22])
    torch.testing.assert_close(network.implicit_of(clip="a"), rows[:20].mean(0))
    torch.testing.assert_close(network.implicit_of("pain"), rows.mean(0))
    with pytest.raises(OptionError, match="no training clip"):
        network.implicit_of(clip="c")
    with pytest.raises(OptionError, match="0 to 9"):
        network.implicit_of(clip="b", frame=10)


@pytest.mark.parametrize(("joy", "told"), [(0.0, "neutral"), (0.1, "neutral"), (0.6, "joy"), (1.0, "joy")])
def test_the_implicit_emotion_is_that_of_what_is_told_most(network, joy, told):
    emotions = EmotionTrack.of(network.config.emotions, (0.0, {"joy": joy}))
    stream = RegressionStream(network, load_encoder("mel"), emotions=emotions)
    torch.testing.assert_close(stream.implicit, network.implicit_of(told))


def test_a_deployed_network_has_no_phoneme_heads_and_gives_the_same(network, tmp_path):
    lean = network.deployed()
    assert not any("heads" in name for name in lean.state_dict())
    out = lean(*inputs(network))
    assert out.phonemes == {}
    assert torch.equal(out.states, network(*inputs(network)).states)
    lean.save_pretrained(tmp_path / "model")
    loaded = Audio2FaceRegression.from_pretrained(tmp_path / "model")
    assert loaded.config == lean.config
    assert torch.equal(loaded(*inputs(network)).states, out.states)
    assert torch.equal(loaded.actors.templates["anna"], network.actors.templates["anna"])
    assert "regression network" in (tmp_path / "model" / "README.md").read_text()
    (tmp_path / "model" / "model.safetensors").write_bytes(b"\0" * 64)
    with pytest.raises(FileFormatError, match="no checkpoint"):
        Audio2FaceRegression.from_pretrained(tmp_path / "model")


def test_how_an_encoder_is_listened_through(tmp_path):
    assert hearing(load_encoder("mel")) == "speech"
    np.save(tmp_path / "features.npy", np.zeros((9, 4), np.float32))
    assert hearing(load_encoder(f"features:{tmp_path}/features.npy")) == "window"


def test_bad_input_is_named(network, unchecked):
    windows, features, explicit, implicit = inputs(network)
    with pytest.raises(ShapeError, match="8320"):
        network(windows[:, 1:], features, explicit, implicit)
    with pytest.raises(OptionError, match="neutral"):
        RegressionConfig(3, emotions=("neutral",))
    with pytest.raises(OptionError, match="at least 1"):
        RegressionConfig(0)
    encoder = load_encoder("mel")
    with pytest.raises(OptionError, match="53 features"):
        RegressionStream(network, load_encoder("visemes"))
    with pytest.raises(OptionError, match="fps"):
        RegressionStream(network, encoder, fps=0.0)
    with pytest.raises(OptionError, match="1 emotions"):
        RegressionStream(network, encoder, emotions=EmotionTrack.of(("joy",)))
    stream = RegressionStream(network, encoder)
    with pytest.raises(ShapeError, match="no samples"):
        stream.finish()
    stream = RegressionStream(network, encoder)
    with pytest.raises(ShapeError, match="NaN"):
        stream.push(np.array([np.nan], np.float32))
    stream.push(np.zeros(10, np.float32))
    assert len(stream.finish()) == 1
    with pytest.raises(OptionError, match="finished"):
        stream.push(np.zeros(10, np.float32))
