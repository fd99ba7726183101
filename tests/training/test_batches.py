"""Batches that add up over processes, whole sequences by length, features made once by many processes."""

import gc
import multiprocessing
from pathlib import Path

import numpy as np
import pytest
import torch
from corpus_small import write_small_corpus

from meshanim.audio import load_encoder
from meshanim.cli import main
from meshanim.datasets.meshanim_format import MeshanimDataset
from meshanim.errors import FileFormatError, OptionError
from meshanim.models.gava import Gava, GavaConfig
from meshanim.training.array_rows import ArrayRows, rows_on_disk
from meshanim.training.feature_cache import CacheFeaturesOptions, FeatureCache, cache_features
from meshanim.training.gava_task import GavaLearner, GavaTask, Turns
from meshanim.training.losses import eye_loss, pose_loss, reconstruction_loss, velocity_loss
from meshanim.training.sampling import SequenceSampler, WindowSampler
from meshanim.training.speech_motion import load_clips
from meshanim.training.trainer import TrainConfig, Trainer

LENGTHS = [40, 7, 1, 12, 33, 25, 8, 19, 30, 16, 11, 22]


@pytest.fixture(scope="module")
def corpus(tmp_path_factory):
    return write_small_corpus(tmp_path_factory.mktemp("corpus") / "sphere")


@pytest.fixture(scope="module")
def clips(corpus, tmp_path_factory):
    dataset = MeshanimDataset(corpus)
    cache = FeatureCache(tmp_path_factory.mktemp("features"), load_encoder("mel"))
    return load_clips(dataset, dataset.sequences, cache, ("anna", "ben"), ("neutral", "joy"), 1, False)


def task_of(corpus, clips, **changes):
    dataset = MeshanimDataset(corpus)
    templates = torch.from_numpy(np.stack([subject.template for subject in dataset.subjects.values()]))
    config = GavaConfig(
        feature_dim=80, width=16, layers=1, heads=2, rank=8, channels=16, emotions=("neutral", "joy")
    )
    config = GavaConfig(**{**vars(config), "subjects": ("anna", "ben"), "feature_rate": 100.0})
    torch.manual_seed(0)
    model = Gava(config, dataset.mesh)
    torch.nn.init.normal_(model.decoder.displacement.weight, std=0.3)
    torch.nn.init.normal_(model.decoder.pose.weight, std=0.3)
    return GavaLearner(model), GavaTask(config, clips, templates, torch.arange(20), **changes)


@pytest.mark.parametrize("sampler", [WindowSampler(LENGTHS, 4, 3, 5), SequenceSampler(LENGTHS, 2, 5)])
@pytest.mark.parametrize("shares", [2, 3])
def test_the_shares_of_processes_are_the_larger_batch(sampler, shares):
    larger = (
        WindowSampler(LENGTHS, 4, 3 * shares, 5)
        if isinstance(sampler, WindowSampler)
        else SequenceSampler(LENGTHS, 2 * shares, 5)
    )
    for number in (0, 1, 7, 40):
        parts = [span for share in range(shares) for span in sampler.spans(number, share, shares)]
        assert sorted(parts) == sorted(larger.spans(number))


def test_whole_sequences_come_once_an_epoch_beside_others_of_their_length():
    generator = np.random.default_rng(0)
    lengths = generator.integers(2, 400, size=200).tolist()
    sampler = SequenceSampler(lengths, 4, seed=3)
    batches = [sampler.spans(number) for number in range(100)]
    first, second = (sorted(s.clip for b in part for s in b) for part in (batches[:50], batches[50:]))
    assert first == second == list(range(200))
    assert all(span.first == 0 and span.frames == lengths[span.clip] for b in batches for span in b)
    padded = sum(4 * max(s.frames for s in batch) - sum(s.frames for s in batch) for batch in batches)
    assert padded < 0.1 * 2 * sum(lengths)  # unsorted it would be more than half of them
    assert batches[:50] != batches[50:]
    assert SequenceSampler(lengths, 4, seed=3).spans(77) == batches[77]
    with pytest.raises(OptionError, match="larger than the data: 2"):
        SequenceSampler([5, 1, 9], 4).spans(0)


