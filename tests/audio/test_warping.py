import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from meshanim.audio import Phoneme, Waveform
from meshanim.audio.warping import dynamic_time_warping, matching_times
from meshanim.errors import ShapeError


def plain(cost, penalty):
    """Least cost by the recursion of Sakoe and Chiba, cell by cell."""
    rows, columns = cost.shape
    total = np.full((rows, columns), np.inf)
    for i in range(rows):
        for j in range(columns):
            before = [0.0] if i == j == 0 else []
            if i and j:
                before.append(total[i - 1, j - 1])
            if i:
                before.append(total[i - 1, j] + penalty)
            if j:
                before.append(total[i, j - 1] + penalty)
            total[i, j] = min(before) + cost[i, j]
    return total[-1, -1]


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 9), st.integers(1, 9), st.floats(0, 1), st.integers(0, 1000))
def test_the_path_is_the_cheapest(rows, columns, penalty, seed):
    cost = np.random.default_rng(seed).uniform(size=(rows, columns))
    path = dynamic_time_warping(cost, penalty)
    steps = np.diff(path, axis=0)
    assert tuple(path[0]) == (0, 0)
    assert tuple(path[-1]) == (rows - 1, columns - 1)
    assert ((steps >= 0) & (steps <= 1)).all()
    assert (steps.sum(1) > 0).all()
    paid = cost[tuple(path.T)].sum() + penalty * (steps.sum(1) == 1).sum()
    assert paid == pytest.approx(plain(cost, penalty))


def spoken(durations, seed=0):
    """Noise of another colour for every phoneme."""
    names = ["SIL", "M", "AA", "P", "IY", "S", "UW", "SIL"]
    generator = np.random.default_rng(seed)
    parts, phonemes, at = [], [], 0.0
    for k, (name, duration) in enumerate(zip(names, durations)):
        time = np.arange(int(duration * 16000)) / 16000
        tone = np.sin(2 * np.pi * (200 + 300 * k) * time)
        parts.append((0.0 if name == "SIL" else 0.3) * (tone + 0.1 * generator.normal(size=len(time))))
        phonemes.append(Phoneme(at, at + duration, name))
        at += duration
    return Waveform(np.concatenate(parts).astype(np.float32), 16000), phonemes


def test_phonemes_meet_their_own():
    one, first = spoken([0.2, 0.1, 0.3, 0.1, 0.2, 0.2, 0.3, 0.1])
    other, second = spoken([0.5, 0.2, 0.2, 0.14, 0.4, 0.1, 0.2, 0.02], seed=3)
    middles = np.array([(p.start + p.end) / 2 for p in second])
    found = matching_times(one, first, other, second, middles)
    for time, phoneme in zip(found[1:-1], first[1:-1]):
        assert phoneme.start - 0.02 <= time <= phoneme.end + 0.02
    times = np.linspace(0, other.duration, 200)
    assert (np.diff(matching_times(one, first, other, second, times)) >= 0).all()


def test_a_performance_matches_itself():
    one, phonemes = spoken([0.2, 0.1, 0.3, 0.1, 0.2, 0.2, 0.3, 0.1])
    times = np.linspace(0.1, one.duration - 0.1, 50)
    np.testing.assert_allclose(matching_times(one, phonemes, one, phonemes, times), times, atol=0.011)


def test_bad_input_is_named():
    with pytest.raises(ShapeError, match="finite"):
        dynamic_time_warping(np.array([[np.nan]]))
    with pytest.raises(ShapeError, match="finite"):
        dynamic_time_warping(np.zeros((0, 3)))
    one, phonemes = spoken([0.2] * 8)
    with pytest.raises(ShapeError, match="phonemes"):
        matching_times(one, phonemes, one, [], np.zeros(1))
