"""Conversion: nothing is lost, an interrupted run goes on, what is wrong is said."""

import json
import os
import pickle
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
import soundfile
import trimesh
from small_trees import (
    small_faces,
    small_mesh,
    write_biwi_raw,
    write_faceformer,
    write_vocaset,
)

from meshanim.audio import Waveform
from meshanim.cli import main
from meshanim.datasets import (
    BiwiOptions,
    FaceFormerDataset,
    FaceFormerOptions,
    MeshanimDataset,
    MotionSequence,
    SequenceInfo,
    Subject,
    VocasetOptions,
    conversion,
    convert,
    open_dataset,
)
from meshanim.datasets.conversion import SequenceJob, convert_sequence
from meshanim.datasets.meshanim_format import write_dataset, write_sequence, write_subject
from meshanim.errors import FileFormatError, OptionError


@pytest.fixture(autouse=True)
def small(monkeypatch):
    small_faces(monkeypatch)


@pytest.fixture
def rich(tmp_path):
    """Everything the own layout can hold: free names, pose, curves, coefficients, emotions, odd sounds."""
    directory = tmp_path / "rich"
    mesh = small_mesh()
    generator = np.random.default_rng(0)
    subjects = [
        Subject("zoe-2", (mesh.vertices * 1.1).astype(np.float32), np.ones(3, np.float32), {"voice": "low"}),
        Subject("adam_X", mesh.vertices.astype(np.float32), np.zeros(3, np.float32), {"age": 40}),
    ]
    names = ["take one (äß)", "adam_X_sentence07", "zoe-2_e03"]
    sounds = [
        generator.integers(-32768, 32767, 16000).astype(np.float32) / 32768,
        generator.normal(size=44100).astype(np.float32),
        generator.uniform(-1, 1, 22050).astype(np.float32),
    ]
    for place, (name, samples) in enumerate(zip(names, sounds)):
        subject, frames = subjects[place % 2], 25
        info = SequenceInfo(
            subject.name,
            place + 1,
            f"text {place}",
            25.0,
            frames,
            ((0.1, 0.2, "AA"),),
            "joy",
            0.25 * place,
            "somebody",
            name,
        )
        vertices = (subject.template + 0.002 * generator.normal(size=(frames, 42, 3))).astype(np.float32)
        sequence = MotionSequence(
            info,
            vertices,
            generator.normal(size=(frames, 3)).astype(np.float32),
            generator.random(size=(frames, 2)).astype(np.float32),
            Waveform(samples, (16000, 44100, 22050)[place]),
            {"jaw": generator.normal(size=(frames, 3)), "shape": np.arange(4, dtype=np.int32)}
            if place
            else {},
        )
        write_sequence(directory, sequence, lossless=True)
    for subject in subjects:
        write_subject(directory, subject)
    splits = {"train": names[:2], "test_odd": names[2:]}
    write_dataset(directory, "rich", 25.0, "", mesh, ["smile", "frown"], subjects, splits)
    return directory


def assert_same(first, second):
    """Two data sets hold the same, bit by bit."""
    assert first.sequences == second.sequences
    for key in ("name", "fps", "unit", "head", "curve_names", "splits"):
        assert getattr(first, key) == getattr(second, key), key
    assert list(first.subjects) == list(second.subjects)
    for name, subject in first.subjects.items():
        other = second.subjects[name]
        assert np.array_equal(subject.template, other.template)
        assert np.array_equal(subject.shape, other.shape)
        assert subject.attributes == other.attributes
    assert (first.mesh is None) == (second.mesh is None)
    if first.mesh is not None:
        assert np.array_equal(first.mesh.faces, second.mesh.faces)
        assert np.array_equal(np.float32(first.mesh.vertices), np.float32(second.mesh.vertices))
    for name in first.sequences:
        one, other = first[name], second[name]
        assert one.info == other.info
        assert np.array_equal(one.vertices, other.vertices)
        assert np.array_equal(one.pose, other.pose)
        assert np.array_equal(one.curves, other.curves)
        assert one.audio.rate == other.audio.rate
        assert np.array_equal(one.audio.samples, other.audio.samples)
        assert set(one.coefficients) == set(other.coefficients)
        for key, array in one.coefficients.items():
            assert array.dtype == other.coefficients[key].dtype
            assert np.array_equal(array, other.coefficients[key])


