"""Our own capture: exact cameras and vertices, masks and regions, splits, determinism, resuming."""

import hashlib
from dataclasses import replace

import numpy as np
import pytest

from meshanim.cli import main
from meshanim.datasets import open_capture
from meshanim.datasets.capture import REGIONS
from meshanim.datasets.synthetic import capture as synthetic
from meshanim.datasets.synthetic.camera_rig import front_of_rig, rig_directions
from meshanim.datasets.synthetic.capture import CaptureOptions, cast_people, synthesize_capture
from meshanim.datasets.synthetic.corpus import SynthesizeOptions
from meshanim.datasets.synthetic.expressions import HELD_OUT, TRAINING
from meshanim.datasets.synthetic.moments import farthest
from meshanim.datasets.synthetic.performance import CURVE_NAMES
from meshanim.errors import OptionError
from meshanim.render import Camera, rasterize
from meshanim.render.rasterizer import native_available

pytest.importorskip("pocketsphinx")
pytest.importorskip("espeakng_loader")
pytestmark = pytest.mark.skipif(not native_available(), reason="the extension is not built")

SIZE = 96


def options(directory, **changes):
    """Two frames with two random cameras each, one of them spoken, and one held out."""
    corpus = SynthesizeOptions(directory, sentences=2, workers=1)
    chosen = CaptureOptions(cameras="random", views=2, size=SIZE, names=("bruno",), frames=2)
    return corpus, replace(chosen, **changes)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    directory = tmp_path_factory.mktemp("capture") / "new"
    return synthesize_capture(*options(directory, head_motion=1.0), progress=False)[0]


@pytest.fixture(scope="module")
def capture(folder):
    return open_capture(folder)