def test_a_batch_of_sequences_is_the_mean_of_their_own_losses(corpus, clips):
    shortened = [
        type(clip)(**{**vars(clip), "vertices": clip.vertices[:n], "pose": clip.pose[:n]})
        for clip, n in zip(clips, (30, 17, 23, 9, 28, 12))
    ]
    learner, task = task_of(corpus, shortened, sequences=3)
    batch = task.batch(1)
    assert len(set(batch["frames"].tolist())) == 3
    loss, terms = task.loss(learner, batch)
    loss.backward()
    gradient = [p.grad.clone() for p in learner.parameters() if p.grad is not None]
    output = learner(**{k: v for k, v in batch.items() if k not in ("displacement", "pose", "frames")})
    expected = {"reconstruction": [], "velocity": [], "eyes": [], "pose": []}
    cuts = batch["frames"].tolist()
    pieces = (output.displacements, batch["displacement"], output.pose, batch["pose"])
    for moved, true, turned, turn in zip(*(piece.split(cuts) for piece in pieces)):
        expected["reconstruction"].append(reconstruction_loss(moved, true))
        expected["velocity"].append(velocity_loss(moved[None], true[None]))
        expected["eyes"].append(eye_loss(moved, true, task.eyes))
        expected["pose"].append(pose_loss(turned, turn))
    means = {name: torch.stack(values).mean() for name, values in expected.items()}
    for name, value in means.items():
        torch.testing.assert_close(terms[name], value, rtol=1e-5, atol=1e-7)
    learner.zero_grad()
    weights = vars(task.weights)
    sum(weights[name] * value for name, value in means.items()).backward()
    for got, wanted in zip(gradient, [p.grad for p in learner.parameters() if p.grad is not None]):
        torch.testing.assert_close(got, wanted, rtol=1e-3, atol=1e-5)


def test_what_lies_beyond_the_end_counts_nowhere():
    generator = torch.Generator().manual_seed(0)
    moved, true = torch.randn(2, 3, 9, 5, 3, generator=generator) * 1e-3
    mask = torch.arange(9) < torch.tensor([9, 4, 6])[:, None]
    turned, turn = moved[:, :, 0] * 50, true[:, :, 0] * 50
    eyes = torch.tensor([0, 3])

    def all_losses():
        return (
            reconstruction_loss(moved, true, None, mask),
            velocity_loss(moved, true, None, mask),
            eye_loss(moved, true, eyes, mask=mask),
            pose_loss(turned, turn, mask),
        )

    before = all_losses()
    for values in (moved, true, turned, turn):
        values[~mask] += 7.0
    torch.testing.assert_close(all_losses(), before)


def test_turns_are_even_and_in_proportion():
    turns = Turns([700.0, 250.0, 50.0])
    first = [turns.of(number) for number in range(2000)]
    for k, count in enumerate((1400, 500, 100)):
        own = [turn for who, turn in first if who == k]
        assert own == list(range(count))
    assert [who for who, _ in first[:20]].count(0) == 14
    assert Turns([1e9, 1.0]).counts == [1000, 1]


def test_rows_of_a_file_are_those_of_the_array(tmp_path):
    array = np.arange(60, dtype=np.float32).reshape(10, 2, 3)
    np.save(tmp_path / "a.npy", array)
    rows = ArrayRows.open(tmp_path / "a.npy")
    for part in (slice(None), slice(3, 7), slice(0, 0), slice(8, 99), slice(1, 9, 3), slice(-2, None)):
        assert np.array_equal(rows[part], array[part])
    mapped = np.load(tmp_path / "a.npy", mmap_mode="r")
    kept = rows_on_disk(mapped)
    assert isinstance(kept, ArrayRows)
    assert np.array_equal(kept[2:5], array[2:5])
    assert isinstance(rows_on_disk(mapped[2:5]), np.ndarray)  # a part of a map knows no place of its own
    assert rows_on_disk(array) is array
    (tmp_path / "a.npy").write_bytes((tmp_path / "a.npy").read_bytes()[:-30])
    with pytest.raises(FileFormatError, match="cut short"):
        rows[:]
    with pytest.raises(FileFormatError, match="delete it"):
        ArrayRows.open(tmp_path / "a.npy")


def test_clips_keep_no_file_open_and_no_features_in_memory(tmp_path):
    descriptors = Path("/proc/self/fd")
    if not descriptors.is_dir():
        pytest.skip("needs /proc")
    dataset = MeshanimDataset(write_small_corpus(tmp_path / "sphere"))
    cache = FeatureCache(tmp_path / "features", load_encoder("mel"))
    clips = load_clips(dataset, dataset.sequences, cache, ("anna", "ben"), ("neutral", "joy"), 1, False)
    del dataset, cache
    gc.collect()  # readers in reference cycles hold their maps until then
    lines = Path("/proc/self/maps").read_text().splitlines()
    assert [line for line in lines if str(tmp_path) in line] == []  # other tests' files are their own matter
    opened = [str(link.resolve()) for link in descriptors.iterdir() if link.exists()]
    assert [path for path in opened if path.startswith(str(tmp_path))] == []
    assert all(isinstance(rows, ArrayRows) for clip in clips for rows in (clip.vertices, *clip.features))


