import numpy as np
import pytest

from meshanim.render.look import noise
from meshanim.render.rasterizer import native_available


def points(count, seed=0):
    return np.random.default_rng(seed).uniform(-300, 300, (count, 3)).astype(np.float32)


@pytest.mark.skipif(not native_available(), reason="the extension is not built")
def test_the_kernel_agrees_with_scipy(monkeypatch):
    at = points(4000)
    fast = noise.value_noise(at, 5.3, 3, 3, (1.0, 0.1, 0.2))
    monkeypatch.setattr(noise, "native_available", lambda: False)
    assert np.allclose(fast, noise.value_noise(at, 5.3, 3, 3, (1.0, 0.1, 0.2)), atol=2e-5)


def test_noise_is_centred_scaled_and_periodic():
    at = points(60000)
    values = noise.value_noise(at, 2.0, 1)
    assert abs(values.mean()) < 0.02
    assert 0.1 < values.std() < 0.4
    again = noise.value_noise(at + np.float32(128), 2.0, 1)  # 64 cells of 2
    assert np.allclose(values, again, atol=1e-3)


def test_noise_is_continuous_and_seeds_differ():
    at = points(2000)
    step = np.abs(noise.value_noise(at + np.float32(1e-3), 2.0, 1) - noise.value_noise(at, 2.0, 1))
    assert step.max() < 0.01
    other = noise.value_noise(at, 2.0, 2)
    assert abs(np.corrcoef(noise.value_noise(at, 2.0, 1), other)[0, 1]) < 0.1
