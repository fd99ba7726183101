"""Each function against a value found by hand, and what it must not see (hypothesis)."""

import math

import numpy as np
import pytest
import roma
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from meshanim.errors import OptionError, ShapeError
from meshanim.training.metrics import (
    axis_dynamics_deviation,
    bilabial_closure,
    coverage_error,
    diversity,
    eye_vertex_error,
    frechet_distance,
    high_frequency_share,
    lip_aperture,
    lip_vertex_error,
    mean_estimate_error,
    mean_vertex_error,
    motion_features,
    mouth_opening_error,
    pose_error,
    pose_errors,
    truncated,
    upper_face_dynamics_deviation,
    velocity_error,
)

LIPS = torch.tensor([0, 2])
PAIRS = torch.tensor([[0, 1], [2, 3]])
angles = st.floats(-3.0, 3.0)


def still(frames=2, vertices=3):
    return torch.zeros(frames, vertices, 3, dtype=torch.float64)


def moving(seed, frames=12, vertices=4):
    return torch.from_numpy(np.random.default_rng(seed).normal(size=(frames, vertices, 3)))


def test_lip_error_by_hand():
    predicted, true = still(), still()
    predicted[0, 0] = torch.tensor([3.0, 4.0, 0])  # 5, the worst of frame 0
    predicted[0, 2, 0] = 1
    predicted[1, 2, 2] = 2  # the worst of frame 1
    predicted[1, 1] = 1000  # not a lip
    assert lip_vertex_error(predicted, true, LIPS) == 3.5
    assert lip_vertex_error(predicted, true, LIPS, squared=True) == (25 + 4) / 2
    assert eye_vertex_error(predicted, true, LIPS) == 3.5


def test_mean_error_by_hand():
    predicted, true = still(1, 2), still(1, 2)
    predicted[0, 1] = torch.tensor([0, 3.0, 4.0])
    assert mean_vertex_error(predicted, true) == 2.5
    assert mean_vertex_error(predicted, true, torch.tensor([1])) == 5


def test_dynamics_by_hand():
    true, predicted = still(), still()
    true[1, 0, 0] = 4  # lengths 0 and 4: deviation 2
    predicted[1, 0, 1] = 2  # 1
    predicted[1, 2, 2] = 6  # 3 where the truth rests
    options = (predicted, true, still()[0], LIPS)
    assert upper_face_dynamics_deviation(*options) == ((2 - 1) + (0 - 3)) / 2
    assert upper_face_dynamics_deviation(*options, form="absolute") == 1
    assert upper_face_dynamics_deviation(*options, form="vertexwise") == (1 + 3) / 2
    assert upper_face_dynamics_deviation(*options, squared=True) == ((8 - 2) + (0 - 18)) / 2
    assert axis_dynamics_deviation(predicted, true, LIPS) == pytest.approx((2 + 1 + 3) / 6)


def test_velocity_by_hand():
    predicted, true = still(3, 1), still(3, 1)
    predicted[:, 0, 0] = torch.tensor([0, 3.0, 3.0])
    predicted[:, 0, 1] = torch.tensor([0, 4.0, 4.0])
    assert velocity_error(predicted, true, 30.0) == pytest.approx((5 + 0) / 2 * 30)
    assert velocity_error(predicted + 7, true, 30.0) == pytest.approx(75)
    with pytest.raises(ShapeError, match="at least two"):
        velocity_error(predicted[:1], true[:1], 30.0)


@pytest.mark.parametrize(("hertz", "above", "share"), [(3, 8, 0), (12, 8, 1), (12, 13, 0)])
def test_jitter_of_a_sine(hertz, above, share):
    time = torch.arange(120, dtype=torch.float64) / 30
    vertices = still(120, 2)
    vertices[:, 0, 1] = torch.sin(2 * math.pi * hertz * time)
    assert high_frequency_share(vertices, 30.0, above) == pytest.approx(share, abs=2e-3)
    assert high_frequency_share(vertices, 30.0, above, torch.tensor([1])) == 0  # it rests


