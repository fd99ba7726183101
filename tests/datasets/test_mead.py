"""3D-MEAD in its two layouts on small trees with their names and types, and on damaged copies."""

import shutil
import sys

import numpy as np
import pytest
import torch
from made_files import write_flame, write_sound

from meshanim.datasets import open_dataset
from meshanim.datasets.mead import PEOPLE, MeadDataset, MeadOptions
from meshanim.errors import DependencyError, FileFormatError, OptionError
from meshanim.heads import HeadParameters, load_head

h5py = pytest.importorskip("h5py")

# Person, sentence, emotion, level, frames; W017 is in EMOTE's release and in no split of ProbTalk3D.
TAKES = [
    ("M003", "001", "neutral", 1, 5),
    ("M003", "033", "neutral", 1, 6),
    ("M003", "028", "angry", 3, 7),
    ("W036", "002", "happy", 2, 8),
    ("W017", "003", "sad", 1, 4),
]
EMOTIONS = ["neutral", "happy", "sad", "surprised", "fear", "disgusted", "angry", "contempt"]


def name_of(person, sentence, emotion, level):
    return f"{person}_{sentence}_{EMOTIONS.index(emotion)}_{level - 1}"


def coefficients(index, frames):
    generator = np.random.default_rng(index)
    widths = {"shape": 300, "exp": 100, "jaw": 3, "global_pose": 3}
    return {
        key: generator.normal(0, 0.1, (1, frames, width)).astype(np.float32) for key, width in widths.items()
    }


def write_audio(path, seconds, seed):
    """An AAC track in an .m4a container, as MEAD has them."""
    import av

    path.parent.mkdir(parents=True, exist_ok=True)
    generator = np.random.default_rng(seed)
    with av.open(str(path), "w", format="mp4") as file:
        stream = file.add_stream("aac", rate=48000)
        stream.layout = "mono"
        samples = generator.uniform(-0.5, 0.5, (1, round(seconds * 48000))).astype(np.float32)
        frame = av.AudioFrame.from_ndarray(samples, format="fltp", layout="mono")
        frame.rate, frame.pts = 48000, 0
        for packet in (*stream.encode(frame), *stream.encode(None)):
            file.mux(packet)


@pytest.fixture(scope="module")
def reconstructed(tmp_path_factory):
    """The folder of EMOTE's release, and MEAD's sound beside it."""
    root = tmp_path_factory.mktemp("mead")
    for index, (person, sentence, emotion, level, frames) in enumerate(TAKES):
        place = f"{emotion}/level_{level}/{sentence}"
        folder = root / "EMICA-MEAD_flame2020" / person / "front" / place
        folder.mkdir(parents=True)
        with h5py.File(folder / "shape_pose_cam.hdf5", "w") as file:
            for key, array in coefficients(index, frames).items():
                file[key] = array
            file["cam"] = np.zeros((1, frames, 3), np.float32)
        (folder / "appearance.hdf5").write_bytes(b"")
        write_audio(root / "MEAD_audio_source" / person / "audio" / f"{place}.m4a", frames / 25, index)
    return root


@pytest.fixture(scope="module")
def converted(tmp_path_factory):
    """The folder that ProbTalk3D's preprocessing writes."""
    root = tmp_path_factory.mktemp("probtalk3d")
    (root / "param").mkdir()
    for index, (person, sentence, emotion, level, frames) in enumerate(TAKES):
        name = name_of(person, sentence, emotion, level)
        arrays = coefficients(index, frames)
        joined = np.concatenate([arrays["shape"], arrays["exp"], arrays["jaw"]], axis=2)
        np.save(root / "param" / f"{name}.npy", joined)
        write_sound(root / "wav" / f"{name}.wav", frames / 25, 44100, index)
    (root / "param" / "README.md").write_text("put the files here")
    return root


@pytest.fixture
def copy(converted, tmp_path):
    return shutil.copytree(converted, tmp_path / "copy")


@pytest.mark.parametrize("layout", ["reconstructed", "converted"])
def test_both_layouts_read_the_same(request, layout):
    dataset = open_dataset(request.getfixturevalue(layout))
    assert isinstance(dataset, MeadDataset)
    assert (dataset.fps, dataset.mesh, dataset.head) == (25, None, "")
    assert set(dataset.sequences) == {name_of(*take[:4]) for take in TAKES}
    assert list(dataset.subjects) == ["M003", "W036", "W017"]
    assert dataset.splits == {
        "train": ("M003_001_0_0",),
        "val": ("M003_033_0_0",),
        "test": ("M003_028_6_2",),
        "prior_train": ("M003_001_0_0", "M003_028_6_2", "M003_033_0_0"),
        "prior_val": ("W036_002_1_1",),
        "prior_test": (),
    }
    info = dataset.info("M003_028_6_2")
    assert (info.subject, info.sentence, info.emotion, info.intensity) == ("M003", 28, "angry", 1.0)
    assert dataset.info("W036_002_1_1").intensity == pytest.approx(2 / 3)
    assert dataset.info("M003_001_0_0").intensity == 0
    sequence = dataset["M003_028_6_2"]
    expected = coefficients(2, 7)
    assert sequence.vertices.shape == (7, 0, 3)
    assert sequence.curves.shape == (7, 0)
    for ours, theirs in (("shape", "shape"), ("expression", "exp"), ("jaw", "jaw")):
        np.testing.assert_array_equal(sequence.coefficients[ours], expected[theirs][0])
    pose = expected["global_pose"][0] if layout == "reconstructed" else np.zeros((7, 3))
    np.testing.assert_array_equal(sequence.pose, pose)
    assert sequence.audio.rate == (48000 if layout == "reconstructed" else 44100)
    assert sequence.audio.duration == pytest.approx(7 / 25, abs=0.03)  # AAC comes in blocks of 1024
    mean = coefficients(0, 5)["shape"][0].mean(0)
    np.testing.assert_allclose(dataset.subjects["M003"].shape, mean, atol=1e-6)
    assert [line for line in dataset.check() if "in no split" not in line] == []
    assert [line for line in dataset.check() if "in no split" in line] == ["W017_003_2_0: in no split"]


