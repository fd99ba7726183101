import csv

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
    for ending in ("npz", "csv"):
        track.save(tmp_path / f"a.{ending}")
        back = BlendshapeTrack.load(tmp_path / f"a.{ending}")
        assert back.names == track.names
        np.testing.assert_allclose(back.weights, track.weights, rtol=1e-8)
        assert back.fps == pytest.approx(29.97, abs=1e-5)
    np.testing.assert_array_equal(BlendshapeTrack.load(tmp_path / "a.npz").pose, track.pose)
    with open(tmp_path / "a.csv", newline="") as text:
        rows = list(csv.DictReader(text))
    assert list(rows[0]) == ["timeCode", "blendShapes.JawOpen", "blendShapes.LipSeal"]
    assert float(rows[3]["timeCode"]) == pytest.approx(3 / 29.97)
    assert float(rows[3]["blendShapes.JawOpen"]) == pytest.approx(track.weights[3, 0])


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
    head = "timeCode,blendShapes.A,blendShapes.B\n"
    for name, text in {
        "none.csv": None,
        "empty.csv": "",
        "other.csv": "a,b\n1,2\n",
        "rows.csv": head,
        "cell.csv": head + "0,1,x\n",
        "short.csv": head + "0,1,1\n0.1,1\n",
        "nan.csv": head + "0,1,1\n0.1,nan,1\n",
        "time.csv": head + "0.1,1,1\n0,1,1\n",
        "twice.csv": "timeCode,blendShapes.A,blendShapes.a\n0,1,1\n",
    }.items():
        if text is not None:
            (tmp_path / name).write_text(text)
        with pytest.raises(FileFormatError, match=name):
            BlendshapeTrack.load(tmp_path / name)
    with pytest.raises(FileFormatError, match="cut"):
        BlendshapeTrack.load(tmp_path / "cut.npz")
