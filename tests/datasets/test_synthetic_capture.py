"""Our own capture: exact cameras and vertices, masks and regions, splits, determinism, resuming."""

import hashlib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from meshanim.audio import Waveform, load_waveform
from meshanim.cli import main
from meshanim.datasets import open_capture
from meshanim.datasets.capture import REGIONS
from meshanim.datasets.capture_folder import write_capture
from meshanim.datasets.synthetic import capture as synthetic
from meshanim.datasets.synthetic import moments
from meshanim.datasets.synthetic.camera_rig import front_of_rig, rig_directions
from meshanim.datasets.synthetic.capture import CaptureOptions, cast_people, synthesize_capture
from meshanim.datasets.synthetic.corpus import SynthesizeOptions
from meshanim.datasets.synthetic.expressions import HELD_OUT, TRAINING
from meshanim.datasets.synthetic.moments import choose_moments, farthest
from meshanim.datasets.synthetic.performance import CURVE_NAMES
from meshanim.errors import FileFormatError, OptionError
from meshanim.render import Camera, rasterize
from meshanim.render.look import find_person
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
    assert capture.rest == find_person("bruno").rest_expression
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


def test_two_processes_draw_the_same_bytes_as_one(folder, tmp_path):
    corpus, chosen = options(tmp_path / "two", head_motion=1.0)
    made = synthesize_capture(replace(corpus, workers=2), chosen, progress=False)
    assert fingerprint(made[0].parent) == fingerprint(folder.parent)


def test_what_a_killed_run_left_half_written_is_made_whole(folder, tmp_path, monkeypatch):
    corpus, chosen = options(tmp_path / "killed", head_motion=1.0)
    write, count = synthetic.write_picture, 0

    def dying(directory, name, picture):
        nonlocal count
        count += 1
        if count == 4:  # the region map is there, the mask is being written
            write(directory, name, replace(picture, mask=None))
            (directory / "images" / f"{name}.png").unlink()
            (directory / "masks" / f".{name}-x7.png").write_bytes(b"half")
            raise KeyboardInterrupt
        write(directory, name, picture)

    with monkeypatch.context() as patched:
        patched.setattr(synthetic, "write_picture", dying)
        with pytest.raises(KeyboardInterrupt):
            synthesize_capture(corpus, chosen, progress=False)
    left = fingerprint(tmp_path / "killed")
    assert left != fingerprint(folder.parent)
    assert len(list((tmp_path / "killed").rglob("images/*.png"))) == 3
    synthesize_capture(corpus, chosen, progress=False)
    assert fingerprint(tmp_path / "killed") == fingerprint(folder.parent)


def test_a_video_has_its_sound_beside_it(tmp_path):
    corpus, chosen = options(tmp_path / "video", size=32, views=1, frames=3, moments="video")
    corpus = replace(corpus, fps=25)
    path = synthesize_capture(corpus, chosen, progress=False)[0]
    capture = open_capture(path)
    assert capture.fps == 25.0
    assert {row: file.name for row, file in capture.speech.items()} == {0: "00000.wav", 3: "00003.wav"}
    heard = load_waveform(capture.speech[0], rate=None)
    assert len(heard.samples) == round(3 * heard.rate / 25)
    assert len(load_waveform(capture.speech[3], rate=None).samples) == round(heard.rate / 25)
    spoken = choose_moments(corpus, 0, 3, 1, "video")
    np.testing.assert_allclose(heard.samples, spoken.speech[0].samples, atol=1 / 32767)
    expected = np.stack([moment.curves for moment in spoken.training])
    drive = capture.parameters.expression[:3] - capture.head.expression(find_person("bruno").rest_expression)
    columns = [CURVE_NAMES.index(name) for name in capture.head.expression_names if name in CURVE_NAMES]
    rows = [row for row, name in enumerate(capture.head.expression_names) if name in CURVE_NAMES]
    np.testing.assert_allclose(drive[:, rows].numpy(), expected[:, columns], atol=1e-6)
    assert capture.check() == []
    copy = open_capture(write_capture(capture, tmp_path / "copy"))
    assert (copy.fps, sorted(copy.speech)) == (25.0, [0, 3])
    assert copy.speech[0].read_bytes() == capture.speech[0].read_bytes()
    capture.speech[0].write_bytes(b"none")
    assert "00000.wav" in capture.check()[0]
    capture.speech[0].rename(path / "speech" / "sentence.wav")
    with pytest.raises(FileFormatError, match=r"sentence\.wav is named after no timestep"):
        open_capture(path)


def test_sentences_follow_each_other_frame_by_frame(monkeypatch):
    """Each begins with a frame of its own: sound and faces stay together over any number of sentences."""
    rate, fps = 1000, 30.0

    def acted(take, _):
        samples = np.full(110 * take, take, np.float32)  # a tenth of its last frame is spoken, or two, ...
        frames = int(np.ceil(110 * take * fps / rate))
        curves, pose = np.full((frames, 53), take, np.float32), np.zeros((frames, 3), np.float32)
        performance = SimpleNamespace(curves=curves, pose=pose)
        return Waveform(samples / 10, rate), [], performance

    monkeypatch.setattr(moments, "act", acted)
    takes = [Said(number) for number in (1, 2, 3, 4)]
    found, heard = moments._in_order(takes, fps, 16)
    said = [int(moment.curves[0]) for moment in found]
    assert said == [1] * 4 + [2] * 7 + [3] * 5
    for index, number in enumerate(said):
        frame = heard.samples[round(index * rate / fps) : round((index + 1) * rate / fps)]
        assert set(np.round(10 * frame)) <= {0, number}, index
        assert round(10 * frame[0]) == number
    assert len(heard.samples) == round(16 * rate / fps)
    with pytest.raises(OptionError, match="21 frames are spoken, 30 are wanted"):
        moments._in_order(takes, fps, 30)


class Said(int):
    """A sentence that is its number."""

    sentence = 1
    member = SimpleNamespace(name="S01")


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
