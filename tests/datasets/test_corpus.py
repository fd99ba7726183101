"""The corpus on disk: what the lips do on real geometry, determinism, resuming, damage, both layouts."""

import hashlib
import json
import os
import pickle
import shutil
import signal
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
import torch

from meshanim.datasets import FaceFormerDataset, FaceFormerOptions, MeshanimDataset
from meshanim.datasets.synthetic import CURVE_NAMES, EMOTIONS, SpeakingStyle, perform
from meshanim.datasets.synthetic.articulation import holds, segments
from meshanim.datasets.synthetic.corpus import SynthesizeOptions, cast, splits, synthesize, takes
from meshanim.datasets.synthetic.visemes import BILABIALS
from meshanim.errors import DependencyError, FileFormatError, OptionError
from meshanim.heads import HeadParameters, load_head

pytest.importorskip("pocketsphinx")
pytest.importorskip("espeakng_loader")


def fingerprint(directory):
    return {
        str(path.relative_to(directory)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(directory.rglob("*"))
        if path.is_file()
    }


def options_for(directory, **changes):
    return replace(SynthesizeOptions(directory, subjects=2, sentences=2, emotional=0.5, workers=1), **changes)


@pytest.fixture(scope="module")
def corpus(tmp_path_factory):
    return synthesize(options_for(tmp_path_factory.mktemp("corpus") / "new"), progress=False)


@pytest.fixture
def damaged(corpus, tmp_path):
    return shutil.copytree(corpus, tmp_path / "damaged")


@pytest.fixture(scope="module")
def head():
    return load_head("default")


def test_what_is_written_reads_back(corpus, head):
    dataset = MeshanimDataset(corpus)
    assert dataset.fps == 30
    assert dataset.curve_names == head.expression_names
    assert len(dataset) == 4
    assert dataset.check() == []
    assert set(dataset.splits["train"]) == set(dataset.sequences)
    for sequence in dataset:
        assert isinstance(sequence.vertices, np.memmap)
        assert sequence.audio.rate == 16000
        assert len(sequence) == len(sequence.vertices)
        assert abs(len(sequence) / dataset.fps - sequence.audio.duration) < 1 / dataset.fps
        assert len(sequence.phonemes) > 20
    first, second = (dataset.subjects[name] for name in ("S01", "S02"))
    assert np.abs(first.template - second.template).max() > 2e-3
    assert first.attributes["voice"] != second.attributes["voice"] or first.attributes != second.attributes


def test_vertices_are_the_head_with_these_curves(corpus, head):
    dataset = MeshanimDataset(corpus)
    sequence = dataset[0]
    shape = torch.from_numpy(dataset.subjects[sequence.info.subject].shape)[None]
    expected = head(HeadParameters(shape=shape, expression=torch.from_numpy(sequence.curves)))
    assert np.abs(sequence.vertices - expected.numpy()).max() < 1e-6
    pause = np.flatnonzero(sequence.curves.sum(1) == sequence.curves.sum(1).min())[0]
    template = dataset.subjects[sequence.info.subject].template
    assert np.abs(sequence.vertices[pause] - template).max() < 0.02


@pytest.mark.parametrize("fps", [24.0, 29.97, 60.0])
def test_lips_close_on_every_bilabial_of_every_face(head, fps):
    """On the geometry: the lips meet in the middle of the mouth, whoever it is and whatever they feel."""
    generator = np.random.default_rng(7)
    upper, lower = head.lip_pairs.T
    columns = [CURVE_NAMES.index(name) for name in head.expression_names]

    class Timed:
        def __init__(self, start, end, symbol):
            self.start, self.end, self.symbol = start, end, symbol

    for trial in range(12):
        symbols = generator.choice(["P", "B", "M", "AA", "IY", "UW", "F", "S", "AE", "W", "TH"], size=16)
        edges = 0.2 + np.concatenate([[0], np.cumsum(generator.uniform(0.05, 0.18, size=16))])
        spoken = [Timed(float(a), float(b), str(s)) for a, b, s in zip(edges, edges[1:], symbols)]
        frames = int(np.ceil((edges[-1] + 0.2) * fps))
        performance = perform(
            spoken,
            frames,
            fps,
            style=SpeakingStyle.random(trial),
            emotion_name=list(EMOTIONS)[trial % len(EMOTIONS)],
            seed=trial,
        )
        shape = torch.from_numpy(np.clip(generator.normal(size=(1, 64)), -2, 2).astype(np.float32))
        curves = torch.from_numpy(performance.curves[:, columns])
        vertices = head(HeadParameters(shape=shape, expression=curves)).numpy()
        gap = vertices[:, upper, 1] - vertices[:, lower, 1]
        assert gap[performance.seal == 1].max() < 0.0002
        times = (np.arange(frames) + 0.5) / fps
        parts = segments(spoken, frames / fps)
        for start, end in holds(parts, BILABIALS):
            within = (times >= start) & (times <= end) & (performance.labiodental < 1)
            assert within.sum() == 0 or gap[within].max() < 0.0002
        open_vowel = [part for part in parts if part.phoneme in ("AA", "AE") and part.end - part.start > 0.12]
        for part in open_vowel:
            inside = (times >= part.start) & (times <= part.end)
            assert gap[inside].mean(1).max() > 0.003
        # The upper teeth rest on the lower lip: higher than their edge, and no further than 4 mm before it.
        teeth = vertices[:, head.parts["upper_teeth"].vertices]
        front = np.abs(teeth[0, :, 0]) < 0.012
        for frame in np.flatnonzero(performance.labiodental == 1):
            edge = teeth[frame, front]
            assert vertices[frame, lower, 1].mean() > edge[:, 1].min() - 0.0005
            assert vertices[frame, lower, 2].mean() < edge[:, 2].max() + 0.005


def test_the_number_of_workers_changes_nothing(corpus, tmp_path):
    parallel = synthesize(options_for(tmp_path / "parallel", workers=2), progress=False)
    assert fingerprint(parallel) == fingerprint(corpus)


def test_a_cluster_that_loses_a_worker_makes_the_same_corpus(corpus, tmp_path):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as cluster:
        made = tmp_path / "cluster"
        left_at_death = []

        def kill_one():
            while not list(made.glob("sequences/S*")):
                time.sleep(0.01)
            os.kill(cluster.workers[0].pid, signal.SIGKILL)
            left_at_death.append(4 - len(list(made.glob("sequences/S*"))))

        killer = threading.Thread(target=kill_one, daemon=True)
        killer.start()
        synthesize(options_for(made, dask=cluster.scheduler_address), progress=False)
        killer.join(timeout=60)
    assert left_at_death[0] > 0
    assert fingerprint(made) == fingerprint(corpus)


def test_another_seed_is_another_corpus(corpus, tmp_path):
    other = synthesize(options_for(tmp_path / "other", seed=1, subjects=1, sentences=1), progress=False)
    first, second = MeshanimDataset(corpus)[0], MeshanimDataset(other)[0]
    assert first.info.text == second.info.text
    assert not np.array_equal(first.audio.samples, second.audio.samples)


def test_an_interrupted_run_is_continued(corpus, damaged):
    before = fingerprint(corpus)
    kept = damaged / "sequences" / "S01_sentence01" / "vertices.npy"
    written = kept.stat().st_mtime_ns
    shutil.rmtree(damaged / "sequences" / "S02_sentence01")
    half = damaged / "sequences" / ".S02_sentence01-x1"
    half.mkdir()
    (half / "vertices.npy").write_bytes(b"half")
    (damaged / "dataset.json").unlink()
    with pytest.raises(FileFormatError, match="not finished"):
        MeshanimDataset(damaged)
    synthesize(options_for(damaged), progress=False)
    assert fingerprint(damaged) == before
    assert kept.stat().st_mtime_ns == written


def test_a_folder_of_something_else_is_left_alone(corpus, tmp_path):
    (tmp_path / "note.txt").write_text("mine")
    with pytest.raises(OptionError, match="not empty"):
        synthesize(options_for(tmp_path), progress=False)
    with pytest.raises(OptionError, match="begun with seed 0"):
        synthesize(options_for(corpus, seed=5), progress=False)
    (tmp_path / "texts").write_text("Papa moved.\nMama moved too.\n")
    with pytest.raises(OptionError, match="begun with texts"):
        synthesize(options_for(corpus, texts=tmp_path / "texts"), progress=False)


def test_no_voice_names_the_extra(monkeypatch, tmp_path):
    monkeypatch.setattr("meshanim.datasets.synthetic.corpus.voices", list)
    with pytest.raises(DependencyError, match="speech"):
        synthesize(options_for(tmp_path / "none"), progress=False)


def test_a_missing_package_is_named_from_a_worker_too():
    error = pickle.loads(pickle.dumps(DependencyError("pocketsphinx", "speech")))
    assert "meshanim[speech]" in str(error)


def test_bad_options_are_named(tmp_path):
    with pytest.raises(OptionError, match="--fps"):
        options_for(tmp_path, fps=0.0)
    with pytest.raises(OptionError, match="80"):
        synthesize(options_for(tmp_path / "many", sentences=81), progress=False)
    with pytest.raises(FileFormatError, match=r"absent\.txt"):
        synthesize(options_for(tmp_path / "texts", texts=tmp_path / "absent.txt"), progress=False)


def test_faceformer_layout_round_trip(corpus, tmp_path):
    made = synthesize(
        options_for(tmp_path / "ff", format="faceformer", subjects=1, sentences=1), progress=False
    )
    read = FaceFormerDataset(made, FaceFormerOptions(fps=30.0))
    ours = MeshanimDataset(corpus)["S01_sentence01"]
    (sequence,) = read
    assert np.array_equal(sequence.vertices, ours.vertices)
    assert np.array_equal(sequence.audio.samples, ours.audio.samples)
    assert sequence.info.subject == "S01"
    assert sequence.info.sentence == 1
    stored = np.load(made / "vertices_npy" / "S01_sentence01.npy")
    assert stored.shape == (len(ours), ours.vertices.shape[1] * 3)
    with open(made / "templates.pkl", "rb") as file:
        templates = pickle.load(file, encoding="latin1")
    assert np.array_equal(templates["S01"], MeshanimDataset(corpus).subjects["S01"].template)
    assert b"numpy._core" not in (made / "templates.pkl").read_bytes()
    halved = FaceFormerDataset(made, FaceFormerOptions(fps=60.0, stride=2))
    assert halved.fps == 30
    assert np.array_equal(halved[0].vertices, ours.vertices[::2])


def test_a_pickle_with_code_is_refused(tmp_path):
    (tmp_path / "vertices_npy").mkdir()
    (tmp_path / "templates.pkl").write_bytes(b"cos\nsystem\n(S'true'\ntR.")
    with pytest.raises(FileFormatError, match=r"os\.system|posix\.system"):
        FaceFormerDataset(tmp_path)


def cut(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


DAMAGE = {
    "vertices.npy": (cut, r"vertices\.npy.*cut short"),
    "pose.npy": (lambda path: path.unlink(), r"pose\.npy"),
    "curves.npy": (lambda path: np.save(path, np.full_like(np.load(path), np.nan)), r"curves\.npy.*finite"),
    "audio.wav": (lambda path: path.write_bytes(b"no sound"), r"audio\.wav"),
    "sequence.json": (lambda path: path.write_text('{"subject": "S01"}'), r"sequence\.json lacks sentence"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damaged_files_are_named(damaged, name):
    harm, message = DAMAGE[name]
    harm(damaged / "sequences" / "S01_sentence01" / name)
    dataset = MeshanimDataset(damaged)
    with pytest.raises(FileFormatError, match=message):
        dataset["S01_sentence01"]
    assert len(dataset.check()) == 1
    assert dataset["S01_sentence02"].info.sentence == 2


def test_contradictions_are_named(damaged):
    path = damaged / "sequences" / "S01_sentence01" / "vertices.npy"
    vertices = np.load(path)
    np.save(path, vertices[:-1])
    with pytest.raises(FileFormatError, match="expected"):
        MeshanimDataset(damaged)["S01_sentence01"]
    np.save(path, vertices * 1000)
    assert "wrong unit" in MeshanimDataset(damaged).check()[0]
    np.save(path, np.where(np.arange(vertices.shape[1])[:, None] == 5, np.nan, vertices).astype(np.float32))
    assert "not finite" in MeshanimDataset(damaged).check()[0]
    shutil.rmtree(path.parent)
    with pytest.raises(FileFormatError, match="lacks 1 sequences of split train"):
        MeshanimDataset(damaged).split("train")


def test_other_versions_are_refused(damaged):
    record = json.loads((damaged / "dataset.json").read_text())
    (damaged / "dataset.json").write_text(json.dumps({**record, "version": 99}))
    with pytest.raises(FileFormatError, match="99"):
        MeshanimDataset(damaged)
    (damaged / "dataset.json").write_text("{")
    with pytest.raises(FileFormatError, match="not JSON"):
        MeshanimDataset(damaged)


def test_unknown_names_are_refused(corpus):
    dataset = MeshanimDataset(corpus)
    with pytest.raises(OptionError, match="train"):
        dataset.split("trian")
    with pytest.raises(OptionError, match="S99"):
        dataset["S99_sentence01"]


def test_splits_share_no_sentence_and_no_held_out_person(tmp_path):
    options = SynthesizeOptions(tmp_path, subjects=8, sentences=40)
    everything = takes(options, cast(options, 4, ["pico:en-US", "espeak:en-us"]))
    parts = splits(everything)
    sizes = {name: len(names) for name, names in parts.items()}
    assert sizes["train"] == 6 * 32
    assert sizes["val"] == sizes["test"] == 7 * 4
    assert sizes["val_unseen"] == sizes["test_unseen"] == 4
    core = [set(parts[name]) for name in ("train", "val", "test", "spare")]
    assert sum(map(len, core)) == len(set.union(*core)) == 320
    train = {tuple(name.split("_")) for name in parts["train"]}
    for split in ("val", "test"):
        held = {tuple(name.split("_")) for name in parts[split]}
        assert not {sentence for _, sentence in train} & {sentence for _, sentence in held}
        assert len({person for person, _ in held} - {person for person, _ in train}) == 1


def test_the_cast_is_decided_by_the_seed_and_prefers_recorded_voices(tmp_path):
    options = SynthesizeOptions(tmp_path, subjects=5)
    available = ["flite:slt", "pico:en-US", "espeak:en-us"]
    members = cast(options, 10, available)
    assert members == cast(options, 10, available)
    assert {member.voice for member in members} == {"flite:slt", "pico:en-US"}
    assert len({member.style for member in members}) == len({member.shape for member in members}) == 5
    assert cast(replace(options, subjects=2), 10, available) == members[:2]
    emotional = [take.emotion != "neutral" for take in takes(options, members)]
    assert 0.1 < np.mean(emotional) < 0.4
