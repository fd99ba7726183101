import numpy as np
import pytest

from meshanim.errors import OptionError
from meshanim.render.look import PersonParameters
from meshanim.render.look.person import skin_color


def test_tone_table_is_met_at_its_nodes_and_darkens_in_every_channel():
    assert np.allclose(skin_color(0.0) ** (1 / 2.2) * 255, (238, 206, 184))
    assert np.allclose(skin_color(1.0) ** (1 / 2.2) * 255, (66, 44, 35))
    ramp = np.array([skin_color(tone) for tone in np.linspace(0, 1, 41)])
    assert (np.diff(ramp, axis=0) < 0).all()
    assert (np.diff(ramp, axis=1) < 0).all()  # red > green > blue at every tone
    assert skin_color(0.5, 1.0)[2] < skin_color(0.5)[2] < skin_color(0.5, -1.0)[2]


@pytest.mark.parametrize(
    ("key", "value"),
    [("tone", 1.2), ("age", -0.1), ("hair", "mohawk"), ("eye_color", "violet"), ("lip_color", (2.0, 0, 0))],
)
def test_a_value_out_of_range_is_refused_by_name(key, value):
    with pytest.raises(OptionError, match=key):
        PersonParameters(**{key: value})
