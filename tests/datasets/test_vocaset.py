"""VOCASET as VOCA reads it: rows out of order, pickles of Python 2, a file too big for memory."""

import os
import pickle
import re

import numpy as np
import pytest
from small_trees import VOCASET_SENTENCES, motion_of, python_2_pickle, template_of, write_vocaset

from meshanim.datasets import VocasetDataset, VocasetOptions, open_dataset
from meshanim.datasets.published import VOCASET
from meshanim.errors import FileFormatError, OptionError

TRAIN, VAL, TEST = VOCASET_SENTENCES


@pytest.fixture
def tree(tmp_path):
    return write_vocaset(tmp_path / "vocaset")


def test_sequences_come_back_in_the_order_of_their_frames(tree):
    dataset = open_dataset(tree)
    assert isinstance(dataset, VocasetDataset)
    assert (dataset.fps, dataset.unit, len(dataset)) == (60, "m", 8)
    for person, sentences in VOCASET_SENTENCES.items():
        for number in sentences:
            sequence = dataset[f"{person}_sentence{number:02d}"]
            assert np.array_equal(sequence.vertices, motion_of(person, number, 30 + number % 5))
            assert (sequence.info.subject, sequence.info.sentence) == (person, number)
            assert sequence.audio.rate == 22000
            assert np.allclose(dataset.subjects[person].template, template_of(person), atol=1e-7)
    assert dataset.check() == []


def test_contiguous_rows_are_views_of_the_file(tree):
    dataset = open_dataset(tree)
    assert isinstance(dataset[f"{TRAIN}_sentence01"].vertices, np.memmap)
    assert np.shares_memory(dataset[f"{TRAIN}_sentence01"].vertices, dataset._vertices)
    halved = open_dataset(tree, options=VocasetOptions(stride=2))
    assert halved.fps == 30
    whole = dataset[f"{TRAIN}_sentence01"].vertices
    assert np.array_equal(halved[f"{TRAIN}_sentence01"].vertices, whole[::2])
    assert isinstance(halved[f"{TRAIN}_sentence01"].vertices, np.memmap)
    assert len(halved[f"{TRAIN}_sentence01"]) == len(whole[::2])


@pytest.mark.parametrize("dtype", [np.float64, ">f4"])
def test_other_floats_become_float32(tmp_path, dtype):
    dataset = open_dataset(write_vocaset(tmp_path, dtype))
    vertices = dataset[f"{TRAIN}_sentence40"].vertices
    assert vertices.dtype == np.float32
    assert vertices.dtype.isnative
    assert np.array_equal(vertices, motion_of(TRAIN, 40, 30))


def test_splits_are_the_published_ones(tree):
    dataset = open_dataset(tree)
    assert list(dataset.subjects) == [TRAIN, VAL, TEST]
    assert dataset.split("train") == tuple(f"{TRAIN}_sentence{n:02d}" for n in (1, 2, 40))
    assert dataset.split("val") == (f"{VAL}_sentence21",)
    assert dataset.split("test") == tuple(f"{TEST}_sentence{n:02d}" for n in (22, 40))
    assert set(dataset.split("spare")) == {f"{VAL}_sentence01", f"{TEST}_sentence20"}
    with pytest.raises(OptionError, match="train, val, test, spare"):
        dataset.split("trian")


def test_the_published_lists_are_complete():
    assert [len(parts[0].subjects) for parts in VOCASET.splits.values()] == [8, 2, 2]
    assert VOCASET.subjects[0] == "FaceTalk_170728_03272_TA"
    assert len(VOCASET.subjects) == 12
    assert VOCASET.splits["test"][0].sentences == range(21, 41)
    assert VOCASET.number("sentence07") == 7
    assert VOCASET.number("frown") is None


def test_integers_of_any_type_are_16_bit_samples(tree):
    sounds = pickle.loads((tree / "raw_audio_fixed.pkl").read_bytes(), encoding="latin1")
    entry = sounds[TRAIN]["sentence01"]
    samples = entry["audio"]
    entry["audio"] = samples.astype(np.int64)
    (tree / "raw_audio_fixed.pkl").write_bytes(python_2_pickle(sounds))
    audio = open_dataset(tree).audio(f"{TRAIN}_sentence01")
    assert np.array_equal(audio.samples * 32768, samples)
    entry["audio"] = samples.astype(np.int64) * 70000
    (tree / "raw_audio_fixed.pkl").write_bytes(python_2_pickle(sounds))
    with pytest.raises(FileFormatError, match="beyond 16 bits"):
        open_dataset(tree).audio(f"{TRAIN}_sentence01")


