import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshanim.errors import OptionError, ShapeError
from meshanim.training.metrics import (
    axis_dynamics_deviation,
    bilabial_closure,
    eye_vertex_error,
    lip_aperture,
    lip_vertex_error,
    mean_vertex_error,
    upper_face_dynamics_deviation,
)

LIPS = np.array([0, 2])


def still(frames=2, vertices=3):
    return np.zeros((frames, vertices, 3))


def test_lip_error_by_hand():
    predicted, true = still(), still()
    predicted[0, 0] = [3e-3, 4e-3, 0]  # 5 mm, the worst of frame 0
    predicted[0, 2] = [1e-3, 0, 0]
    predicted[1, 2] = [0, 0, 2e-3]  # 2 mm, the worst of frame 1
    predicted[1, 1] = [1, 1, 1]  # not a lip
    assert lip_vertex_error(predicted, true, LIPS) == pytest.approx(3.5)
    assert lip_vertex_error(predicted, true, LIPS, squared=True) == pytest.approx((25e-6 + 4e-6) / 2)
    assert eye_vertex_error(predicted, true, LIPS) == pytest.approx(3.5)


def test_mean_error_by_hand():
    predicted, true = still(1, 2), still(1, 2)
    predicted[0, 1] = [0, 3e-3, 4e-3]
    assert mean_vertex_error(predicted, true) == pytest.approx(2.5)


def test_dynamics_by_hand():
    true, predicted = still(), still()
    true[1, 0] = [4e-3, 0, 0]  # lengths 0 and 4 mm: deviation 2 mm
    predicted[1, 0] = [0, 2e-3, 0]  # 1 mm
    predicted[1, 2] = [0, 0, 2e-3]  # 1 mm where the truth rests
    template = np.zeros((3, 3))
    options = (predicted, true, template, LIPS)
    assert upper_face_dynamics_deviation(*options) == pytest.approx((1 - 1) / 2)
    assert upper_face_dynamics_deviation(*options, signed=False) == pytest.approx(1)
    squared = ((16e-6 / 2 - 4e-6 / 2) + (0 - 4e-6 / 2)) / 2
    assert upper_face_dynamics_deviation(*options, squared=True) == pytest.approx(squared)
    assert axis_dynamics_deviation(predicted, true, LIPS) == pytest.approx((2 + 1 + 1) / 6)


@given(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1))
def test_an_offset_changes_no_dynamics_along_axes(x, y):
    true = np.random.default_rng(0).normal(size=(5, 3, 3))
    assert axis_dynamics_deviation(true + np.array([x, y, 0]), true, LIPS) == pytest.approx(0, abs=1e-9)


def test_closure_by_hand():
    pairs = np.array([[0, 1], [2, 3]])
    true = still(10, 4)
    true[:, [0, 2], 1] = 5e-3
    true[4, [0, 2], 1] = 1e-3  # a bilabial in frame 4 that leaves 1 mm
    assert lip_aperture(true, pairs)[[0, 4]] == pytest.approx([5e-3, 1e-3])
    predicted = true.copy()
    predicted[4, [0, 2], 1] = [1e-3, 1.9e-3]  # 0.9 mm more at the widest pair
    spans = [(0.4, 0.5), (5.0, 5.1)]  # the second lies past the end
    assert bilabial_closure(predicted, true, pairs, spans, 10.0) == [True]
    predicted[4, 2, 1] = 2.1e-3
    assert bilabial_closure(predicted, true, pairs, spans, 10.0) == [False]
    predicted[4, 2, 1] = -3e-3  # pressed together
    assert bilabial_closure(predicted, true, pairs, spans, 10.0) == [True]
    late = np.roll(true, 1, axis=0)
    assert bilabial_closure(late, true, pairs, spans, 10.0) == [True]
    assert bilabial_closure(np.roll(true, 3, axis=0), true, pairs, spans, 10.0) == [False]
    with pytest.raises(OptionError, match="fps"):
        bilabial_closure(true, true, pairs, spans, 0.0)


def test_bad_input_is_named():
    with pytest.raises(ShapeError, match="cut both"):
        lip_vertex_error(still(3), still(2), LIPS)
    with pytest.raises(ShapeError, match="no frames"):
        mean_vertex_error(still(0), still(0))
    with pytest.raises(ShapeError, match="lips names no vertices"):
        lip_vertex_error(still(), still(), np.array([], int))
    with pytest.raises(ShapeError, match="NaN"):
        mean_vertex_error(still() * np.nan, still())
