import numpy as np
import pytest
import torch
from audio2face_small import small_actors

from meshanim.errors import FileFormatError, OptionError, ShapeError
from meshanim.models.syncnet import (
    MOMENT,
    RATE,
    SyncConfig,
    SyncNet,
    mouth_landmarks,
    mouth_moments,
    speech_moments,
)
from meshanim.motion.face_parts import FaceParts

CONFIG = SyncConfig(feature_dim=4, feature_rate=50.0, encoder="mel", landmarks=(3, 1, 2), width=16)


def mouth_and_neutral(frames=60, seed=0):
    generator = torch.Generator().manual_seed(seed)
    neutral = torch.randn(3, 3, generator=generator)
    return neutral + 0.1 * torch.randn(frames, 3, 3, generator=generator), neutral


def test_moments_of_lips_are_their_motion_at_25_a_second():
    mouth, neutral = mouth_and_neutral()
    times = torch.tensor([0.4, 1.01], dtype=torch.float64)
    found = mouth_moments(mouth, neutral, 30.0, times)
    width = max(float((a - b).norm()) for a in neutral for b in neutral)
    assert found.shape == (2, MOMENT, 9)
    for row, time in zip(found, times.tolist()):
        for k, values in enumerate(row):
            at = (time + (k - 2) / RATE) * 30 - 0.5
            below = int(np.floor(at))
            share = at - below
            moved = (1 - share) * mouth[below] + share * mouth[below + 1] - neutral
            torch.testing.assert_close(values, (moved / width).flatten(), rtol=1e-5, atol=1e-6)


def test_moments_of_lips_know_neither_the_size_of_a_face_nor_its_frame_rate():
    neutral = mouth_and_neutral()[1]
    direction = torch.randn(3, 3, generator=torch.Generator().manual_seed(1))

    def glide(fps, scale):
        time = (torch.arange(int(2 * fps)) + 0.5) / fps
        return scale * (neutral + time[:, None, None] * direction)

    times = torch.linspace(0.3, 1.7, 9, dtype=torch.float64)
    one = mouth_moments(glide(30.0, 1.0), neutral, 30.0, times)
    other = mouth_moments(glide(60.0, 0.01), 0.01 * neutral, 60.0, times)
    torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)


def test_moments_of_speech_are_the_steps_around_them():
    features = torch.arange(40, dtype=torch.float32)[:, None].expand(40, 4)
    found = speech_moments(features, CONFIG, torch.tensor([0.4], dtype=torch.float64))
    assert CONFIG.steps == 10
    # Step k is at (k + 0.5) / 50: 0.4 s lies between steps 19 and 20.
    torch.testing.assert_close(found[0, :, 0], torch.arange(15.0, 25.0))


def test_landmarks_are_the_margins_and_borders_of_both_lips():
    parts = small_actors().basis.parts
    assert mouth_landmarks(parts) == (*range(5), *range(5, 10), *range(10, 15), *range(15, 20))
    with pytest.raises(OptionError, match="no known lips"):
        mouth_landmarks(FaceParts.from_arrays({"skin": np.arange(4)}))


def test_vectors_are_unit_and_likeness_is_their_cosine():
    torch.manual_seed(0)
    network = SyncNet(CONFIG).eval()
    moments, features = torch.randn(3, MOMENT, 9), torch.randn(5, 10, 4)
    seen, heard = network.see(moments), network.hear(features)
    torch.testing.assert_close(seen.norm(dim=1), torch.ones(3))
    torch.testing.assert_close(heard.norm(dim=1), torch.ones(5))
    expected = torch.exp(network.log_sharpness) * torch.einsum("ik,jk->ij", seen, heard)
    torch.testing.assert_close(network(moments, features), expected)


def test_distances_compare_lips_with_what_was_said_before():
    torch.manual_seed(0)
    network = SyncNet(CONFIG).eval()
    mouth, neutral = mouth_and_neutral(60)
    features = torch.randn(100, 4)
    curve = network.distances(mouth, neutral, 30.0, features, reach=4)
    times = (torch.arange(50, dtype=torch.float64) + 0.5) / RATE
    seen = network.see(mouth_moments(mouth, neutral, 30.0, times))
    heard = network.hear(speech_moments(features, CONFIG, times))
    for k, value in zip(range(-4, 5), curve):
        pairs = [(seen[i] - heard[i - k]).norm() for i in range(50) if 0 <= i - k < 50]
        torch.testing.assert_close(value, torch.stack(pairs).mean(), rtol=1e-4, atol=1e-5)
    score = network.score(mouth, neutral, 30.0, features, reach=4)
    assert score.distance == pytest.approx(float(curve[4]))
    assert score.confidence == pytest.approx(float(curve.median() - curve.min()))
    assert score.offset == pytest.approx((int(curve.argmin()) - 4) / RATE)


def test_it_is_saved_and_loaded(tmp_path):
    torch.manual_seed(0)
    network = SyncNet(CONFIG).eval()
    network.mouth_mean.normal_()
    network.save_pretrained(tmp_path)
    loaded = SyncNet.from_pretrained(tmp_path)
    assert loaded.config == CONFIG
    moments, features = torch.randn(3, MOMENT, 9), torch.randn(3, 10, 4)
    assert torch.equal(loaded(moments, features), network(moments, features))
    weights = tmp_path / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-100])
    with pytest.raises(FileFormatError, match="no checkpoint of SyncNet"):
        SyncNet.from_pretrained(tmp_path)


def test_what_does_not_fit_is_named():
    network = SyncNet(CONFIG).eval()
    mouth, neutral = mouth_and_neutral(60)
    features = torch.zeros(100, 4)
    with pytest.raises(ShapeError, match=r"expected \(T, 3, 3\)"):
        network.score(mouth[:, :2], neutral[:2], 30.0, features)
    with pytest.raises(ShapeError, match=r"expected \(steps, 4\)"):
        network.score(mouth, neutral, 30.0, features[:, :3])
    with pytest.raises(ShapeError, match="too short"):
        network.score(mouth[:15], neutral, 30.0, features)
    mouth[3] = torch.nan
    with pytest.raises(ShapeError, match="NaN"):
        network.score(mouth, neutral, 30.0, features)
    with pytest.raises(OptionError, match="two landmarks"):
        SyncConfig(4, 50.0, "mel", (1,))