def test_the_sounds_are_loaded_once_and_not_to_open(tree, monkeypatch):
    (tree / "raw_audio_fixed.pkl").rename(tree / "elsewhere")
    dataset = open_dataset(tree)
    assert dataset.info(f"{TRAIN}_sentence01").frames == 31
    (tree / "elsewhere").rename(tree / "raw_audio_fixed.pkl")
    assert dataset.audio(f"{TRAIN}_sentence01").duration == pytest.approx(31 / 60, abs=1e-3)
    (tree / "raw_audio_fixed.pkl").unlink()
    assert len(dataset.audio(f"{TEST}_sentence40").samples)


def resident() -> int:
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.skipif(not os.path.exists("/proc/self/statm"), reason="measures memory by /proc")
def test_six_gigabytes_cost_no_memory(tree):
    frames = 12_000_000  # of 42 vertices: 6.0 GB, a hole in the file
    with open(tree / "data_verts.npy", "wb") as file:
        np.lib.format.write_array_header_1_0(
            file, {"descr": "<f4", "fortran_order": False, "shape": (frames, 42, 3)}
        )
        file.truncate(file.tell() + frames * 42 * 3 * 4)
    index = {TRAIN: {"sentence01": {frame: frame for frame in range(0, frames, 400_000)}}}
    index[TRAIN]["sentence02"] = {frame: 5_000_000 + frame for frame in range(100)}
    (tree / "subj_seq_to_idx.pkl").write_bytes(python_2_pickle(index))
    before = resident()
    dataset = open_dataset(tree)
    assert dataset._vertices.nbytes > 6e9
    for name in dataset.sequences:
        assert not dataset.motion(name).vertices.any()
    assert resident() - before < 20e6


DAMAGE = {
    "cut short": lambda tree: cut(tree / "data_verts.npy"),
    "not finite": lambda tree: spoil(tree, np.nan),
    "duplicated sentence": lambda tree: index_of(tree, f"{TRAIN}/sentence01", f"{TRAIN}/sentence02"),
    "names row": lambda tree: shorten(tree),
    "has no sound": lambda tree: change_sound(tree, dict.clear, drop=True),
    "silent": lambda tree: change_sound(tree, lambda entry: entry.update(audio=entry["audio"] * 0)),
    "frames too long": lambda tree: change_sound(tree, lambda entry: entry.update(sample_rate=44000)),
    "expected audio and sample_rate": lambda tree: change_sound(tree, lambda e: e.pop("sample_rate")),
    "expected \\(frames, 42, 3\\)": lambda tree: np.save(tree / "data_verts.npy", np.zeros((300, 41, 3))),
    "no subject": lambda tree: forget(tree, VAL),
}


def cut(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def spoil(tree, value):
    vertices = np.load(tree / "data_verts.npy")
    vertices[5, 7] = value
    np.save(tree / "data_verts.npy", vertices)


def shorten(tree):
    np.save(tree / "data_verts.npy", np.load(tree / "data_verts.npy")[:-1])


def index_of(tree, target, source):
    index = pickle.loads((tree / "subj_seq_to_idx.pkl").read_bytes(), encoding="latin1")
    (person, one), (_, other) = target.split("/"), source.split("/")
    index[person][one] = index[person][other]
    (tree / "subj_seq_to_idx.pkl").write_bytes(python_2_pickle(index))


def change_sound(tree, change, drop=False):
    sounds = pickle.loads((tree / "raw_audio_fixed.pkl").read_bytes(), encoding="latin1")
    change(sounds[TRAIN]["sentence01"])
    if drop:
        del sounds[TRAIN]["sentence01"]
    (tree / "raw_audio_fixed.pkl").write_bytes(python_2_pickle(sounds))


def forget(tree, person):
    templates = pickle.loads((tree / "templates.pkl").read_bytes(), encoding="latin1")
    del templates[person]
    (tree / "templates.pkl").write_bytes(python_2_pickle(templates))


@pytest.mark.parametrize("message", DAMAGE)
def test_damage_is_listed(tree, message):
    DAMAGE[message](tree)
    faults = open_dataset(tree).check()
    assert any(re.search(message, fault) for fault in faults), faults
    assert len(faults) <= 3, faults


@pytest.mark.parametrize("file", ["templates.pkl", "subj_seq_to_idx.pkl", "raw_audio_fixed.pkl"])
def test_a_pickle_with_code_is_refused_and_named(tree, file):
    (tree / file).write_bytes(b"cos\nsystem\n(S'touch hacked'\ntR.")
    with pytest.raises(FileFormatError, match=rf"{file}.*os\.system"):
        open_dataset(tree).audio(f"{TRAIN}_sentence01")