def test_jitter_of_two_sines_is_the_share_of_their_accelerations():
    time = torch.arange(400, dtype=torch.float64) / 50
    vertices = still(400, 1)
    parts = {4.0: 1.0, 20.0: 0.1}
    for hertz, amplitude in parts.items():
        vertices[:, 0, 0] += amplitude * torch.sin(2 * math.pi * hertz * time)
    # The second difference multiplies a frequency by 2 - 2 cos w.
    power = {f: (a * (2 - 2 * math.cos(2 * math.pi * f / 50))) ** 2 for f, a in parts.items()}
    expected = power[20.0] / sum(power.values())
    assert high_frequency_share(vertices, 50.0, 10.0) == pytest.approx(expected, rel=1e-3)


def test_jitter_names_what_it_needs():
    with pytest.raises(OptionError, match="no power above 15 Hz"):
        high_frequency_share(still(20), 30.0, 15.0)
    with pytest.raises(ShapeError, match="at least 8"):
        high_frequency_share(still(7), 30.0, 8.0)


def test_samples_by_hand():
    true = still(2, 3)
    samples = torch.stack([still(2, 3), still(2, 3), still(2, 3)])
    samples[0, :, 0, 0] = 2.0
    samples[1, :, 0, 0] = -4.0
    samples[2, :, 0, 0] = 5.0  # mean 1
    assert mean_estimate_error(samples, true, LIPS) == pytest.approx(1)
    assert coverage_error(samples, true, LIPS) == 4
    assert coverage_error(samples, true, LIPS, squared=False) == 2
    assert diversity(samples) == pytest.approx((6 + 3 + 9) / 3 / 3)
    assert diversity(samples, torch.tensor([0])) == pytest.approx((6 + 3 + 9) / 3)
    with pytest.raises(ShapeError, match="at least 2"):
        diversity(samples[:1])


def test_the_best_sample_is_one_of_a_whole_sequence():
    true = still(2, 3)
    samples = torch.stack([still(2, 3), still(2, 3)])
    samples[0, 0, 0, 0] = samples[1, 1, 0, 0] = 3.0  # each is right in one frame
    assert coverage_error(samples, true, LIPS) == 4.5


def test_aperture_and_opening_by_hand():
    true = still(2, 4)
    true[0, [0, 2], 1] = torch.tensor([1.0, 5.0]).double()
    true[1, [0, 2], 1] = torch.tensor([-1.0, -2.0]).double()
    assert lip_aperture(true, PAIRS).tolist() == [5, -1]
    predicted = still(2, 4)
    assert mouth_opening_error(predicted, true, PAIRS) == 3


def test_closure_by_hand():
    true = still(10, 4)
    true[:, [0, 2], 1] = 5e-3
    true[4, [0, 2], 1] = 1e-3  # a bilabial in frame 4 that leaves 1 mm
    spans = [(0.4, 0.5), (5.0, 5.1)]  # the second lies past the end

    def closed(predicted, **options):
        return bilabial_closure(predicted, PAIRS, spans, 10.0, **options).tolist()

    predicted = true.clone()
    predicted[4, [0, 2], 1] = torch.tensor([1e-3, 1.9e-3]).double()  # 0.9 mm more at the widest pair
    assert closed(predicted, true=true) == [True]
    assert closed(predicted) == [False]
    assert closed(predicted, tolerance=2e-3) == [True]
    predicted[4, 2, 1] = 2.1e-3
    assert closed(predicted, true=true) == [False]
    predicted[4, 2, 1] = -3e-3  # pressed together
    assert closed(predicted, true=true) == [True]
    assert closed(true.roll(1, 0), true=true) == [True]
    assert closed(true.roll(3, 0), true=true) == [False]
    with pytest.raises(OptionError, match="fps"):
        bilabial_closure(true, PAIRS, spans, 0.0)


def test_pose_error_is_the_angle_between():
    predicted = torch.tensor([[0.3, 0, 0], [0, 0, 0], [math.pi - 0.1, 0, 0]]).double()
    true = torch.tensor([[0.1, 0, 0], [0, 0, 2.0], [-math.pi + 0.1, 0, 0]]).double()
    assert pose_errors(predicted, true).tolist() == pytest.approx([0.2, 2.0, 0.2])
    assert pose_error(predicted, true) == pytest.approx(2.4 / 3)
    tiny = torch.tensor([[1e-6, 0, 0]]).double()
    assert pose_error(tiny, 0 * tiny) == pytest.approx(1e-6)


