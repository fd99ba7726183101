import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from meshanim.errors import OptionError, ShapeError
from meshanim.motion.components import principal_components


def frames(rows=300, columns=60, seed=0):
    generator = np.random.default_rng(seed)
    scale = 0.9 ** np.arange(columns)
    return generator.normal(size=(rows, columns)) * scale @ np.linalg.qr(
        generator.normal(size=(columns, columns))
    )[0] + generator.normal(size=columns)


def blocks_of(data, size=37):
    return lambda: (data[k : k + size] for k in range(0, len(data), size))


def test_they_are_those_of_the_decomposition():
    data = frames()
    found = principal_components(blocks_of(data), 10, passes=8)
    centred = data - data.mean(0)
    _, singular, right = np.linalg.svd(centred, full_matrices=False)
    np.testing.assert_allclose(found.mean, data.mean(0), atol=1e-12)
    np.testing.assert_allclose(np.abs(np.sum(found.components * right[:10], axis=1)), 1, atol=1e-6)
    np.testing.assert_allclose(found.deviation, singular[:10] / len(data) ** 0.5, rtol=1e-6)
    assert found.explained == pytest.approx(np.sum(singular[:10] ** 2) / np.sum(singular**2), rel=1e-6)
    np.testing.assert_allclose(found.components @ found.components.T, np.eye(10), atol=1e-10)


def test_the_share_of_variance_stops_them():
    data = frames()
    singular = np.linalg.svd(data - data.mean(0), compute_uv=False)
    share = np.cumsum(singular**2) / np.sum(singular**2)
    found = principal_components(blocks_of(data), 50, variance=0.9)
    assert len(found.components) == int(np.searchsorted(share, 0.9)) + 1
    assert found.explained >= 0.9


@settings(max_examples=15, deadline=None)
@given(st.integers(1, 12), st.integers(2, 9), st.integers(1, 40))
def test_blocks_do_not_matter_and_few_frames_are_rebuilt(rank, rows, size):
    data = frames(rows, 30, seed=rank)
    found = principal_components(blocks_of(data, size), 20)
    assert len(found.components) <= min(20, rows - 1)
    coefficients = (data - found.mean) @ found.components.T
    np.testing.assert_allclose(coefficients @ found.components + found.mean, data, atol=1e-6)
    again = principal_components(blocks_of(data, 1000), 20)
    np.testing.assert_allclose(found.deviation, again.deviation, rtol=1e-8)


def test_what_does_not_move_has_none():
    found = principal_components(blocks_of(np.full((20, 6), 0.25)), 3)
    assert found.components.shape == (0, 6)
    assert found.explained == 1


def test_bad_input_is_named():
    with pytest.raises(OptionError, match="out of range"):
        principal_components(blocks_of(frames()), 0)
    with pytest.raises(ShapeError, match="no motion"):
        principal_components(lambda: iter(()), 3)
    broken = frames()
    broken[40, 3] = np.nan
    with pytest.raises(ShapeError, match="NaN"):
        principal_components(blocks_of(broken), 3)