def test_people_of_the_published_splits():
    assert [len(names) for names in PEOPLE.values()] == [32, 7, 8]
    assert len({name for names in PEOPLE.values() for name in names}) == 47
    assert PEOPLE["train"][17:19] == ("M031", "W009")


def test_vertices_by_a_head(reconstructed, tmp_path):
    head = f"flame:{write_flame(tmp_path)}"
    dataset = open_dataset(reconstructed, options=MeadOptions(head=head, stride=2))
    sequence = dataset["W036_002_1_1"]
    arrays = {key: torch.from_numpy(value[0, ::2]) for key, value in coefficients(3, 8).items()}
    flame = load_head(head)
    params = HeadParameters(shape=arrays["shape"], expression=arrays["exp"], jaw=arrays["jaw"])
    np.testing.assert_allclose(sequence.vertices, flame(params).numpy(), atol=1e-6)
    np.testing.assert_array_equal(sequence.pose, arrays["global_pose"].numpy())
    assert (dataset.fps, sequence.info.frames, len(sequence.coefficients["jaw"])) == (12.5, 4, 4)
    assert dataset.mesh.n_vertices == 5023
    subject = dataset.subjects["W036"]
    expected = flame.template(torch.from_numpy(coefficients(3, 8)["shape"][0].mean(0))[None])[0]
    np.testing.assert_allclose(subject.template, expected.numpy(), atol=1e-6)


def test_sound_elsewhere_and_missing(reconstructed, tmp_path):
    alone = shutil.copytree(reconstructed / "EMICA-MEAD_flame2020", tmp_path / "alone" / "here")
    dataset = open_dataset(alone)
    with pytest.raises(FileFormatError, match=r"M003.audio.neutral.level_1.001\.m4a is not a file"):
        dataset["M003_001_0_0"]
    elsewhere = reconstructed / "MEAD_audio_source"
    assert open_dataset(alone, options=MeadOptions(audio=elsewhere)).audio("M003_001_0_0").rate == 48000


def test_damage_is_listed(copy):
    param = copy / "param"
    whole = np.load(param / "M003_001_0_0.npy")
    np.save(param / "M003_001_0_0.npy", whole[:, :, :402])
    whole = np.load(param / "M003_033_0_0.npy")
    whole[0, 2, 301] = np.nan
    np.save(param / "M003_033_0_0.npy", whole)
    path = param / "M003_028_6_2.npy"
    path.write_bytes(path.read_bytes()[:-100])
    (copy / "wav" / "W036_002_1_1.wav").unlink()
    write_sound(copy / "wav" / "W017_003_2_0.wav", 1.0, 44100, 9)
    np.save(param / "W017_004_2_0.npy", np.array([{"a": 1}], object), allow_pickle=True)
    defects = open_dataset(copy).check()
    for expected in (
        "M003_001_0_0.npy holds float32 of shape (1, 5, 402), expected floats of (1, frames, 403)",
        "M003_033_0_0: expression is not finite",
        "M003_028_6_2.npy is damaged or cut short",
        "W036_002_1_1.wav is not a file",
        "W017_003_2_0: 0.16 s of motion and 1.00 s of sound: the motion is 21.0 frames too short",
        "W017_004_2_0.npy is damaged or cut short: Array can't be memory-mapped: Python objects",
    ):
        assert any(expected in line for line in defects), (expected, defects)


def test_damaged_hdf5(reconstructed, tmp_path):
    copy = shutil.copytree(reconstructed, tmp_path / "copy")
    front = copy / "EMICA-MEAD_flame2020" / "M003" / "front"
    cut = front / "neutral/level_1/001/shape_pose_cam.hdf5"
    cut.write_bytes(cut.read_bytes()[:500])
    with h5py.File(front / "neutral/level_1/033/shape_pose_cam.hdf5", "a") as file:
        del file["jaw"]
    with h5py.File(front / "angry/level_3/028/shape_pose_cam.hdf5", "a") as file:
        del file["jaw"]
        file["jaw"] = np.zeros((1, 6, 3), np.float32)
    defects = open_dataset(copy).check()
    for expected in (
        "M003_001_0_0: " + str(cut) + " is no whole HDF5 file",
        "lacks jaw; it has cam, exp, global_pose, shape",
        "has arrays of different length: {'shape': 7, 'exp': 7, 'jaw': 6, 'global_pose': 7}",
    ):
        assert any(expected in line for line in defects), (expected, defects)


def test_h5py_is_an_extra(reconstructed, converted, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    dataset = open_dataset(reconstructed)
    with pytest.raises(DependencyError, match=r"h5py is not installed.*meshanim\[data\]"):
        dataset["M003_001_0_0"]
    assert open_dataset(converted)["M003_001_0_0"].info.frames == 5


def test_what_is_no_mead(tmp_path, converted):
    (tmp_path / "param").mkdir()
    with pytest.raises(FileFormatError, match="mead: M003/front"):
        open_dataset(tmp_path)
    with pytest.raises(OptionError, match="no sequence 'M003_099_0_0'"):
        open_dataset(converted)["M003_099_0_0"]
