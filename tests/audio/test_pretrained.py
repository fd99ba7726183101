"""wav2vec 2.0 and HuBERT from small random checkpoints written here; nothing is downloaded."""

import numpy as np
import pytest
import torch

from meshanim.audio import Waveform, load_encoder
from meshanim.audio.pretrained import TransformerEncoder
from meshanim.errors import FileFormatError, OptionError

transformers = pytest.importorskip("transformers")
SIZES = {
    "hidden_size": 32,
    "num_hidden_layers": 2,
    "num_attention_heads": 4,
    "intermediate_size": 48,
    "conv_dim": [16] * 7,
    "num_conv_pos_embeddings": 16,
    "num_conv_pos_embedding_groups": 4,
}
CLASSES = {"wav2vec2": ("Wav2Vec2Config", "Wav2Vec2Model"), "hubert": ("HubertConfig", "HubertModel")}


@pytest.fixture(scope="module", params=["wav2vec2", "hubert"])
def checkpoint(request, tmp_path_factory):
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp(request.param)
    config, model = (getattr(transformers, name) for name in CLASSES[request.param])
    net = model(config(**SIZES))
    net.save_pretrained(folder)
    return request.param, folder, net.eval()


@pytest.fixture(autouse=True)
def offline(monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")


def noise(samples):
    return Waveform(np.random.default_rng(0).normal(0, 0.1, samples), 16000)


def test_states_are_interpolated_to_their_times(checkpoint):
    kind, folder, net = checkpoint
    waveform = noise(8000)
    encoder = load_encoder(f"{kind}:{folder}")
    assert encoder.dim == 32
    samples = torch.from_numpy(waveform.samples)
    samples = (samples - samples.mean()) / torch.sqrt(samples.var(unbiased=False) + 1e-7)
    with torch.inference_mode():
        states = net(samples[None]).last_hidden_state[0].numpy()
    times = (np.arange(25) + 0.5) / 50
    centres = (np.arange(len(states)) * 320 + 200) / 16000
    expected = np.stack([np.interp(times, centres, channel) for channel in states.T], axis=1)
    np.testing.assert_allclose(encoder(waveform).numpy(), expected, atol=1e-5)
    assert not any(p.requires_grad for p in encoder.model.parameters())


def test_any_layer_and_rate(checkpoint):
    kind, folder, _ = checkpoint
    waveform = noise(6400)
    layers = [load_encoder(f"{kind}:{folder}@{layer}")(waveform) for layer in (0, 1, 2, -1)]
    torch.testing.assert_close(layers[2], layers[3])
    assert not torch.allclose(layers[0], layers[1])
    assert TransformerEncoder(kind, str(folder), rate=60.0)(waveform).shape == (24, 32)
    with pytest.raises(OptionError, match="layer"):
        TransformerEncoder(kind, str(folder), layer=3)
    with pytest.raises(OptionError, match="LAYER"):
        load_encoder(f"{kind}:{folder}@last")


def test_long_speech_runs_in_windows_of_all_its_frames(checkpoint):
    kind, folder, _ = checkpoint
    waveform = noise(16000 * 7 + 123)
    whole = TransformerEncoder(kind, str(folder), layer=0)
    parts = TransformerEncoder(kind, str(folder), layer=0, chunk=2.0)
    expected, found = whole(waveform), parts(waveform)
    assert expected.shape == found.shape == (351, 32)
    similarity = torch.nn.functional.cosine_similarity(expected, found, dim=1)
    assert similarity.mean() > 0.95
    shifted = torch.nn.functional.cosine_similarity(expected[1:], found[:-1], dim=1)
    assert similarity.mean() > shifted.mean()


@pytest.mark.parametrize("samples", [1, 399, 800])
def test_speech_of_milliseconds(checkpoint, samples):
    kind, folder, _ = checkpoint
    assert TransformerEncoder(kind, str(folder))(noise(samples)).shape == (-(-samples // 320), 32)


def test_checkpoints_that_are_none(checkpoint, tmp_path):
    kind, folder, _ = checkpoint
    with pytest.raises(FileFormatError) as caught:
        load_encoder(f"{kind}:{tmp_path}")
    assert "\n" not in str(caught.value)
    other = {"wav2vec2": "hubert", "hubert": "wav2vec2"}[kind]
    with pytest.raises(OptionError, match=f"{kind}:"):
        load_encoder(f"{other}:{folder}")
    with pytest.raises(OptionError, match="whole utterance"):
        load_encoder(f"{kind}:{folder}").stream()
    with pytest.raises(OptionError):
        TransformerEncoder("whisper", str(folder))
    with pytest.raises(OptionError):
        TransformerEncoder(kind, str(folder), rate=0.0)