class CountingEncoder:
    """Writes a line for every sound that it is given."""

    def __init__(self, log):
        self.encoder, self.log = load_encoder("mel"), log
        self.name, self.dim, self.rate = "mel", self.encoder.dim, self.encoder.rate

    def __call__(self, waveform):
        if len(waveform.samples) > 8000:  # not the probe
            with open(self.log, "a") as file:
                file.write(f"{len(waveform.samples)}\n")
        return self.encoder(waveform)


def fill(corpus, folder, share):
    torch.set_num_threads(1)
    dataset = MeshanimDataset(corpus)
    cache = FeatureCache(folder, CountingEncoder(folder / "log"))
    styles, emotions = ("anna", "ben"), ("neutral", "joy")
    load_clips(dataset, dataset.sequences, cache, styles, emotions, 2, False, share, 2)


def test_processes_share_the_making_of_features(corpus, tmp_path):
    context = multiprocessing.get_context("spawn")
    processes = [context.Process(target=fill, args=(corpus, tmp_path, share)) for share in (0, 1)]
    for process in processes:
        process.start()
    for process in processes:
        process.join(120)
        assert process.exitcode == 0
    assert len((tmp_path / "log").read_text().split()) == 6 * 3  # six sounds in three variants, each once
    assert len(list(tmp_path.glob("*/*.npy"))) == 6 * 3 * 2


def test_features_made_ahead_are_those_that_training_makes(corpus, tmp_path, monkeypatch, capsys):
    assert main(["data", "cache-features", str(corpus), "--encoder", "mel", "--variants", "1"]) == 0
    made = Path(capsys.readouterr().out.split()[-1])
    assert made.parent == corpus / "features"
    dataset = MeshanimDataset(corpus)
    names = dataset.split("train")
    written = {path.name: path.stat().st_mtime_ns for path in made.glob("*.npy")}
    assert len(written) == 2 * 2 * len(names)
    encoder = load_encoder("mel")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # as workers have: another number rounds differently
    own = load_clips(dataset, names, FeatureCache(tmp_path, encoder), ("anna", "ben"), ("neutral", "joy"), 1)
    torch.set_num_threads(threads)
    ahead = FeatureCache(corpus / "features", encoder)
    found = load_clips(dataset, names, ahead, ("anna", "ben"), ("neutral", "joy"), 1, False)
    assert {path.name: path.stat().st_mtime_ns for path in made.glob("*.npy")} == written
    for one, other in zip(own, found):
        assert all(np.array_equal(a[:], b[:]) for a, b in zip(one.features, other.features))
        assert all(np.array_equal(a[:], b[:]) for a, b in zip(one.mels, other.mels))
    with pytest.raises(OptionError, match="no split"):
        cache_features(CacheFeaturesOptions(corpus, split="trian"), progress=False)


def test_worker_processes_give_the_same_run(corpus, clips, tmp_path):
    results = []
    for workers in (0, 1):
        learner, task = task_of(corpus, clips)
        config = TrainConfig(steps=4, learning_rate=1e-3, log_every=2, save_every=1000, workers=workers)
        Trainer(learner, task, config, tmp_path / str(workers), cpu=True).run(progress=False)
        results.append(learner.state_dict())
    assert all(torch.equal(results[0][name], results[1][name]) for name in results[0])
    scalars = scalars_of(tmp_path / "1" / "tensorboard")
    assert [step for step, _ in scalars["loss"]] == [2, 4]
    assert all(0 < value < 1 for _, value in scalars["data_share"])
    assert all(value > 0 for _, value in scalars["seconds"])


def scalars_of(folder):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder))
    events.Reload()
    return {
        name: [(event.step, event.value) for event in events.Scalars(name)]
        for name in events.Tags()["scalars"]
    }


def test_an_error_in_a_worker_is_its_own_line(corpus, clips, tmp_path):
    learner, task = task_of(corpus, clips)
    lost = ArrayRows(tmp_path / "gone.npy", np.dtype(np.float16), (200, 80), 128)
    task.speech_tracks.tracks = [lost] * len(task.speech_tracks.tracks)
    config = TrainConfig(steps=2, workers=1, log_every=1000, save_every=1000)
    with pytest.raises(FileFormatError, match=r"^cannot read .*gone\.npy[^\n]*$"):
        Trainer(learner, task, config, tmp_path, cpu=True).run(progress=False)
