import numpy as np
import pytest
import torch

from meshanim.errors import OptionError, ShapeError
from meshanim.heads import load_head
from meshanim.training.metrics.masks import Mask
from meshanim.training.metrics.modules import BilabialClosure, LipVertexError, UpperFaceDynamicsDeviation
from meshanim.training.motion_evaluation import MotionEvaluation, MotionMasks, masks_of_head


@pytest.fixture(scope="module")
def head():
    return load_head("default")


def test_the_regions_of_a_head_give_every_metric(head):
    masks = masks_of_head(head)
    rest = head.template_vertices
    upper = masks.lip_pairs[:, 0]
    true = rest.repeat(20, 1, 1)
    open_by = 0.004 - (rest[upper, 1] - rest[masks.lip_pairs[:, 1], 1])
    true[:, upper, 1] += open_by
    true[10, upper, 1] -= 0.004  # closed in frame 10
    predicted = true.clone()
    predicted[10, upper, 1] += 0.002  # not for a bilabial there
    evaluation = MotionEvaluation(masks, 25.0)
    evaluation.add("one", predicted[None], true, rest, [(0.4, 0.44)])
    evaluation.add("two", true[None], true, rest, [(0.4, 0.44), (0.4, 0.44)])
    evaluation.add("silent", true[None], true, rest)
    values = {value.metric: value for value in evaluation.values()}
    assert values["lip vertex error"].value == pytest.approx(2 / 60, abs=1e-5)
    assert values["lip vertex error"].vertices == len(head.regions["lips"])
    assert values["lip vertex error"].per_sequence["one"] == pytest.approx((2 / 20, 20), abs=1e-4)
    assert values["mouth opening error"].value == pytest.approx(2 / 60, abs=1e-5)
    assert values["bilabials closed"].value == pytest.approx(2 / 3)
    assert set(values["bilabials closed"].per_sequence) == {"one", "two"}
    assert values["bilabials closed"].vertices == len(masks.lip_pairs.unique())
    assert values["eye vertex error"].mask == "eye_region"
    assert values["mean vertex error"].vertices == head.n_vertices
    assert values["velocity error"].unit == "mm/s"
    # A difference of 2 mm in one of 20 frames, before and after: two steps of 19.
    moved = len(upper.unique()) / len(masks.lips)
    assert values["velocity error"].value == pytest.approx(2 * 2 * 25 / 57 * moved, rel=1e-3)
    assert {"FDD", "FDD squared", "AFDD", "jitter", "jitter of truth", "Frechet distance"} <= set(values)
    assert not {"MEE", "pose error"} & set(values)


def test_short_sequences_have_no_spectrum(head):
    rest = head.template_vertices
    evaluation = MotionEvaluation(masks_of_head(head), 25.0)
    evaluation.add("one frame", rest[None, None], rest[None], rest)
    assert not {"jitter", "velocity error", "Frechet distance"} & {v.metric for v in evaluation.values()}
    with pytest.raises(ShapeError, match="scored twice"):
        evaluation.add("one frame", rest[None, None], rest[None], rest)


def test_what_a_mask_is_missing_for_is_not_measured():
    evaluation = MotionEvaluation(MotionMasks(), 25.0, "biwi")
    evaluation.add("a", torch.zeros(1, 9, 4, 3), torch.ones(9, 4, 3))
    (value,) = evaluation.values()
    assert (value.metric, value.unit, value.vertices) == ("mean vertex error", "biwi", 4)
    assert value.value == pytest.approx(3**0.5)


def test_units_and_forms_are_checked(unchecked):
    mask = Mask("lips", np.arange(3))
    with pytest.raises(OptionError, match="no unit 'mm'"):
        LipVertexError(mask, unit="mm")
    with pytest.raises(OptionError, match="no form 'root'"):
        UpperFaceDynamicsDeviation(mask, form="root")
    closure = BilabialClosure(torch.tensor([[0, 1]]), 25.0, relative=False)
    assert closure.name == "bilabials with closed lips"
    assert "at most 1 mm above closed lips" in closure.formula
