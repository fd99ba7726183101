import json

import numpy as np
import pytest
import torch
from states_small import FPS, write_states

from meshanim.audio import load_encoder
from meshanim.cli import main
from meshanim.datasets.meshanim_format import MeshanimDataset
from meshanim.errors import OptionError
from meshanim.models.audio2face import Audio2FaceDiffusion
from meshanim.models.syncnet import RATE, SyncNet, mouth_landmarks
from meshanim.motion.face_parts import FaceParts
from meshanim.results import Results
from meshanim.training.audio2face_diffusion import TrainDiffusionOptions, train_diffusion
from meshanim.training.audio2face_evaluation import Expressiveness, SyncEvaluation
from meshanim.training.audio2face_regression import TrainRegressionOptions, train_regression
from meshanim.training.feature_cache import FeatureCache
from meshanim.training.syncnet import SyncTask, TrainSyncNetOptions, load_sync_clips, parts_of, train_syncnet
from meshanim.training.trainer import TrainConfig

SECONDS = 2.4


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two speakers whose lips follow the loudness; joy in sentence 2; sentence 4 held out."""
    folder = tmp_path_factory.mktemp("sync")
    write_states(folder, ("anna", "ben"), 4, SECONDS)
    return folder


@pytest.fixture(scope="module")
def network(folder):
    options = TrainSyncNetOptions(
        folder / "data",
        folder / "run",
        folder / "parts.json",
        width=32,
        clips=4,
        moments=6,
        train=TrainConfig(steps=150, learning_rate=2e-3, log_every=1000, save_every=1000),
        cpu=True,
    )
    return SyncNet.from_pretrained(train_syncnet(options, progress=False))


@pytest.fixture(scope="module")
def models(folder):
    """A regression and a diffusion network of three steps; the second's outputs follow its noise."""
    short = TrainConfig(steps=3, log_every=1000, save_every=1000)
    common = {"data": folder / "a2f", "encoder": "mel", "epochs": 0, "cpu": True, "train": short}
    train_regression(
        TrainRegressionOptions(output=folder / "regression", subject="anna", batch_pairs=4, **common),
        progress=False,
    )
    train_diffusion(
        TrainDiffusionOptions(output=folder / "diffusion", width=16, segment=(8, 16), **common),
        progress=False,
    )
    noisy = Audio2FaceDiffusion.from_pretrained(folder / "diffusion" / "model")
    for layer in noisy.outputs:
        torch.nn.init.normal_(layer.weight, std=0.2)
    noisy.save_pretrained(folder / "diffusion" / "model")
    return str(folder / "regression"), str(folder / "diffusion")


def held_out(folder, network):
    dataset = MeshanimDataset(folder / "data")
    cache = FeatureCache(folder / "features", load_encoder("mel"))
    return load_sync_clips(dataset, dataset.split("test"), network.config.landmarks, cache)


def test_batches_are_moments_that_share_no_frame(folder, network):
    clips = held_out(folder, network)
    task = SyncTask(network.config, clips, FPS, 2, 5, seed=1)
    batch = task.batch(3)
    assert batch["moments"].shape == (10, 5, 60)
    assert batch["features"].shape == (10, network.config.steps, 80)
    again = SyncTask(network.config, clips, FPS, 2, 5, seed=1).batch(3)
    assert all(torch.equal(batch[name], again[name]) for name in batch)
    halves = [SyncTask(network.config, clips, FPS, 1, 5, seed=1).batch(3, share, 2) for share in (0, 1)]
    assert torch.equal(torch.cat([half["moments"] for half in halves]), batch["moments"])


def test_lips_find_their_sound_and_late_ones_are_noticed(folder, network):
    for clip in held_out(folder, network):
        curve = network.distances(clip.mouth, clip.neutral, FPS, clip.features, reach=8)
        assert int(curve.argmin()) == 8
        assert curve[8] < 0.7 * curve.mean()
        late = torch.cat([clip.mouth[:1].expand(6, -1, -1), clip.mouth[:-6]])  # 0.2 s
        score = network.score(late, clip.neutral, FPS, clip.features, reach=8)
        assert abs(score.offset - 6 / FPS) <= 1 / RATE + 1e-9
        still = clip.mouth[:1].expand_as(clip.mouth)
        right = network.score(clip.mouth, clip.neutral, FPS, clip.features, reach=8)
        assert (
            network.score(still, clip.neutral, FPS, clip.features, reach=8).confidence
            < 0.5 * right.confidence
        )


def test_sync_of_an_evaluation_is_the_mean_of_its_sequences(folder, network):
    dataset = MeshanimDataset(folder / "data")
    cache = FeatureCache(folder / "features", load_encoder("mel"))
    sync = SyncEvaluation(network, network.config.landmarks, FPS)
    for name in dataset.split("test"):
        sequence = dataset[name]
        template = dataset.subjects[sequence.info.subject].template
        features = torch.from_numpy(
            cache.tracks(name, sequence.audio, 0, lambda: ())[0][0][:].astype(np.float32)
        )
        sync.add(name, np.array(sequence.vertices), template, features)
    expected = [network.score(c.mouth, c.neutral, FPS, c.features) for c in held_out(folder, network)]
    distance, confidence, offset = sync.values()
    assert distance.value == pytest.approx(np.mean([score.distance for score in expected]))
    assert confidence.value == pytest.approx(np.mean([score.confidence for score in expected]))
    assert (offset.value, offset.unit, distance.sequences) == (0.0, "ms", 2)
    with pytest.raises(OptionError, match="20 landmarks, this mouth has 3"):
        SyncEvaluation(network, (1, 2, 3), FPS)


