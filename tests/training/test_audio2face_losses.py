"""Every loss against a plain loop over its equation, in float64."""

import numpy as np
import pytest
import torch
from audio2face_small import small_actors

from meshanim.training import audio2face_losses as losses

PAIRS, WIDTH, STEPS, PHONEMES = 6, 11, 7, 5


def random(*shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def close(found, expected):
    assert found.dtype == torch.float64
    torch.testing.assert_close(found, torch.tensor(expected, dtype=torch.float64), rtol=1e-12, atol=1e-12)


def test_state_and_motion():
    x, y = random(PAIRS, 2, WIDTH), random(PAIRS, 2, WIDTH, seed=1)
    total = sum(
        float((x[b, n, d] - y[b, n, d]) ** 2) for b in range(PAIRS) for n in range(2) for d in range(WIDTH)
    )
    close(losses.state_loss(x, y), total / (PAIRS * 2 * WIDTH))
    total = 0.0
    for b in range(PAIRS):
        for d in range(WIDTH):
            total += float((x[b, 1, d] - x[b, 0, d]) - (y[b, 1, d] - y[b, 0, d])) ** 2
    close(losses.motion_loss(x, y), total / (PAIRS * WIDTH))


def test_phonemes():
    logits = random(PAIRS, 2, STEPS, PHONEMES)
    labels = torch.from_numpy(np.random.default_rng(0).integers(-1, PHONEMES, (PAIRS, 2, STEPS)))
    p = torch.softmax(logits, -1)
    values = [
        -float(torch.log(p[b, n, s, labels[b, n, s]]))
        for b in range(PAIRS)
        for n in range(2)
        for s in range(STEPS)
        if labels[b, n, s] >= 0
    ]
    close(losses.phoneme_loss(logits, labels), float(np.mean(values)))
    values = []
    for b in range(PAIRS):
        for s in range(STEPS):
            if (labels[b, :, s] >= 0).all():
                truth = np.eye(PHONEMES)[labels[b, 1, s]] - np.eye(PHONEMES)[labels[b, 0, s]]
                values.append(float(np.sum((p[b, 1, s].numpy() - p[b, 0, s].numpy() - truth) ** 2)))
    close(losses.phoneme_motion_loss(logits, labels), float(np.mean(values)))
    nothing = torch.full_like(labels, -1)
    close(losses.phoneme_loss(logits, nothing), 0.0)
    close(losses.phoneme_motion_loss(logits, nothing), 0.0)


def test_volume_stability():
    x, volume = random(PAIRS, 2, WIDTH), random(PAIRS).abs()
    values = [
        np.exp(-3.0 * float(volume[b])) * float(((x[b, 1] - x[b, 0]) ** 2).sum()) / WIDTH
        for b in range(PAIRS)
    ]
    close(losses.volume_stability_loss(x, volume, 3.0), float(np.mean(values)))


def test_implicit_emotion():
    e = random(PAIRS, 2, 16)
    values = [float(((e[b, 1] - e[b, 0]) ** 2).sum() / (e[b, 0] ** 2).sum()) for b in range(PAIRS)]
    close(losses.implicit_emotion_loss(e), float(np.mean(values)))
    still = e[:, :1].repeat(1, 2, 1)
    close(losses.implicit_emotion_loss(still), 0.0)


def test_lips():
    d, t = random(PAIRS, 5), random(PAIRS, 5, seed=1)
    total = 0.0
    for b in range(PAIRS):
        for i in range(5):
            total += np.exp(-2.0 * max(float(t[b, i]), 0)) * float(d[b, i] - t[b, i]) ** 2
    close(losses.lip_distance_loss(d, t, 2.0), total / PAIRS)
    h, g = random(PAIRS, 2, 5), random(PAIRS, 2, 5, seed=1)
    total = sum(
        float((h[b, k, i] - g[b, k, i]) ** 2) for b in range(PAIRS) for k in range(2) for i in range(5)
    )
    close(losses.lip_size_loss(h, g), total / PAIRS)


def test_smoothness_and_acceleration():
    x = random(2, 9, 12)
    for loss, weights in (
        (losses.smoothness_loss, (-1, 1)),
        (losses.acceleration_loss, (1, -2, 1)),
    ):
        for row, found in zip(x, loss(x)):
            each = [
                float((sum(w * row[n + k] for k, w in enumerate(weights)) ** 2).mean())
                for n in range(10 - len(weights))
            ]
            close(found, float(np.mean(each)))


@pytest.mark.parametrize(
    "name", ["state", "motion", "volume", "emotion", "distance", "size", "phoneme", "change"]
)
def test_gradients(name):
    x, y = random(3, 2, 4).requires_grad_(), random(3, 2, 4, seed=1)
    labels = torch.tensor([[[0, 3], [1, 3]], [[2, -1], [2, 0]], [[0, 1], [1, 0]]])
    functions = {
        "state": lambda v: losses.state_loss(v, y),
        "motion": lambda v: losses.motion_loss(v, y),
        "volume": lambda v: losses.volume_stability_loss(v, torch.tensor([0.1, 0.9, 0.4]).double(), 2.0),
        "emotion": losses.implicit_emotion_loss,
        "distance": lambda v: losses.lip_distance_loss(v, y, 10.0),
        "size": lambda v: losses.lip_size_loss(v, y),
        "phoneme": lambda v: losses.phoneme_loss(v[:, :, None].expand(3, 2, 2, 4), labels),
        "change": lambda v: losses.phoneme_motion_loss(v[:, :, None].expand(3, 2, 2, 4), labels),
    }
    assert torch.autograd.gradcheck(functions[name], (x,))


def test_lips_are_read_off_the_face():
    actors = small_actors(names=("anna", "ben"))
    basis, reader = actors.basis, losses.LipReader(actors)
    states = 1e-3 * torch.randn(4, 169, generator=torch.Generator().manual_seed(3))
    subject = torch.tensor([0, 1, 1, 0])
    opening, size = reader.of_states(states, subject)
    for row, (state, k) in enumerate(zip(states, subject.tolist())):
        template = actors.templates[("anna", "ben")[k]]
        face = basis.vertices(state[None], template)[0] * 100
        for i, (upper, lower) in enumerate(basis.parts.lip_pairs):
            assert opening[row, i].item() == pytest.approx((face[upper, 1] - face[lower, 1]).item(), abs=1e-4)
        for lip, pairs in enumerate((basis.parts.upper_lip, basis.parts.lower_lip)):
            for i, (top, bottom) in enumerate(pairs):
                expected = torch.linalg.vector_norm(face[top] - face[bottom]).item()
                assert size[row, lip, i].item() == pytest.approx(expected, abs=1e-4)
    again = reader.of_skin(basis.decode(states).skin, subject)
    torch.testing.assert_close(again[0], opening, atol=1e-4, rtol=0)
    torch.testing.assert_close(again[1], size, atol=1e-4, rtol=0)


def test_units():
    basis = small_actors().basis
    units = losses.state_units(basis)
    assert units[0].item() == pytest.approx(100 * (61520 / 60) ** 0.5)
    assert units[140].item() == 100
    assert units[-1].item() == pytest.approx(1.2)


def test_presets_are_the_published_ones():
    james, claire, mark = (losses.PRESETS[name] for name in ("james", "claire", "mark"))
    assert (james.state, james.motion, james.phoneme, james.phoneme_motion) == (1, 10, 0.1, 0.1)
    assert (james.volume, james.emotion, james.lip_distance, james.lip_size) == (100, 1, 50, 0.01)
    assert (claire.state, claire.phoneme, claire.lip_distance, claire.lip_size) == (1.5, 0.2, 100, 0)
    assert (mark.state, mark.phoneme, mark.phoneme_motion, mark.lip_distance) == (1, 1, 0, 500)
