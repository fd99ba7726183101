import numpy as np
import pytest
import torch

from meshanim.errors import FileFormatError, OptionError, ShapeError
from meshanim.heads import HeadParameters, load_head
from meshanim.motion.blendshape_track import BlendshapeTrack


@pytest.fixture(scope="module")
def head():
    return load_head("default")


def test_round_trips(tmp_path):
    rng = np.random.default_rng(0)
    track = BlendshapeTrack(
        ("jawOpen", "lipSeal"), rng.uniform(size=(7, 2)), 29.97, rng.normal(size=(7, 3)).astype(np.float32)
    )
    track.save(tmp_path / "a.npz")
    back = BlendshapeTrack.load(tmp_path / "a.npz")
    assert back.names == track.names
    assert back.fps == 29.97
    np.testing.assert_array_equal(back.weights, track.weights)
    np.testing.assert_array_equal(back.pose, track.pose)
    track.save(tmp_path / "a.csv")
    back = BlendshapeTrack.load(tmp_path / "a.csv")
    assert back.fps == pytest.approx(29.97, rel=1e-4)
    for name, column in zip(track.names, track.weights.T):
        np.testing.assert_array_equal(back.weights[:, back.names.index(name)], column)


def test_animates_a_head(head):
    weights = np.zeros((3, 3))
    weights[1] = 0.5, 0, 0
    weights[2] = 1.0, 0.2, 0
    track = BlendshapeTrack(("JawOpen", "browInnerUp", "noSuchShape"), weights, 30.0)
    sequence = track.animate(head)
    expected = head(
        HeadParameters(
            expression=head.expression(
                {"jawOpen": torch.tensor(weights[:, 0]), "browInnerUp": torch.tensor(weights[:, 1])}
            )
        )
    )
    np.testing.assert_allclose(sequence.vertices, expected.numpy(), atol=1e-7)
    moved = track.animate(head, head.mesh.vertices + 1.0)
    np.testing.assert_allclose(moved.vertices, sequence.vertices + 1, atol=1e-6)
    weights[0, 2] = 0.1
    with pytest.raises(OptionError, match="noSuchShape"):
        track.animate(head)


def test_bad_input_is_named(tmp_path, unchecked):
    with pytest.raises(ShapeError, match="weights"):
        BlendshapeTrack(("a",), np.zeros((3, 2)), 30.0)
    with pytest.raises(ShapeError, match="NaN"):
        BlendshapeTrack(("a",), np.full((3, 1), np.nan), 30.0)
    with pytest.raises(ShapeError, match="pose"):
        BlendshapeTrack(("a",), np.zeros((3, 1)), 30.0, np.zeros((2, 3), np.float32))
    with pytest.raises(OptionError, match="twice"):
        BlendshapeTrack(("a", "a"), np.zeros((3, 2)), 30.0)
    with pytest.raises(OptionError, match="fps"):
        BlendshapeTrack(("a",), np.zeros((3, 1)), 0.0)
    track = BlendshapeTrack(("a",), np.zeros((3, 1)), 30.0)
    with pytest.raises(OptionError, match=r"\.csv"):
        track.save(tmp_path / "a.json")
    track.save(tmp_path / "a.npz")
    (tmp_path / "cut.npz").write_bytes((tmp_path / "a.npz").read_bytes()[:200])
    with pytest.raises(FileFormatError, match="cut"):
        BlendshapeTrack.load(tmp_path / "cut.npz")