def test_expressiveness_is_one_for_the_emotion_of_training_and_none_for_a_still_face(folder):
    dataset = MeshanimDataset(folder / "data")
    reference = Expressiveness(dataset, np.arange(85), "all")
    assert set(reference.references) == {"joy"}
    joyful = [name for name in dataset.split("train") if dataset.info(name).emotion == "joy"]
    for factor, wanted in ((1.0, 1.0), (0.6, 0.6), (0.4, 0.4), (0.0, 0.0)):
        scores = reference.scorer()
        for name in joyful:
            who = dataset.info(name).subject
            shown = reference.neutral[who] + factor * reference.references["joy"]
            template = dataset.subjects[who].template
            vertices = template + np.tile(shown.reshape(-1, 3), (4, 1, 1))
            scores.add(name, who, "joy", vertices, template)
        strength, recognised = scores.values()
        assert strength.value == pytest.approx(wanted, abs=1e-5)
        assert recognised.value == float(factor > 0.5)
        assert strength.sequences == len(joyful) == 2
    neutral = reference.scorer()
    neutral.add("a", "anna", "neutral", vertices, template)
    assert neutral.values() == []


def test_the_table_has_networks_truth_and_baselines(folder, network, models, capsys):
    arguments = ["evaluate", "a2f", "--data", str(folder / "data"), "--splits", "test"]
    named = ["--models", *models]
    sync = ["--syncnet", str(folder / "run"), "--parts", str(folder / "parts.json")]
    assert main([*arguments, *named, *sync, "--json", str(folder / "a.json")]) == 0
    printed = capsys.readouterr().out
    columns = ["truth", "A2F regression (regression)", "A2F diffusion (diffusion)", "template held still"]
    assert all(column in printed for column in columns)
    table = Results.load(folder / "a.json")
    assert table.value("test", "truth", "mean vertex error") == 0
    for column in columns:
        assert np.isfinite(table.value("test", column, "sync distance"))
    still = table.value("test", "template held still", "sync confidence")
    assert table.value("test", "truth", "sync confidence") > 2 * still
    record = json.loads((folder / "a.json").read_text())
    rows = [row for row in record["rows"] if row["metric"] == "sync distance"]
    assert {row["mask"] for row in rows} == {"mouth landmarks"}
    assert all(len(row["per_sequence"]) == 2 for row in rows)
    # The same run again, for one subject.
    assert main([*arguments, *named[:2], "--subjects", "anna", "--json", str(folder / "b.json")]) == 0
    one = Results.load(folder / "b.json")
    assert {row.metric for row in one.rows}.isdisjoint({"sync distance"})
    row = next(row for row in one.rows if row.metric == "mean vertex error")
    assert row.measured is not None
    assert row.measured.sequences == 1


def test_the_diffusion_of_a_table_is_a_function_of_its_seed(folder, models):
    arguments = ["evaluate", "a2f", "--data", str(folder / "data"), "--models", models[1]]
    values = []
    for run, seed in enumerate((0, 0, 1)):
        path = folder / f"seed{run}.json"
        assert main([*arguments, "--seed", str(seed), "--json", str(path)]) == 0
        values.append(Results.load(path).value("test", "A2F diffusion (diffusion)", "mean vertex error"))
    assert values[0] == values[1] != values[2]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (["--subjects", "zoe"], "no subject zoe; there are anna, ben"),
        (["--splits", "nothing"], "no split 'nothing'; there are train, test"),
        (["--syncnet", "RUN"], "name its lips with --parts"),
        (["--models", "MISSING"], "MISSING"),
    ],
)
def test_bad_options_give_a_line(folder, network, models, capsys, changes, message):
    changes = [str(folder / "run") if word == "RUN" else word for word in changes]
    arguments = ["evaluate", "a2f", "--data", str(folder / "data")]
    named = [] if "--models" in changes else ["--models", models[0]]
    assert main([*arguments, *named, *changes]) == 2
    assert message in capsys.readouterr().err


def test_lips_that_a_data_set_lacks_are_refused(folder, tmp_path):
    dataset = MeshanimDataset(folder / "data")
    parts = FaceParts.load(folder / "parts.json")
    assert mouth_landmarks(parts_of(dataset, folder / "parts.json")) == mouth_landmarks(parts)
    arrays = parts.arrays() | {"tongue": np.array([1000])}
    FaceParts.from_arrays(arrays).save(tmp_path / "other.json")
    with pytest.raises(OptionError, match="vertex 1000 is none"):
        parts_of(dataset, tmp_path / "other.json")
    with pytest.raises(OptionError, match="two moments"):
        TrainSyncNetOptions(folder / "data", moments=1)
