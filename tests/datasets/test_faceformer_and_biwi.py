"""FaceFormer's layout of VOCASET and BIWI, and BIWI's raw files."""

import re
import shutil

import numpy as np
import pytest
import soundfile
import trimesh
from small_trees import (
    VOCASET_PEOPLE,
    motion_of,
    small_faces,
    small_mesh,
    template_of,
    write_biwi_raw,
    write_faceformer,
)

from meshanim.datasets import (
    BiwiDataset,
    BiwiOptions,
    FaceFormerDataset,
    FaceFormerOptions,
    open_dataset,
)
from meshanim.datasets.biwi import area_normalised, read_vl
from meshanim.datasets.published import BIWI
from meshanim.errors import FileFormatError, OptionError

TRAIN, VAL, TEST = VOCASET_PEOPLE
BIWI_NAMES = [("F2", "e01", 1), ("F2", "e33", 33), ("F2", "e37", 37), ("M1", "e01", 1), ("M1", "e40", 40)]


@pytest.fixture(autouse=True)
def small(monkeypatch):
    small_faces(monkeypatch)


@pytest.fixture
def vocaset(tmp_path):
    names = [(person, f"sentence{n:02d}", n) for person in VOCASET_PEOPLE for n in (3, 21)]
    return write_faceformer(tmp_path / "vocaset", names, 60)


@pytest.fixture
def biwi(tmp_path):
    return write_faceformer(tmp_path / "BIWI", BIWI_NAMES, 25, np.float64, 44100)


def test_vocaset_is_told_by_its_subjects(vocaset):
    dataset = open_dataset(vocaset)
    assert isinstance(dataset, FaceFormerDataset)
    assert (dataset.name, dataset.fps, dataset.unit) == ("vocaset", 60, "m")
    assert list(dataset.subjects) == list(VOCASET_PEOPLE)
    assert dataset.split("val") == (f"{VAL}_sentence21",)
    assert dataset.split("spare") == (f"{TEST}_sentence03", f"{VAL}_sentence03")
    sequence = dataset[f"{TRAIN}_sentence03"]
    assert isinstance(sequence.vertices, np.memmap)
    assert np.array_equal(sequence.vertices, motion_of(TRAIN, 3, 23))
    assert dataset.mesh is None
    assert dataset.check() == []
    halved = open_dataset(vocaset, options=FaceFormerOptions(stride=2))
    assert (halved.fps, halved.info(f"{TRAIN}_sentence03").frames) == (30, 12)
    assert halved.check() == []


def test_biwi_keeps_its_unit_and_has_both_tests(biwi):
    dataset = open_dataset(biwi)
    assert (dataset.name, dataset.fps, dataset.unit) == ("biwi", 25, "biwi")
    sizes = {split: len(names) for split, names in dataset.splits.items()}
    assert sizes == {"train": 1, "val": 1, "test_a": 1, "test_b": 1, "test": 2, "spare": 1}
    assert dataset.split("test_b") == ("M1_e40",)
    sequence = dataset["F2_e33"]
    assert (sequence.info.subject, sequence.info.sentence) == ("F2", 33)
    assert np.array_equal(sequence.vertices, motion_of("F2", 33, 23))
    assert sequence.audio.rate == 44100
    assert dataset.check() == []


def test_biwis_lists_are_complete():
    sizes = {
        split: sum(len(p.subjects) * len(p.sentences) for p in parts) for split, parts in BIWI.splits.items()
    }
    assert sizes == {"train": 192, "val": 24, "test_a": 24, "test_b": 32, "test": 56}
    assert len(BIWI.subjects) == 14


def test_other_data_needs_a_rate(tmp_path):
    tree = write_faceformer(tmp_path, [("anna", "hello01", 1)], 30)
    with pytest.raises(OptionError, match="--fps"):
        open_dataset(tree)
    dataset = open_dataset(tree, options=FaceFormerOptions(fps=30))
    assert dataset.splits == {}
    assert dataset.check() == []
    millimetres = open_dataset(tree, options=FaceFormerOptions(fps=30, scale=0.001))
    assert np.allclose(millimetres[0].vertices, motion_of("anna", 1, 21) * 0.001)
    assert np.allclose(millimetres.subjects["anna"].template, template_of("anna") * 0.001)
    with pytest.raises(OptionError, match="no published data set 'vocset'"):
        FaceFormerOptions(published="vocset")


def test_faces_come_from_templates_or_an_option(vocaset):
    mesh = small_mesh()
    path = vocaset / "templates" / "FLAME_sample.ply"
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(path)
    assert np.array_equal(open_dataset(vocaset).mesh.faces, mesh.faces)
    other = path.rename(vocaset / "face.ply")
    assert np.array_equal(
        open_dataset(vocaset, options=FaceFormerOptions(faces=other)).mesh.faces, mesh.faces
    )