def test_the_own_layout_goes_to_faceformers_and_back(rich, tmp_path):
    original = open_dataset(rich)
    assert isinstance(original, MeshanimDataset)
    assert original.check() == []
    assert convert(original, tmp_path / "ff", "faceformer", workers=1).sequences == 3
    between = open_dataset(tmp_path / "ff")
    assert isinstance(between, FaceFormerDataset)
    assert_same(original, between)
    assert between.check() == []
    convert(between, tmp_path / "back", workers=1)
    back = open_dataset(tmp_path / "back")
    assert isinstance(back, MeshanimDataset)
    assert_same(original, back)
    stems = {path.stem for path in (tmp_path / "ff" / "vertices_npy").iterdir()}
    assert stems == {path.stem for path in (tmp_path / "ff" / "wav").iterdir()}
    assert all(stem.rpartition("_")[0] in original.subjects for stem in stems)


def trees(tmp_path):
    mesh = small_mesh()
    faces = tmp_path / "FLAME_sample.ply"
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(faces)
    people = [("F2", "e01", 1), ("M1", "e38", 38)]
    return {
        "vocaset": open_dataset(write_vocaset(tmp_path / "a"), options=VocasetOptions(faces=faces)),
        "vocaset without faces": open_dataset(write_vocaset(tmp_path / "b", np.float64)),
        "biwi": open_dataset(write_faceformer(tmp_path / "c", people, 25, rate=44100)),
        "raw biwi": open_dataset(write_biwi_raw(tmp_path / "d"), options=BiwiOptions(2, "codetalker")),
    }


def test_every_layout_goes_both_ways(tmp_path):
    for number, dataset in enumerate(trees(tmp_path).values()):
        for format in ("meshanim", "faceformer"):
            first = convert(dataset, tmp_path / f"{number}{format}", format, workers=1)
            assert_same(dataset, open_dataset(first.directory))
            assert open_dataset(first.directory).check() == []


