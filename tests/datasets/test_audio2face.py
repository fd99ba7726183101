import numpy as np
import pytest
from audio2face_files import SKIN, TONGUE, chunk, group, maya_file, pc2_file, write_tree

from meshanim.datasets import open_dataset
from meshanim.datasets.audio2face import Audio2FaceOptions
from meshanim.datasets.point_caches import read_maya_cache, read_points
from meshanim.errors import FileFormatError, OptionError


@pytest.fixture
def points():
    return np.random.default_rng(1).normal(size=(5, 7, 3)).astype(np.float32)


def test_maya_caches(tmp_path, points):
    for double in (False, True):
        maya_file(tmp_path / "one.mc", points, double=double)
        np.testing.assert_array_equal(read_points(tmp_path / "one.mc"), points)
    for k, frame in enumerate(points):
        maya_file(tmp_path / f"manyFrame{k + 8}.mc", frame[None], start=k, times=False)
    (tmp_path / "many.xml").write_text("<Autodesk_Cache_File/>")
    np.testing.assert_array_equal(read_points(tmp_path / "many.xml"), points)


def test_channels_of_a_maya_cache(tmp_path, points):
    teeth = np.ones((3, 3), np.float32)
    maya_file(tmp_path / "two.mc", points, more=[(b"teethShape", teeth)])
    assert read_maya_cache(tmp_path / "two.mc").shape == (5, 3, 3)
    np.testing.assert_array_equal(read_maya_cache(tmp_path / "two.mc", "skinShape"), points)
    with pytest.raises(FileFormatError, match="eyeShape"):
        read_maya_cache(tmp_path / "two.mc", "eyeShape")


def test_pc2_files(tmp_path, points):
    pc2_file(tmp_path / "p.pc2", points)
    np.testing.assert_array_equal(read_points(tmp_path / "p.pc2"), points)
    whole = (tmp_path / "p.pc2").read_bytes()
    for damaged in (whole[:20], whole[:-1], b"POINTCACHE1\0" + whole[12:], b""):
        (tmp_path / "p.pc2").write_bytes(damaged)
        with pytest.raises(FileFormatError, match=r"p\.pc2"):
            read_points(tmp_path / "p.pc2")


def test_damaged_maya_caches_are_named(tmp_path, points):
    path = tmp_path / "c.mc"
    maya_file(path, points)
    whole = path.read_bytes()
    wrong_size = group(b"CACH", chunk(b"VRSN", b"0.1\0")) + group(
        b"MYCH", chunk(b"SIZE", b"\0\0\0\x09"), chunk(b"FVCA", b"\0" * 24)
    )
    step = (len(whole) - 44) // 5
    ends = [len(whole) - step * k for k in (4, 3, 2, 1)]
    for cut in [*range(0, len(whole), 13), *ends]:
        path.write_bytes(whole[:cut])
        if cut in ends:  # cut between two frames: those before it are whole
            np.testing.assert_array_equal(read_points(path), points[: ends.index(cut) + 1])
            continue
        with pytest.raises(FileFormatError, match=r"c\.mc"):
            read_points(path)
    for damaged in (b"FOR8" + whole[4:], b"RIFF" + whole[4:], wrong_size, whole[:44]):
        path.write_bytes(damaged)
        with pytest.raises(FileFormatError, match=r"c\.mc"):
            read_points(path)
    with pytest.raises(FileFormatError, match="beside it"):
        read_points(tmp_path / "none.xml")
    with pytest.raises(FileFormatError, match="no point cache"):
        read_points(tmp_path / "none.abc")
    maya_file(tmp_path / "dFrame1.mc", points[:1])
    maya_file(tmp_path / "dFrame2.mc", points[:1, :4])
    with pytest.raises(FileFormatError, match="4 and of 7"):
        read_points(tmp_path / "d.xml")