def fingerprint(directory):
    return {
        str(path.relative_to(directory)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(directory.rglob("*"))
        if path.is_file()
    }


def test_splits_and_names(capture):
    assert {name: len(indices) for name, indices in capture.splits.items()} == {
        "train": 4, "novel_view": 2, "novel_expression": 3,
    }  # fmt: skip
    assert capture.check() == []
    assert (capture.name, capture.head_name, capture.region_names) == ("Bruno", "default", REGIONS)
    used = {name: {capture.views[i].timestep for i in rows} for name, rows in capture.splits.items()}
    assert used == {"train": {0, 1}, "novel_view": {0}, "novel_expression": {2}}
    seen = {name: {capture.views[i].world_to_camera.tobytes() for i in capture.split(name)} for name in used}
    assert len(seen["train"]) == 4
    assert not seen["train"] & (seen["novel_view"] | seen["novel_expression"])


def test_mesh_and_cameras_fit_the_pictures(capture):
    """The mesh's outline in each camera is that of the mask, but for hair and the fading neck."""
    assert 11_000 < capture.mesh.n_faces < 13_500
    for index, view in enumerate(capture.views):
        picture = capture[index]
        camera = Camera(view.world_to_camera, view.intrinsics, view.width, view.height)
        vertices = capture.vertices(view.timestep).numpy()
        drawn = rasterize(vertices, capture.mesh.faces, camera, cull_backfaces=True).mask
        head = np.isin(picture.regions, [REGIONS.index(name) for name in ("skin", "lips", "mouth", "eyes")])
        assert drawn[head].mean() > 0.99
        assert picture.mask[drawn & head].min() > 100
        outside = (picture.mask > 128) & ~drawn
        assert outside.sum() < 0.03 * drawn.sum()


def test_background_is_plain_and_regions_are_where_they_belong(capture):
    open_eyes = 0
    for index in range(len(capture)):
        picture = capture[index]
        around = picture.image[picture.mask == 0].astype(float)
        assert np.abs(around - 255 * np.array(capture.background)).max() <= 1
        assert (picture.regions[picture.mask == 0] == 0).mean() > 0.99
        rows = {name: np.argwhere(picture.regions == REGIONS.index(name))[:, 0] for name in REGIONS}
        assert rows["lips"].mean() < rows["neck"].mean()
        if len(rows["eyes"]):  # they may be shut
            assert rows["eyes"].mean() < rows["lips"].mean()
            open_eyes += 1
        assert len(rows["skin"]) > 1000
        assert len(rows["hair"]) > 50
    assert open_eyes >= 4


def test_vertices_are_those_of_the_head_with_the_parameters(capture):
    whole = capture.vertices([0, 1, 2])
    assert whole.shape == (3, capture.mesh.n_vertices, 3)
    assert np.array_equal(whole[2], capture.vertices(2))
    assert (whole[0] - whole[1]).abs().max() > 1e-3
    still = capture.parameters.neck[0]
    assert not still.any()  # a hand-made face
    assert capture.parameters.neck[1].any()  # a spoken moment


def test_same_seed_same_files_and_a_broken_run_goes_on(folder, tmp_path):
    corpus, chosen = options(tmp_path / "again", head_motion=1.0)
    for kept_from_before in (synthetic._look, synthetic._appearance, synthetic._renderer):
        kept_from_before.cache_clear()
    again = synthesize_capture(corpus, chosen, progress=False)[0]
    expected = fingerprint(folder.parent)
    assert fingerprint(again.parent) == expected
    kept = again / "images" / "00001_r1.png"
    before = kept.stat().st_mtime_ns
    for name in ("images/00000_r0.png", "images/00002_h3.png", "capture.json"):
        (again / name).unlink()
    synthesize_capture(corpus, chosen, progress=False)
    assert fingerprint(again.parent) == expected
    assert kept.stat().st_mtime_ns == before
    with pytest.raises(OptionError, match="size 96"):
        synthesize_capture(corpus, replace(chosen, size=64), progress=False)


def test_a_rig_from_the_command_line(tmp_path, capsys):
    words = ["--images", "--views", "4", "--size", "32", "--frames", "1", "--names", "bruno"]
    words += ["--sentences", "2", "--workers", "1"]
    assert main(["data", "synthesize", str(tmp_path / "rig"), *words]) == 0
    assert "bruno" in capsys.readouterr().out
    capture = open_capture(tmp_path / "rig" / "bruno")
    counts = {name: len(indices) for name, indices in capture.splits.items()}
    assert counts == {
        "train": 3, "novel_view": 1, "novel_expression": 1, "novel_expression_known_view": 3,
    }  # fmt: skip
    front = capture.views[capture.split("novel_view")[0]]
    assert np.allclose(front.world_to_camera[:3, :3], np.diag([1, -1, -1]), atol=1e-9)


def test_rig_is_ninety_by_thirty_degrees_and_its_eighth_camera_in_front():
    directions = np.degrees(rig_directions(16))
    assert np.allclose(directions.min(0), (-45, -15))
    assert np.allclose(directions.max(0), (45, 15))
    assert len(np.unique(directions, axis=0)) == 16
    assert front_of_rig(16) == 8
    for count in range(1, 40):
        directions = rig_directions(count)
        assert len(directions) == count
        assert np.allclose(directions[front_of_rig(count)], 0)
    with pytest.raises(OptionError, match="1 camera"):
        rig_directions(0)


def test_hand_made_faces_have_known_names_and_the_held_out_ones_are_others():
    for faces in (TRAINING, HELD_OUT):
        for weights in faces.values():
            assert set(weights) <= set(CURVE_NAMES)
            assert all(0 < weight <= 1 for weight in weights.values())
    trained, held = ({frozenset(face) for face in faces.values()} for faces in (TRAINING, HELD_OUT))
    assert not trained & held


def test_farthest_points_are_spread():
    line = np.array([[0.0], [1.0], [2.0], [9.0], [10.0]])
    assert farthest(line, 3) == [4, 0, 2]
    assert sorted(farthest(line, 5)) == [0, 1, 2, 3, 4]


def test_more_people_than_the_twelve():
    people = cast_people(CaptureOptions(people=15), seed=3)
    assert len({person.name for person in people}) == 15
    assert people[13] == cast_people(CaptureOptions(people=14), seed=3)[13]
    assert people[13].shape != people[12].shape


def test_options_that_cannot_be(tmp_path, capsys):
    with pytest.raises(OptionError, match="--size"):
        CaptureOptions(size=8)
    with pytest.raises(OptionError, match="no person named zoe"):
        CaptureOptions(names=("zoe",))
    assert main(["data", "synthesize", str(tmp_path / "x"), "--views", "4"]) == 2
    assert "need --images" in capsys.readouterr().err
    corpus, chosen = options(tmp_path / "x")
    with pytest.raises(OptionError, match="default head"):
        synthesize_capture(replace(corpus, head="rig:a.glb"), chosen)
    with pytest.raises(OptionError, match="images need two"):
        synthesize_capture(replace(corpus, sentences=1), chosen, progress=False)