def test_files_of_sound_are_copied_with_their_channels(tmp_path):
    tree = write_faceformer(tmp_path / "ff", [("F2", "e01", 1)], 25)
    samples = np.random.default_rng(0).integers(-999, 999, (16000 * 21 // 25, 2)).astype(np.int32) << 8
    soundfile.write(tree / "wav" / "F2_e01.wav", samples, 16000, subtype="PCM_24")
    convert(open_dataset(tree), tmp_path / "own", workers=1)
    copied = tmp_path / "own" / "sequences" / "F2_e01" / "audio.wav"
    assert copied.read_bytes() == (tree / "wav" / "F2_e01.wav").read_bytes()


def test_faceformers_own_loader_finds_what_it_expects(tmp_path):
    """What the public loader does: os.listdir(wav), [T, V * 3] by the wav's name, templates by subject."""
    dataset = open_dataset(write_vocaset(tmp_path / "vocaset"))
    convert(dataset, tmp_path / "ff", "faceformer", workers=1)
    with open(tmp_path / "ff" / "templates.pkl", "rb") as file:
        templates = pickle.load(file, encoding="latin1")
    for wav in os.listdir(tmp_path / "ff" / "wav"):
        vertices = np.load(tmp_path / "ff" / "vertices_npy" / wav.replace("wav", "npy"))
        subject = "_".join(wav.split("_")[:-1])
        assert vertices.shape[1] == templates[subject].size
        assert 1 <= int(wav.split(".")[0][-2:]) <= 40


def test_an_interrupted_run_goes_on(rich, tmp_path, monkeypatch):
    written = []

    def failing(directory, sequence, *rest, **more):
        if len(written) == 2:
            raise KeyboardInterrupt
        written.append(sequence.info.name)
        write_sequence(directory, sequence, *rest, **more)

    target = tmp_path / "own"
    monkeypatch.setattr(conversion, "write_sequence", failing)
    with pytest.raises(KeyboardInterrupt):
        convert(open_dataset(rich), target, workers=1)
    with pytest.raises(FileFormatError, match="not finished"):
        open_dataset(target)
    half = target / "sequences" / ".half-x"
    half.mkdir()
    (half / "vertices.npy").write_bytes(b"half")
    kept = target / "sequences" / written[0] / "vertices.npy"
    before = kept.stat().st_mtime_ns
    monkeypatch.undo()
    done = convert(open_dataset(rich), target, workers=1)
    assert (done.sequences, done.kept) == (3, 2)
    assert kept.stat().st_mtime_ns == before
    assert not half.exists()
    assert_same(open_dataset(rich), open_dataset(target))


def test_a_killed_process_leaves_nothing_half_written(tmp_path):
    """SIGKILL in the middle of the writing: every sequence that is there is whole."""
    names = [("F2", f"e{n:02d}", n) for n in range(1, 31)]
    tree = write_faceformer(tmp_path / "ff", names, 25)
    target = tmp_path / "own"
    script = (
        "import sys, time, numpy as np\n"
        "from meshanim.datasets import FaceFormerOptions, convert, open_dataset\n"
        "save = np.save\n"
        "def slow(path, array):\n"
        "    with open(path, 'wb') as file:\n"
        "        save(file, array)\n"
        "        size = file.tell(); file.truncate(size // 2); file.flush(); time.sleep(0.03)\n"
        "        file.seek(0); save(file, array)\n"
        "np.save = slow\n"
        "options = FaceFormerOptions(fps=25.0)\n"
        f"convert(open_dataset({str(tree)!r}, options=options), {str(target)!r}, workers=1)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", script])
    while process.poll() is None and len(list(target.glob("sequences/F2*"))) < 3:
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    there = list(target.glob("sequences/F2*"))
    assert 3 <= len(there) < 30
    original = open_dataset(tree, options=FaceFormerOptions(fps=25.0))
    for folder in there:
        assert np.array_equal(np.load(folder / "vertices.npy"), original[folder.name].vertices)
    done = convert(original, target, workers=1)
    assert (done.sequences, done.kept) == (30, len(there))
    assert open_dataset(target).check() == []


def test_processes_do_what_one_does(rich, tmp_path):
    convert(open_dataset(rich), tmp_path / "two", workers=2)
    assert_same(open_dataset(rich), open_dataset(tmp_path / "two"))
    (tmp_path / "two" / "sequences" / "zoe-2_e03" / "audio.wav").unlink()
    assert open_dataset(tmp_path / "two").check(workers=2) == open_dataset(tmp_path / "two").check()


def test_a_job_is_done_once(rich, tmp_path):
    (tmp_path / "own").mkdir()
    source = open_dataset(rich).source
    job = SequenceJob(source, "zoe-2_e03", tmp_path / "own", "meshanim")
    assert convert_sequence(job) == ("zoe-2_e03", "")
    written = tmp_path / "own" / "sequences" / "zoe-2_e03" / "vertices.npy"
    before = written.stat().st_mtime_ns
    convert_sequence(job)
    assert written.stat().st_mtime_ns == before


def test_foreign_folders_are_left_alone(rich, tmp_path):
    dataset = open_dataset(rich)
    with pytest.raises(OptionError, match="into itself"):
        convert(dataset, rich)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "note.txt").write_text("mine")
    with pytest.raises(OptionError, match="not empty"):
        convert(dataset, tmp_path / "mine")
    convert(dataset, tmp_path / "own", workers=1)
    with pytest.raises(OptionError, match="begun with format meshanim"):
        convert(dataset, tmp_path / "own", "faceformer")
    with pytest.raises(OptionError, match="no format 'usd'"):
        convert(dataset, tmp_path / "other", "usd")


def test_what_cannot_be_read_stops_or_is_left_out(rich, tmp_path):
    (rich / "sequences" / "zoe-2_e03" / "audio.wav").write_bytes(b"no sound")
    dataset = open_dataset(rich)
    with pytest.raises(FileFormatError, match="cannot be read as sound"):
        convert(dataset, tmp_path / "own", workers=1)
    done = convert(dataset, tmp_path / "own", workers=1, skip_defects=True)
    assert list(done.skipped) == ["zoe-2_e03"]
    new = open_dataset(tmp_path / "own")
    assert new.split("test_odd") == ()
    assert len(new) == 2
    assert new.check() == []


