"""Pose tracks: made from prosody, and smoothed as rotations."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meshanim.errors import OptionError
from meshanim.motion import pose_from_prosody, prosodic_accents, smooth_rotations


def test_a_pulse_of_loudness_is_an_accent():
    steps = (np.arange(300) + 0.5) / 100
    level = 0.01 + 0.3 * np.exp(-0.5 * ((steps - 1.3) / 0.06) ** 2)
    times, strengths = prosodic_accents(level, None, 100.0)
    assert len(times) == 1
    assert times[0] == pytest.approx(1.3, abs=0.05)
    assert 0 < strengths[0] <= 1


@pytest.mark.parametrize("level", [np.zeros(0), np.zeros(200), np.full(200, 0.3)])
def test_flat_sound_has_no_accents(level):
    times, strengths = prosodic_accents(level, None, 100.0)
    assert len(times) == len(strengths) == 0


def test_accents_nod_the_head():
    steps = (np.arange(400) + 0.5) / 100
    level = 0.01 + 0.3 * np.exp(-0.5 * ((steps - 2.0) / 0.06) ** 2)
    still = pose_from_prosody(120, 30.0, seed=1)
    nodding = pose_from_prosody(120, 30.0, seed=1, loudness=level)
    difference = nodding[:, 0] - still[:, 0]
    assert np.argmax(difference) == pytest.approx(61, abs=4)
    assert 0.02 < difference.max() < 0.12
    assert np.abs(difference[:30]).max() < 2e-3


def test_the_same_track_at_every_rate_and_length():
    slow = pose_from_prosody(60, 30.0, seed=4)
    assert np.allclose(pose_from_prosody(180, 90.0, seed=4)[1::3], slow, atol=1e-6)
    assert np.allclose(pose_from_prosody(300, 30.0, seed=4)[:50], slow[:50], atol=1e-5)
    assert not np.allclose(pose_from_prosody(60, 30.0, seed=5), slow)


def test_statistics_of_a_long_track_are_human():
    track = np.degrees(pose_from_prosody(9000, 30.0, seed=0))
    assert np.all((track.std(0) > 0.5) & (track.std(0) < 6))
    assert np.abs(track).max() < 25
    assert np.abs(np.diff(track, axis=0)).max() * 30 < 60  # degrees a second


def test_smoothing_is_a_gaussian_filter_for_small_angles():
    impulse = np.zeros((31, 3))
    impulse[15, 1] = 1e-4
    weights = np.exp(-0.5 * np.arange(-7, 8) ** 2)
    smooth = smooth_rotations(impulse)
    assert np.allclose(smooth[8:23, 1], 1e-4 * weights / weights.sum(), atol=1e-10)
    assert np.abs(smooth[:8]).max() < 1e-9


def test_smoothing_commutes_with_a_rotation_and_passes_pi():
    generator = np.random.default_rng(0)
    track = np.cumsum(generator.normal(size=(50, 3)) * 0.02, axis=0)
    turn = Rotation.from_rotvec([0.0, np.pi, 0.0])
    turned = (turn * Rotation.from_rotvec(track)).as_rotvec()
    assert np.abs(np.diff(turned, axis=0)).max() > 5  # the axis-angle vectors jump at pi
    expected = turn * Rotation.from_rotvec(smooth_rotations(track))
    found = Rotation.from_rotvec(smooth_rotations(turned))
    assert (expected.inv() * found).magnitude().max() < 1e-9


def test_bad_options_are_named():
    with pytest.raises(OptionError, match="window"):
        smooth_rotations(np.zeros((4, 3)), window=4)
    with pytest.raises(OptionError, match="fps"):
        pose_from_prosody(4, 0.0)
    assert pose_from_prosody(0, 30.0).shape == (0, 3)
    assert smooth_rotations(np.zeros((0, 3))).shape == (0, 3)
