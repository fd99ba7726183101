import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from meshanim.errors import OptionError
from meshanim.motion.idle import GAZE_RANGE, IdleMotion, gaze_weights, lid_closure, saccade


def times(start, end, fps=30.0):
    return (np.arange(round(start * fps), round(end * fps)) + 0.5) / fps


def test_a_blink_shuts_the_lids_for_a_frame_and_opens_them_again():
    for fps in (24, 25, 30, 60):
        for phase in np.linspace(0, 1, 7):
            closure = lid_closure((np.arange(-fps, fps) + phase) / fps)
            assert closure.max() > 0.999
            assert closure[0] == closure[-1] == 0


@pytest.mark.parametrize("degrees", [1, 5, 15])
def test_a_saccade_lasts_as_long_as_carpenter_measured(degrees):
    duration = 0.021 + 0.0022 * degrees
    assert saccade(np.array([0.0, duration]), np.radians(degrees)).tolist() == [0, pytest.approx(1)]
    assert saccade(np.array([duration * 0.9]), np.radians(degrees)) < 1


def test_gaze_weights_turn_both_eyes_the_same_way():
    weights = gaze_weights(np.array([0.1]), np.array([0.2]))  # down, to the subject's left
    assert weights["eyeLookOutLeft"] == weights["eyeLookInRight"] == pytest.approx(0.2 / GAZE_RANGE[1])
    assert weights["eyeLookInLeft"] == weights["eyeLookUpLeft"] == 0
    assert weights["eyeLookDownRight"] == pytest.approx(0.1 / GAZE_RANGE[0])


def test_blinks_come_at_the_asked_rate_and_never_without_pause():
    at = times(0, 600)
    lids = IdleMotion(seed=3, blinks=0.3, gaze=0).weights(at, np.zeros((len(at), 3)))["eyeBlinkLeft"]
    starts = np.flatnonzero((lids[1:] > 0.5) & (lids[:-1] <= 0.5))
    assert len(starts) / 600 == pytest.approx(0.3, rel=0.2)
    assert np.diff(starts).min() >= 0.6 * 30 - 1
    still = IdleMotion(blinks=0, gaze=0, sway=0)
    assert not any(weight.any() for weight in still.weights(at, np.zeros((len(at), 3))).values())
    assert not still.pose(at).any()


@settings(max_examples=25, deadline=None)
@given(cuts=st.lists(st.integers(1, 299), max_size=8), seed=st.integers(0, 50))
def test_pieces_of_time_give_the_same_motion_as_the_whole(cuts, seed):
    at = times(0, 10)
    whole = IdleMotion(seed)
    expected_pose = whole.pose(at)
    expected = whole.weights(at, expected_pose)
    parts = IdleMotion(seed)
    for piece in np.split(np.arange(len(at)), sorted(set(cuts))):
        pose = parts.pose(at[piece])
        np.testing.assert_array_equal(pose, expected_pose[piece])
        for name, weight in parts.weights(at[piece], pose).items():
            np.testing.assert_allclose(weight, expected[name][piece], atol=1e-12)


def test_sway_is_slow_small_and_centred():
    at = times(0, 300)
    pose = IdleMotion(seed=1).pose(at)
    assert np.abs(pose.mean(0)).max() < 0.005
    assert np.degrees(np.abs(pose).max()) < 8
    speed = np.degrees(np.linalg.norm(np.diff(pose, axis=0), axis=1) * 30)
    assert speed.max() < 15  # degrees a second
    assert pose.std(0) == pytest.approx(np.array([0.013, 0.024, 0.013]), rel=0.15)


def test_eyes_hold_their_gaze_while_the_head_turns():
    at = times(0, 5)
    turn = np.stack([0 * at, 0.1 * np.sin(at), 0 * at], 1)
    still = IdleMotion(seed=2, blinks=0, gaze=0)
    weights = still.weights(at, turn)
    yaw = (weights["eyeLookOutLeft"] - weights["eyeLookInLeft"]) * GAZE_RANGE[1]
    np.testing.assert_allclose(yaw, -0.85 * turn[:, 1], atol=1e-9)


def test_negative_gains_are_refused():
    with pytest.raises(OptionError, match="negative"):
        IdleMotion(sway=-1)