def test_bad_names_are_refused(rich, tmp_path):
    sequence = open_dataset(rich)[0]
    for name in (".hidden", "a/b", "..", "a\\b"):
        with pytest.raises(OptionError, match="cannot name a sequence"):
            write_sequence(tmp_path, replace(sequence, info=replace(sequence.info, name=name)))
    with pytest.raises(OptionError, match="letters, digits"):
        write_subject(tmp_path, Subject("../x", np.zeros((1, 3), np.float32)))


def test_version_1_is_read(rich, tmp_path):
    """As it was: units, no unit; sequences without name; SUBJECT_sentenceNN."""
    old = tmp_path / "old"
    shutil.copytree(rich, old)
    for name in ("take one (äß)", "zoe-2_e03"):
        shutil.rmtree(old / "sequences" / name)
    (old / "sequences" / "adam_X_sentence07" / "coefficients.safetensors").unlink()
    record = json.loads((old / "dataset.json").read_text())
    for key in ("unit", "topology", "stems"):
        del record[key]
    record |= {"version": 1, "units": "m", "splits": {"train": ["adam_X_sentence07"]}}
    (old / "dataset.json").write_text(json.dumps(record))
    path = old / "sequences" / "adam_X_sentence07" / "sequence.json"
    info = json.loads(path.read_text()) | {"sentence": 7}
    del info["name"]
    path.write_text(json.dumps(info))
    dataset = open_dataset(old)
    assert dataset.check() == []
    assert dataset[0].info.name == "adam_X_sentence07"
    assert dataset.unit == "m"
    (old / "dataset.json").write_text(json.dumps(record | {"units": "mm"}))
    with pytest.raises(FileFormatError, match="is in mm"):
        open_dataset(old)


def test_info_check_and_convert(rich, tmp_path, capsys):
    assert main(["data", "info", str(rich), "--json", str(tmp_path / "info.json")]) == 0
    about = json.loads((tmp_path / "info.json").read_text())
    assert about["splits"] == {"train": 2, "test_odd": 1}
    assert (about["seconds"], about["vertices"], about["unit"]) == (3.0, [42], "m")
    assert "42 vertices in metres" in capsys.readouterr().out
    assert main(["data", "check", str(rich), "--workers", "1"]) == 0
    arguments = ["data", "convert", str(rich), str(tmp_path / "ff"), "--format", "faceformer"]
    assert main([*arguments, "--workers", "1"]) == 0
    assert "3 sequences, 0 of them" in capsys.readouterr().out
    assert main([*arguments, "--workers", "1"]) == 0
    assert "3 sequences, 3 of them" in capsys.readouterr().out


def test_check_exits_1_and_lists_defects(rich, tmp_path, capsys):
    (rich / "sequences" / "zoe-2_e03" / "audio.wav").unlink()
    assert main(["data", "check", str(rich), "--workers", "1", "--json", str(tmp_path / "d.json")]) == 1
    assert "zoe-2_e03: " in capsys.readouterr().err
    assert len(json.loads((tmp_path / "d.json").read_text())["defects"]) == 1
    (rich / "mesh.npz").write_bytes(b"damaged")
    assert main(["data", "check", str(rich)]) == 1
    assert main(["data", "info", str(rich)]) == 2
    assert main(["data", "check", str(tmp_path / "absent")]) == 2


def test_options_of_another_layout_are_named(rich, capsys):
    assert main(["data", "info", str(rich), "--fps", "30"]) == 2
    assert "kind meshanim have no option fps" in capsys.readouterr().err
    assert main(["data", "info", str(rich), "--kind", "vocset"]) == 2


def test_members_that_are_missing_and_sequences_of_no_split(rich):
    record = json.loads((rich / "dataset.json").read_text())
    record["splits"] = {"train": ["zoe-2_e03", "ghost"]}
    (rich / "dataset.json").write_text(json.dumps(record))
    dataset = open_dataset(rich)
    faults = dataset.check()
    assert sum("in no split" in fault for fault in faults) == 2
    assert sum("ghost: split train names it" in fault for fault in faults) == 1
    with pytest.raises(FileFormatError, match="lacks 1 sequences of split train, such as ghost"):
        dataset.split("train")