@given(st.lists(angles, min_size=9, max_size=9))
@settings(max_examples=25, deadline=None)
def test_pose_error_does_not_see_a_common_turn(values):
    one, other, turn = torch.tensor(values, dtype=torch.float64).reshape(3, 1, 3)
    turned = [
        roma.rotmat_to_rotvec(roma.rotvec_to_rotmat(turn) @ roma.rotvec_to_rotmat(r)) for r in (one, other)
    ]
    assert pose_error(*turned) == pytest.approx(float(pose_error(one, other)), abs=1e-6)
    assert pose_error(one, other) == pytest.approx(float(pose_error(other, one)), abs=1e-6)


def test_frechet_of_known_gaussians():
    generator = torch.Generator().manual_seed(0)
    unit = torch.randn(4000, 3, generator=generator, dtype=torch.float64)
    unit = (unit - unit.mean(0)) @ torch.linalg.inv(torch.linalg.cholesky(unit.T.cov())).T  # exactly white
    scales, shift = torch.tensor([1.0, 2.0, 3.0]).double(), torch.tensor([1.0, 0, 2.0]).double()
    expected = 5 + ((scales - 1) ** 2).sum()
    assert frechet_distance(unit * scales + shift, unit) == pytest.approx(float(expected))
    assert frechet_distance(unit, unit) == pytest.approx(0, abs=1e-9)


def test_frechet_agrees_with_the_matrix_square_root():
    from scipy.linalg import sqrtm

    a, b = np.random.default_rng(1).normal(size=(2, 60, 5)) @ np.random.default_rng(2).normal(size=(2, 5, 5))
    first, second = np.cov(a.T), np.cov(b.T)
    trace = np.trace(first + second - 2 * np.real(sqrtm(first @ second)))
    expected = ((a.mean(0) - b.mean(0)) ** 2).sum() + trace
    assert frechet_distance(torch.from_numpy(a), torch.from_numpy(b)) == pytest.approx(expected)


def test_features_see_jitter_but_no_face():
    mask = torch.arange(4)
    true = moving(0, 200)
    template = torch.from_numpy(np.random.default_rng(1).normal(size=(4, 3)))
    assert motion_features(true, template, mask).shape == (199, 24)
    assert motion_features(true, template, torch.arange(4), landmarks=2).shape == (199, 12)
    same = motion_features(true, 0 * template, mask)
    torch.testing.assert_close(motion_features(true + template, template, mask), same)
    smooth = true.cumsum(0) / 10
    order = torch.randperm(200, generator=torch.Generator().manual_seed(0))
    shuffled = motion_features(smooth[order], template, mask)
    assert frechet_distance(shuffled, motion_features(smooth, template, mask)) > 1


@given(st.integers(0, 99), st.lists(angles, min_size=3, max_size=3), st.lists(angles, min_size=3, max_size=3))
@settings(max_examples=25, deadline=None)
def test_vertex_errors_do_not_see_a_common_rigid_motion(seed, turn, shift):
    predicted, true = moving(seed), moving(seed + 1000)
    rotation = roma.rotvec_to_rotmat(torch.tensor(turn, dtype=torch.float64))
    offset = torch.tensor(shift, dtype=torch.float64)
    template = true[0]

    def moved(vertices):
        return vertices @ rotation.T + offset

    for metric in (
        lambda p, t, r: lip_vertex_error(p, t, LIPS),
        lambda p, t, r: mean_vertex_error(p, t),
        lambda p, t, r: velocity_error(p, t, 30.0),
        lambda p, t, r: upper_face_dynamics_deviation(p, t, r, LIPS),
        lambda p, t, r: high_frequency_share(p, 30.0, 8.0),
        lambda p, t, r: frechet_distance(motion_features(p, r, LIPS), motion_features(t, r, LIPS)),
    ):
        expected = float(metric(predicted, true, template))
        assert metric(moved(predicted), moved(true), moved(template)) == pytest.approx(expected, rel=1e-6)


