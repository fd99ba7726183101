"""DiffPoseTalk's LMDB as its script packs it, and damaged and malicious copies of it."""

import copy as copies
import io
import os
import pickle
import sys

import numpy as np
import pytest
import soundfile
import torch
from made_files import write_flame

from meshanim.datasets import open_dataset
from meshanim.datasets.diffposetalk import DiffPoseTalkDataset
from meshanim.datasets.flame_coefficients import CoefficientOptions
from meshanim.errors import DependencyError, FileFormatError
from meshanim.heads import HeadParameters, load_head

lmdb = pytest.importorskip("lmdb")

UNIT = 640  # samples a frame
VIDEOS = {"TH_00001/000": 230, "TH_00001/002": 100, "RD_Radio1/000": 40}
WIDTHS = {"shape": 100, "exp": 50, "pose": 6}


def coefficients(key):
    generator = np.random.default_rng(len(key) + VIDEOS[key])
    return {name: generator.normal(0, 0.3, (VIDEOS[key], w)).astype("<f4") for name, w in WIDTHS.items()}


def sound(key):
    generator = np.random.default_rng(VIDEOS[key])
    return generator.integers(-20000, 20000, VIDEOS[key] * UNIT).astype(np.int16)


def flac(samples, rate=16000):
    stream = io.BytesIO()
    soundfile.write(stream, samples, rate, format="FLAC", subtype="PCM_16")
    return stream.getvalue()


def content():
    """Keys and values, the values not yet pickled."""
    values = {"metadata": {"seg_len": 100}}
    for key, frames in VIDEOS.items():
        values[f"{key}/metadata"] = {"n_frames": frames}
        arrays, samples = coefficients(key), sound(key)
        for number, first in enumerate(range(0, frames, 100)):
            part = slice(first, min(first + 100, frames))
            values[f"{key}/{number:03d}"] = {
                "audio": flac(samples[part.start * UNIT : part.stop * UNIT]),
                "coef": {name: array[part] for name, array in arrays.items()},
            }
    return values


def write(folder, values):
    folder.mkdir(parents=True)
    with (
        lmdb.open(str(folder), map_size=1 << 26) as environment,
        environment.begin(write=True) as transaction,
    ):
        for key, value in values.items():
            raw = value if isinstance(value, bytes) else pickle.dumps(value, protocol=5)
            transaction.put(key.encode(), raw)
    (folder / "keys.txt").write_text("\n".join(VIDEOS))
    (folder / "train.txt").write_text("TH_00001/000\nTH_00001/002\n")
    (folder / "val.txt").write_text("RD_Radio1/000\n")
    (folder / "test.txt").write_text("")
    statistics = {
        f"{name}_{moment}": np.full(width, 2.0)
        for name, width in WIDTHS.items()
        for moment in ("mean", "std", "max", "min")
    }
    np.savez(folder / "stats_train.npz", **statistics)
    return folder


@pytest.fixture(scope="module")
def packed():
    return content()


@pytest.fixture
def tree(packed, tmp_path):
    return write(tmp_path / "HDTF_TFHP" / "lmdb", packed)


def test_clips_are_joined(tree):
    dataset = open_dataset(tree.parent)
    assert isinstance(dataset, DiffPoseTalkDataset)
    assert open_dataset(tree).sequences == dataset.sequences
    assert dataset.fps == 25
    assert dataset.sequences == ("RD_Radio1_000", "TH_00001_000", "TH_00001_002")
    assert list(dataset.subjects) == ["RD_Radio1", "TH_00001"]
    assert dataset.splits == {
        "train": ("TH_00001_000", "TH_00001_002"),
        "val": ("RD_Radio1_000",),
        "test": (),
    }
    sequence = dataset["TH_00001_000"]
    expected = coefficients("TH_00001/000")
    assert (sequence.info.frames, sequence.info.subject) == (230, "TH_00001")
    np.testing.assert_array_equal(sequence.coefficients["shape"], expected["shape"])
    np.testing.assert_array_equal(sequence.coefficients["expression"], expected["exp"])
    np.testing.assert_array_equal(sequence.pose, expected["pose"][:, :3])
    np.testing.assert_array_equal(sequence.coefficients["jaw"], expected["pose"][:, 3:])
    assert sequence.vertices.shape == (230, 0, 3)
    np.testing.assert_array_equal(sequence.audio.samples * 32768, sound("TH_00001/000"))
    np.testing.assert_allclose(dataset.subjects["TH_00001"].shape, expected["shape"][:100].mean(0), atol=1e-6)
    assert dataset.check() == []
    assert set(dataset.coefficient_statistics()) >= {"shape_mean", "pose_std", "exp_max"}


def test_vertices_by_a_head(tree, tmp_path):
    head = f"flame:{write_flame(tmp_path)}"
    dataset = open_dataset(tree, options=CoefficientOptions(head=head, stride=5))
    sequence = dataset["RD_Radio1_000"]
    arrays = {name: torch.from_numpy(array[::5]) for name, array in coefficients("RD_Radio1/000").items()}
    params = HeadParameters(shape=arrays["shape"], expression=arrays["exp"], jaw=arrays["pose"][:, 3:])
    np.testing.assert_allclose(sequence.vertices, load_head(head)(params).numpy(), atol=1e-6)
    assert (dataset.fps, sequence.info.frames, len(sequence.pose)) == (5, 8, 8)


