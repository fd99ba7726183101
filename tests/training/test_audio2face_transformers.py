"""The papers' encoders, from small random checkpoints: wav2vec 2.0 with regression, HuBERT with diffusion."""

import numpy as np
import pytest
import torch
from states_small import write_states

from meshanim.audio import load_encoder
from meshanim.datasets.animation_states import AnimationStates
from meshanim.models.audio2face import (
    Audio2FaceDiffusion,
    Audio2FaceRegression,
    DiffusionStream,
    RegressionStream,
    animate_diffusion,
    animate_regression,
)
from meshanim.training.audio2face_diffusion import TrainDiffusionOptions, train_diffusion
from meshanim.training.audio2face_regression import TrainRegressionOptions, train_regression
from meshanim.training.trainer import TrainConfig

transformers = pytest.importorskip("transformers")
SIZES = {
    "hidden_size": 16,
    "num_hidden_layers": 4,
    "num_attention_heads": 2,
    "intermediate_size": 24,
    "conv_dim": [8] * 7,
    "num_conv_pos_embeddings": 16,
    "num_conv_pos_embedding_groups": 4,
}
TRAIN = TrainConfig(steps=2, learning_rate=1e-3, log_every=1000, save_every=1000)


@pytest.fixture(scope="module")
def states(tmp_path_factory):
    return write_states(tmp_path_factory.mktemp("states"), sentences=2)


def checkpoint(kind, folder):
    torch.manual_seed(0)
    config, model = {
        "wav2vec2": ("Wav2Vec2Config", "Wav2Vec2Model"),
        "hubert": ("HubertConfig", "HubertModel"),
    }[kind]
    getattr(transformers, model)(getattr(transformers, config)(**SIZES)).save_pretrained(folder)
    return folder


def test_regression_hears_windows_through_the_fourth_layer(states, tmp_path):
    name = f"wav2vec2:{checkpoint('wav2vec2', tmp_path / 'w')}@4"
    options = TrainRegressionOptions(
        states, tmp_path / "run", encoder=name, epochs=0, batch_pairs=4, train=TRAIN, cpu=True
    )
    network = Audio2FaceRegression.from_pretrained(train_regression(options, progress=False))
    assert (network.config.hearing, network.config.feature_dim) == ("window", 16)
    encoder, waveform = load_encoder(name), AnimationStates(states).audio("anna_sentence01")
    whole = animate_regression(network, encoder, waveform)
    stream = RegressionStream(network, encoder)
    parts = [stream.push(block) for block in np.array_split(waveform.samples, 9)]
    found = torch.cat([*parts, stream.finish()])
    assert sum(map(len, parts)) > 30
    torch.testing.assert_close(found, whole, atol=1e-6, rtol=0)


def test_diffusion_hears_a_second_at_a_time(states, tmp_path):
    name = f"hubert:{checkpoint('hubert', tmp_path / 'h')}"
    options = TrainDiffusionOptions(
        states, tmp_path / "run", encoder=name, epochs=0, width=16, train=TRAIN, cpu=True
    )
    network = Audio2FaceDiffusion.from_pretrained(train_diffusion(options, progress=False))
    encoder, waveform = load_encoder(name), AnimationStates(states).audio("anna_sentence01")
    stream = DiffusionStream(network, encoder)
    assert stream.reader.mode == "window"
    parts = [stream.push(block) for block in np.array_split(waveform.samples, 9)]
    found = torch.cat([*parts, stream.finish()])
    assert sum(map(len, parts)) == 30
    same = animate_diffusion(network, encoder, waveform, hear="window")
    motion = (same - network.mean).abs().mean()
    assert (found - same).abs().mean() < 0.03 * motion
    whole = animate_diffusion(network, encoder, waveform)
    assert whole.shape == found.shape