@given(st.integers(0, 99), st.floats(0.01, 100))
@settings(max_examples=25, deadline=None)
def test_metrics_scale_with_their_unit(seed, scale):
    predicted, true = moving(seed), moving(seed + 1000)
    template = true[0]
    for power, metric in (
        (1, lambda p, t, r: lip_vertex_error(p, t, LIPS)),
        (2, lambda p, t, r: lip_vertex_error(p, t, LIPS, squared=True)),
        (1, lambda p, t, r: mean_vertex_error(p, t)),
        (1, lambda p, t, r: upper_face_dynamics_deviation(p, t, r, LIPS)),
        (2, lambda p, t, r: upper_face_dynamics_deviation(p, t, r, LIPS, squared=True)),
        (1, lambda p, t, r: axis_dynamics_deviation(p, t, LIPS)),
        (1, lambda p, t, r: mouth_opening_error(p, t, PAIRS)),
        (1, lambda p, t, r: velocity_error(p, t, 30.0)),
        (0, lambda p, t, r: high_frequency_share(p, 30.0, 8.0)),
        (2, lambda p, t, r: frechet_distance(motion_features(p, r, LIPS), motion_features(t, r, LIPS))),
    ):
        expected = float(metric(predicted, true, template)) * scale**power
        found = metric(scale * predicted, scale * true, scale * template)
        assert found == pytest.approx(expected, rel=1e-6)


@given(st.integers(0, 99), st.permutations(range(4)), st.permutations(range(12)))
@settings(max_examples=25, deadline=None)
def test_order_of_vertices_and_frames(seed, vertices, frames):
    predicted, true = moving(seed), moving(seed + 1000)
    everything = torch.arange(4)
    for metric in (
        lambda p, t: lip_vertex_error(p, t, everything),
        lambda p, t: axis_dynamics_deviation(p, t, everything),
        lambda p, t: upper_face_dynamics_deviation(p, t, torch.zeros(4, 3).double(), everything),
        lambda p, t: mean_vertex_error(p, t),
    ):
        expected = float(metric(predicted, true))
        assert metric(predicted[:, vertices], true[:, vertices]) == pytest.approx(expected)
        assert metric(predicted[frames], true[frames]) == pytest.approx(expected)
    there = torch.tensor(vertices).argsort()
    assert lip_vertex_error(predicted[:, vertices], true[:, vertices], there[LIPS]) == pytest.approx(
        float(lip_vertex_error(predicted, true, LIPS))
    )


@given(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1))
@settings(max_examples=25, deadline=None)
def test_an_offset_changes_no_dynamics_along_axes(x, y):
    true = moving(0)
    offset = torch.tensor([x, y, 0], dtype=torch.float64)
    assert axis_dynamics_deviation(true + offset, true, LIPS) == pytest.approx(0, abs=1e-9)


def test_single_precision_and_the_empty_gradient():
    predicted, true = moving(0).float().requires_grad_(), moving(1).float()
    error = lip_vertex_error(predicted, true, LIPS, squared=True)
    assert error.dtype == torch.float32
    error.backward()
    assert predicted.grad.isfinite().all()


def test_truncation_to_the_shorter():
    longer, shorter = moving(0, 12), moving(1, 10)
    for pair in ((longer, shorter), (shorter, longer)):
        predicted, true, dropped = truncated(*pair)
        assert len(predicted) == len(true) == 10
        assert dropped == 2
    assert truncated(shorter, shorter)[2] == 0


def test_bad_input_is_named():
    with pytest.raises(ShapeError, match="shorter one"):
        lip_vertex_error(still(3), still(2), LIPS)
    with pytest.raises(ShapeError, match="no frames"):
        mean_vertex_error(still(0), still(0))
    with pytest.raises(ShapeError, match="mask names no vertices"):
        lip_vertex_error(still(), still(), torch.tensor([], dtype=torch.int64))
    with pytest.raises(ShapeError, match="vertex 9, the mesh has 3"):
        lip_vertex_error(still(), still(), torch.tensor([1, 9]))
    with pytest.raises(ShapeError, match="NaN"):
        mean_vertex_error(still() * math.nan, still())
    with pytest.raises(ShapeError, match="shorter one"):
        pose_error(torch.zeros(3, 3), torch.zeros(2, 3))