def test_the_tree_is_read_in_metres(tmp_path):
    truth, turned = write_tree(tmp_path / "claire")
    dataset = open_dataset(tmp_path / "claire")
    assert dataset.kind == "audio2face"
    assert (dataset.name, dataset.fps, dataset.sequences) == ("claire", 30.0, ("cp1", "eg1", "eg2"))
    for shot in dataset.sequences:
        sequence = dataset[shot]
        np.testing.assert_allclose(sequence.vertices, truth[shot], atol=1e-6)
        np.testing.assert_allclose(sequence.coefficients["eyes"], turned[shot], atol=1e-6)
        assert sequence.audio.duration == pytest.approx(0.8)
    assert [dataset.language(shot) for shot in dataset.sequences] == ["zh", "en", "en"]
    parts = dataset.parts
    assert (len(parts.skin), len(parts.tongue), len(parts.jaw_points)) == (SKIN, TONGUE, 5)
    np.testing.assert_array_equal(parts.lip_pairs[1], [1, 6])
    np.testing.assert_array_equal(parts.upper_lip[0], [10, 0])
    np.testing.assert_array_equal(parts.lower_lip[4], [9, 19])
    np.testing.assert_array_equal(parts.lid_pairs, [[20, 21], [22, 23]])
    assert dataset.pose_deltas["eye_close"][0, 0] == pytest.approx(0.001)
    assert dataset.saccades.shape == (50, 2)
    assert dataset.blinks.shape == (30,)
    assert dataset.check() == []


def test_the_list_of_clips_is_read_not_run(tmp_path):
    folder = tmp_path / "claire"
    truth, _ = write_tree(folder)
    config = tmp_path / "config_dataset.py"
    config.write_text(
        "import os\nos.abort()\n"
        "CLIPS = [('claire', 'cp1', (3, 20), 'audio', 'mandarin', 'cp1.wav', 'joy', 1.0),\n"
        "         ('claire', 'cp1', (21, 23), 'audio', 'mandarin', 'cp1.wav', 'sadness'),\n"
        "         ('claire', 'eg1', (0, 23), 'audio', 'english', 'eg1.wav'),\n"
        "         ('claire', 'eg99', (0, 5), 'audio', 'english', 'eg99.wav')]\n"
    )
    dataset = open_dataset(folder, options=Audio2FaceOptions(config=config))
    assert dataset.sequences == ("cp1", "cp1-21", "eg1")
    clip = dataset["cp1"]
    assert (clip.info.emotion, clip.info.intensity, clip.info.frames) == ("joy", 1.0, 18)
    np.testing.assert_allclose(clip.vertices, truth["cp1"][3:21], atol=1e-6)
    assert clip.audio.duration == pytest.approx(18 / 30, abs=1e-3)
    np.testing.assert_array_equal(
        clip.audio.samples[:100], open_dataset(folder)["cp1"].audio.samples[1600:1700]
    )
    assert dataset.language("cp1") == "zh"
    assert dataset["eg1"].info.emotion == "neutral"
    for text in ("CLIPS = [f()]", "CLIPS = [(1, 2)]", "CLIPS = ["):
        config.write_text(text)
        with pytest.raises(FileFormatError, match="CLIPS"):
            open_dataset(folder, options=Audio2FaceOptions(config=config))
    config.write_text("CLIPS = [('claire', 'cp1', (3, 99), 'audio', 'mandarin', 'cp1.wav')]")
    with pytest.raises(FileFormatError, match="3 to 99"):
        open_dataset(folder, options=Audio2FaceOptions(config=config)).info("cp1")


def test_damage_is_found(tmp_path):
    folder = tmp_path / "claire"
    write_tree(folder)
    (folder / "cache/skin/eg1/eg1.pc2").write_bytes(b"POINTCACHE2\0")
    np.save(folder / "cache/tongue/eg2/eg2.npy", np.zeros((24, TONGUE + 1, 3), np.float32))
    jaws = dict(np.load(folder / "xform/jaw_keypoints_cache_all.npz"))
    np.savez(folder / "xform/jaw_keypoints_cache_all.npz", **jaws | {"cp1": jaws["cp1"][:5]})
    found = "\n".join(open_dataset(folder).check())
    assert "eg1.pc2 is cut short" in found
    assert "tongue of eg2 has 24 frames of 10" in found
    assert "cp1 has shape (5, 5, 3)" in found
    (folder / "xform/eye_rotations_all.npz").write_bytes(b"PK\x03\x04")
    np.savez(folder / "xform/jaw_keypoints_cache_all.npz", **jaws)
    with pytest.raises(FileFormatError, match="eye_rotations"):
        open_dataset(folder).motion("cp1")
    (folder / "geom/skin/lip_dist_vertex_list.json").write_text('{"upper": [0], "lower": [400]}')
    with pytest.raises(FileFormatError, match="vertex 400"):
        open_dataset(folder)
    np.save(folder / "xform/jaw_keypoints_neutral.npy", np.zeros((4, 3)))
    with pytest.raises(FileFormatError, match="4 jaw points"):
        open_dataset(folder)
    with pytest.raises(OptionError, match="positive"):
        Audio2FaceOptions(scale=0.0)
