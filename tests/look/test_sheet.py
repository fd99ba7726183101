import numpy as np
import pytest

from meshanim.render.look import find_person, make_appearance
from meshanim.render.look.sheet import EXPRESSIONS, people_sheet, pose_person
from meshanim.render.rasterizer import native_available


def test_a_pose_adds_the_rest_expression_and_closes_the_lips(head, assets):
    appearance = make_appearance(head, find_person("mei"), 256, assets)
    closed, expression = pose_person(head, appearance, {})
    parted, _ = pose_person(head, appearance, {"lipSeal": 0.0})
    assert np.allclose(parted, appearance.template, atol=1e-6)
    upper, lower = head.lip_pairs.T
    gap = [(vertices[upper, 1] - vertices[lower, 1]).mean() for vertices in (closed, parted)]
    assert gap[0] < gap[1]
    assert expression[head.expression_names.index("lipSeal")] == 1
    for weights in EXPRESSIONS.values():
        assert np.isfinite(pose_person(head, appearance, weights)[0]).all()


@pytest.mark.skipif(not native_available(), reason="the extension is not built")
def test_the_sheet_shows_each_person_twice(head):
    image = people_sheet(head, ["bruno"], 48, 2, 256)
    assert image.shape == (48, 96, 3)
    assert image.std() > 10
