import pytest
import torch
from conftest_gava import awake, small_config, sphere

from meshanim.audio import feature_windows
from meshanim.errors import OptionError, ShapeError
from meshanim.models.gava import Gava
from meshanim.models.gava_stream import GavaStream, PoseSmoothing, animate
from meshanim.motion.lip_seal import LipSeal


def speech(model, seconds, seed=0):
    generator = torch.Generator().manual_seed(seed)
    config = model.config
    features = torch.rand(round(seconds * config.feature_rate), config.feature_dim, generator=generator)
    mel = torch.randn(round(seconds * config.mel_rate), config.mel_bands, generator=generator) - 8
    return features, mel


def whole(model, features, mel, frames, fps):
    """All frames at once, unfiltered, straight from the definition."""
    config = model.config
    window = feature_windows(features, config.feature_rate, fps, frames, config.window)
    mels = feature_windows(mel, config.mel_rate, fps, frames, config.mel_frames)
    embedding = model.embed(model.surface.template[None])
    with torch.no_grad():
        return model(window, mels, embedding, model.style_of().expand(frames, -1))


@pytest.mark.parametrize("fps", [24.0, 30.0, 59.94])
def test_offline_is_the_definition(model, fps):
    features, mel = speech(model, 2.0)
    frames = round(2.0 * fps)
    stream = GavaStream(model, fps=fps, smoothing=PoseSmoothing(0), chunk=7)
    parts = list(animate(stream, features, mel, frames))
    expected = whole(model, features, mel, frames, fps)
    vertices = model.surface.template + expected.displacements
    torch.testing.assert_close(torch.cat([p.vertices for p in parts]), vertices, atol=1e-6, rtol=0)
    torch.testing.assert_close(torch.cat([p.pose for p in parts]), expected.pose, atol=1e-5, rtol=0)


def seal_of(model):
    closing = torch.zeros(model.n_vertices, 3)
    closing[0, 1] = -1.0
    return LipSeal(torch.tensor([[0, 1]]), closing, largest=10.0)


@pytest.mark.parametrize("blocks", [[1], [3, 11, 2], [1000]])
def test_streamed_frames_are_the_offline_frames(model, blocks):
    features, mel = speech(model, 1.5)
    options = {"seal": seal_of(model), "bilabial": 2, "fps": 30.0}
    offline = list(animate(GavaStream(model, **options), features, mel, 45))
    stream, parts, at, k = GavaStream(model, **options), [], 0, 0
    while at < len(features):
        count = blocks[k % len(blocks)]
        # Mel frames come twice as fast, and late by one block of features.
        parts.append(stream.push(features[at : at + count], mel[2 * at : 2 * (at + count)]))
        at, k = at + count, k + 1
    parts.append(stream.finish(45))
    for found, expected in zip(zip(*parts), zip(*offline)):
        assert torch.cat(found).shape == torch.cat(expected).shape
        torch.testing.assert_close(torch.cat(found), torch.cat(expected), atol=1e-6, rtol=0)


def test_look_ahead_is_bounded(model):
    stream = GavaStream(model, fps=30.0, seal=seal_of(model), bilabial=2)
    features, mel = speech(model, 3.0)
    given = sum(len(stream.push(features[k : k + 1], mel[2 * k : 2 * k + 2]).pose) for k in range(150))
    # Half a window of features, then the pose filter and the seal.
    assert given >= 90 - stream.look_ahead - 1 - 30 * 8.5 / 50
    assert stream.look_ahead <= 5


def test_memory_does_not_grow(model):
    stream = GavaStream(model, fps=30.0)
    sizes = []
    for _ in range(6):
        stream.push(*speech(model, 2.0))
        kept = [entry.kept for entry in stream.inputs] + stream.waiting + stream.poses
        sizes.append(sum(tensor.numel() for tensor in kept))
    assert max(sizes[1:]) <= sizes[1] * 1.2


def test_the_pose_filter_keeps_a_constant_and_smooths():
    model = awake(Gava(small_config(), sphere(1)))
    features, mel = speech(model, 2.0)
    raw = torch.cat(
        [p.pose for p in animate(GavaStream(model, smoothing=PoseSmoothing(0)), features, mel, 60)]
    )
    smooth = torch.cat([p.pose for p in animate(GavaStream(model), features, mel, 60)])
    assert smooth.diff(dim=0).norm() < 0.7 * raw.diff(dim=0).norm()
    still = list(animate(GavaStream(model), features * 0, mel * 0, 60))
    poses = torch.cat([p.pose for p in still])
    torch.testing.assert_close(poses, poses[:1].expand_as(poses), atol=1e-6, rtol=0)


def test_short_speech_and_no_speech(model):
    features, mel = speech(model, 0.05)
    parts = list(animate(GavaStream(model), features, mel, 2))
    assert sum(len(p.pose) for p in parts) == 2
    with pytest.raises(ShapeError, match="audio is empty"):
        GavaStream(model).finish()
    with pytest.raises(ShapeError, match="width 3"):
        GavaStream(model).push(features[:, :3], mel)
    with pytest.raises(ShapeError, match="mel"):
        GavaStream(model).push(features)
    with pytest.raises(OptionError, match="fps"):
        GavaStream(model, fps=0)
    with pytest.raises(OptionError, match="bilabial"):
        GavaStream(model, seal=seal_of(model))
    stream = GavaStream(model)
    stream.push(features, mel)
    stream.finish()
    with pytest.raises(OptionError, match="finished"):
        stream.push(features, mel)