def test_it_works_in_another_process_and_after_pickling(tree):
    dataset = open_dataset(tree)
    dataset.info("TH_00001_000")
    again = pickle.loads(pickle.dumps(dataset))
    assert again["TH_00001_000"].info == dataset["TH_00001_000"].info
    loader = torch.utils.data.DataLoader(
        [0, 1, 2], num_workers=1, collate_fn=lambda rows: dataset[rows[0]].info.frames
    )
    assert list(loader) == [40, 230, 100]


class Shout:
    def __reduce__(self):
        return os.system, ("touch pwned",)


@pytest.mark.parametrize("key", ["metadata", "TH_00001/000/metadata", "TH_00001/000/001"])
@pytest.mark.parametrize("inside", [False, True])
def test_a_malicious_pickle_is_refused_and_named(packed, tmp_path, monkeypatch, key, inside):
    monkeypatch.chdir(tmp_path)
    values = copies.deepcopy(packed)
    values[key] = {**values[key], "coef": [Shout()]} if inside else Shout()
    folder = write(tmp_path / "evil", values)
    message = rf"key {key} is not a whole pickle of arrays: it names (posix|nt)\.system"
    if key == "metadata":
        with pytest.raises(FileFormatError, match=message):
            open_dataset(folder)
    else:
        dataset = open_dataset(folder)
        with pytest.raises(FileFormatError, match=message):
            dataset["TH_00001_000"]
        assert any("system" in line and key in line for line in dataset.check())
    assert not (tmp_path / "pwned").exists()


def test_damage_is_listed(packed, tmp_path):
    values = copies.deepcopy(packed)
    del values["TH_00001/000/001"]
    values["TH_00001/002/000"]["coef"]["exp"] = values["TH_00001/002/000"]["coef"]["exp"][:99]
    values["RD_Radio1/000/000"]["coef"]["pose"][3, 1] = np.nan
    values["RD_Radio1/000/000"]["audio"] = flac(sound("RD_Radio1/000"), 8000)
    values["RD_Radio1/000/001"] = values["RD_Radio1/000/000"]
    folder = write(tmp_path / "damaged", values)
    (folder / "test.txt").write_text("TH_00009/000\n")
    (folder / "keys.txt").write_text("TH_00001/000\nTH_00001/002\nTH_00007/000\n")
    defects = open_dataset(folder).check()
    for expected in (
        "TH_00001_000: " + str(folder / "data.mdb") + ", key TH_00001/000/001 does not exist",
        "key TH_00001/002/000: exp has shape (99, 50), not (100, 50)",
        "RD_Radio1_000: pose is not finite",
        "key RD_Radio1/000/000: audio has 8000 Hz, expected 16000",
        "RD_Radio1_000: 1 clips beyond its frames, the first is RD_Radio1/000/001",
        "TH_00009_000: split test names it, but there is no such sequence",
        "keys.txt names 1 videos that are not in data.mdb, such as TH_00007/000",
        "keys.txt lacks 1 videos of data.mdb, such as RD_Radio1/000",
    ):
        assert any(expected in line for line in defects), (expected, defects)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"audio": b"fLaC"}, "audio is no whole flac file"),
        ({"audio": "wav"}, "audio is str, expected a flac file's bytes"),
        ({"coef": None}, "no clip: expected a dictionary of coef and audio"),
        ({"coef": {}}, r"shape has shape \(\), not \(40, 100\)"),
    ],
)
def test_a_damaged_clip(packed, tmp_path, change, message):
    values = copies.deepcopy(packed)
    values["RD_Radio1/000/000"] |= change
    dataset = open_dataset(write(tmp_path / "damaged", values))
    with pytest.raises(FileFormatError, match=rf"key RD_Radio1/000/000.*{message}"):
        dataset["RD_Radio1_000"]


def test_a_damaged_database(packed, tmp_path):
    values = {**packed, "TH_00001/002/metadata": {"n_frames": "many"}, "RD_Radio1/000/metadata": b"\x80"}
    dataset = open_dataset(write(tmp_path / "values", values))
    with pytest.raises(FileFormatError, match="n_frames 'many', expected a number of frames"):
        dataset.info("TH_00001_002")
    with pytest.raises(FileFormatError, match="RD_Radio1/000/metadata is not a whole pickle"):
        dataset.info("RD_Radio1_000")
    with pytest.raises(FileFormatError, match=r"no key PERSON/VIDEO/metadata"):
        open_dataset(write(tmp_path / "empty", {"metadata": {"seg_len": 100}}))
    folder = write(tmp_path / "cut", packed)
    (folder / "data.mdb").write_bytes(b"not a database" * 1000)
    with pytest.raises(FileFormatError, match="is no whole LMDB"):
        open_dataset(folder)
    (tmp_path / "values" / "stats_train.npz").write_bytes(b"PK")
    with pytest.raises(FileFormatError, match=r"stats_train\.npz"):
        dataset.coefficient_statistics()


def test_lmdb_is_an_extra(tree, monkeypatch):
    monkeypatch.setitem(sys.modules, "lmdb", None)
    with pytest.raises(DependencyError, match=r"lmdb is not installed.*meshanim\[data\]"):
        open_dataset(tree)