def cut(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def change(path, function):
    np.save(path, function(np.load(path)))


def silence(path):
    samples, rate = soundfile.read(path, dtype="int16")
    soundfile.write(path, samples * 0, rate)


def relabel(path, rate):
    samples, _ = soundfile.read(path, dtype="int16")
    soundfile.write(path, samples, rate)


NAME = f"{TRAIN}_sentence03"
DAMAGE = {
    "is not a file": lambda tree: (tree / "wav" / f"{NAME}.wav").unlink(),
    "cannot be read as sound": lambda tree: (tree / "wav" / f"{NAME}.wav").write_bytes(b"no sound"),
    "cut short": lambda tree: cut(tree / "vertices_npy" / f"{NAME}.npy"),
    r"not finite in 1 frames, the first is 4": lambda tree: change(
        tree / "vertices_npy" / f"{NAME}.npy", lambda a: np.where(np.arange(len(a))[:, None] == 4, np.nan, a)
    ),
    r"expected \(frames, 126\)": lambda tree: change(
        tree / "vertices_npy" / f"{NAME}.npy", lambda a: a[:, :-3]
    ),
    "silent": lambda tree: silence(tree / "wav" / f"{NAME}.wav"),
    "11.5 frames too long": lambda tree: relabel(tree / "wav" / f"{NAME}.wav", 32000),
    r"_sentence21: the same sound as .*03: duplicated": lambda tree: shutil.copy(
        tree / "wav" / f"{NAME}.wav", tree / "wav" / f"{TRAIN}_sentence21.wav"
    ),
    r"_sentence21: the same motion as .*03: duplicated": lambda tree: shutil.copy(
        tree / "vertices_npy" / f"{NAME}.npy", tree / "vertices_npy" / f"{TRAIN}_sentence21.npy"
    ),
    "wrong unit": lambda tree: change(tree / "vertices_npy" / f"{NAME}.npy", lambda a: a * 1000),
    "no subject 'Nobody'": lambda tree: shutil.copy(
        tree / "vertices_npy" / f"{NAME}.npy", tree / "vertices_npy" / "Nobody_sentence01.npy"
    ),
}


@pytest.mark.parametrize("message", DAMAGE)
def test_damage_is_listed_with_the_sequence(vocaset, message):
    DAMAGE[message](vocaset)
    faults = open_dataset(vocaset).check()
    assert any(re.search(message, fault) for fault in faults), faults
    assert all(TRAIN in fault or "Nobody" in fault for fault in faults)
    assert len(faults) <= 5


def test_raw_biwi_in_metres(tmp_path):
    dataset = open_dataset(write_biwi_raw(tmp_path))
    assert isinstance(dataset, BiwiDataset)
    assert (dataset.unit, dataset.fps, list(dataset.subjects)) == ("m", 25, ["F2", "F1"])
    assert np.allclose(dataset.subjects["F2"].template, template_of("F2"), atol=1e-6)
    assert np.array_equal(dataset.mesh.faces, small_mesh().faces)
    sequence = dataset["F2_e37"]
    assert np.allclose(sequence.vertices, motion_of("F2", 37, 12), atol=1e-6)
    assert (sequence.info.sentence, sequence.info.emotion) == (37, "emotional")
    assert sequence.audio.rate == 44100
    assert dataset.info("F2_05").emotion == "neutral"
    assert dataset.split("test_a") == ("F2_e37",)
    assert dataset.split("test_b") == ("F1_e37",)
    assert set(dataset.split("spare")) == {"F1_05", "F1_e01", "F2_05"}
    assert dataset.check() == []
    assert len(open_dataset(tmp_path, options=BiwiOptions(stride=5))[0]) == 3


def test_codetalkers_preprocessing_gives_faces_of_area_one(tmp_path):
    dataset = open_dataset(write_biwi_raw(tmp_path), options=BiwiOptions(preprocess="codetalker"))
    assert dataset.unit == "biwi"
    mesh = small_mesh()
    for vertices in (*dataset["F2_e37"].vertices[:3], dataset.subjects["F1"].template):
        assert trimesh.Trimesh(vertices, mesh.faces, process=False).area == pytest.approx(1, abs=1e-5)
        assert np.abs(vertices.mean(0)).max() < 1e-6
    own = motion_of("F2", 37, 12)[0].astype(np.float64)
    expected = area_normalised(own, mesh.faces)
    assert np.allclose(dataset["F2_e37"].vertices[0], expected, atol=1e-6)
    with pytest.raises(OptionError, match="metres or codetalker"):
        BiwiOptions(preprocess="metre")


def test_damaged_frames_are_named(tmp_path):
    tree = write_biwi_raw(tmp_path)
    folder = tree / "faces" / "F2" / "e01"
    cut(folder / "frame_003.vl")
    with pytest.raises(FileFormatError, match=r"frame_003\.vl.*cut short"):
        read_vl(folder / "frame_003.vl")
    (tree / "faces" / "F1" / "e01" / "frame_004.vl").unlink()
    (tree / "audio" / "F1" / "e37.wav").unlink()
    short = tree / "faces" / "F1" / "05" / "frame_002.vl"
    short.write_bytes((41).to_bytes(4, "little") + short.read_bytes()[4 : 4 + 41 * 12])
    faults = open_dataset(tree).check()
    assert len(faults) == 4
    for part in ("frame_003.vl", "no frame 4", "F1_e37.wav is not a file", "41 vertices, the templates 42"):
        assert any(part in fault for fault in faults), (part, faults)
