import shutil

import numpy as np
import pytest
import torch
from corpus_small import FPS, write_small_corpus

from meshanim.datasets.meshanim_format import MeshanimDataset
from meshanim.errors import OptionError
from meshanim.models.gava import Gava
from meshanim.training import warm_start
from meshanim.training.gava import TrainGavaOptions, train_gava
from meshanim.training.gava_evaluation import EvaluateGavaOptions, evaluate_gava
from meshanim.training.speech_motion import Clip
from meshanim.training.trainer import TrainConfig
from meshanim.training.warm_start import WarmStart, motion_components


@pytest.fixture(scope="module")
def corpus(tmp_path_factory):
    return write_small_corpus(tmp_path_factory.mktemp("corpus") / "sphere")


def options(corpus, output, **changes):
    defaults = {
        "data": (corpus,),
        "output": output,
        "encoder": "mel",
        "width": 16,
        "heads": 2,
        "rank": 12,
        "variants": 0,
        "batch_windows": 6,
        "tokens": 80,
        "cpu": True,
        "train": TrainConfig(steps=40, learning_rate=5e-3, log_every=1000, save_every=1000),
    }
    return TrainGavaOptions(**(defaults | changes))


def errors(corpus, models, metric="mean vertex error"):
    first, *others = models
    results = evaluate_gava(
        EvaluateGavaOptions(corpus, str(first), tuple(others), splits=("train", "test")), False
    )
    return {(r.case, r.implementation): r.value for r in results.rows if r.metric == metric}


def test_the_pose_is_scored_where_a_network_has_one(corpus, tmp_path):
    brief = TrainConfig(steps=2, learning_rate=5e-3, log_every=1000, save_every=1000)
    one = train_gava(options(corpus, tmp_path / "posed", train=brief), progress=False)
    other = train_gava(options(corpus, tmp_path / "stiff", train=brief, pose=False), progress=False)
    found = errors(corpus, [one, other], "pose error")
    dataset = MeshanimDataset(corpus)
    turned = np.concatenate([np.linalg.norm(dataset[name].pose, axis=1) for name in dataset.split("test")])
    assert found["test", "template held still"] == pytest.approx(np.degrees(turned.mean()), rel=1e-4)
    assert found["test", "LG+GAVA (posed)"] < 20
    assert ("test", "LG+GAVA (stiff)") not in found
    still = shutil.copytree(corpus, tmp_path / "still")
    for name in dataset.sequences:
        path = still / "sequences" / name / "pose.npy"
        np.save(path, 0 * np.load(path))
    assert errors(still, [one], "pose error") == {}


def test_it_learns_to_speak_from_a_random_start(corpus, tmp_path):
    model = train_gava(options(corpus, tmp_path / "plain"), progress=False)
    found = errors(corpus, [model])
    assert found["train", "LG+GAVA (plain)"] < 0.5 * found["train", "template held still"]
    card = (model / "README.md").read_text()
    (row,) = (line for line in card.splitlines() if "mean vertex error" in line)
    ours, still = (float(cell) for cell in row.split("|")[-3:-1])
    assert ours == pytest.approx(found["test", "LG+GAVA (plain)"], abs=2e-3)
    assert still == pytest.approx(found["test", "template held still"], abs=2e-3)
    assert "--encoder mel" in card
    assert "--cpu" in card
    loaded = Gava.from_pretrained(model)
    assert loaded.config.subjects == ("anna", "ben")
    assert loaded.config.emotions == ("neutral", "joy")
    assert loaded.config.fps == FPS
    assert loaded.config.encoder == "mel"


@pytest.mark.parametrize(
    "changes", [{}, {"decoder": "mlp", "features": "G"}, {"tokens": 60, "fusion": "concat"}]
)
def test_a_warm_start_is_near_the_answer(corpus, tmp_path, changes):
    warm = WarmStart(steps=60, batch_windows=8, components=3, learning_rate=1e-2, field_steps=80)
    steps = 60 if changes.get("decoder") == "mlp" else 8
    train = TrainConfig(steps=steps, learning_rate=1e-3, log_every=1000, save_every=1000)
    model = train_gava(options(corpus, tmp_path / "warm", warm=warm, train=train, **changes), progress=False)
    found = errors(corpus, [model])
    (name,) = {name for _, name in found} - {"template held still", "mean of training"}
    assert found["test", name] < 0.6 * found["test", "template held still"]
    assert found["test", name] < found["test", "mean of training"]


def test_a_run_goes_on_where_it_was_cut(corpus, tmp_path):
    train = TrainConfig(steps=6, learning_rate=1e-3, log_every=1000, save_every=3)
    whole = train_gava(options(corpus, tmp_path / "whole", train=train), progress=False)
    first = tmp_path / "cut"
    train_gava(options(corpus, first, train=train), progress=False)
    for folder in (first / "checkpoints" / "0000006", first / "model"):
        (folder / "model.safetensors").unlink()
    shutil.rmtree(first / "checkpoints" / "0000006")
    again = train_gava(options(corpus, first, train=train), progress=False)
    a, b = (Gava.from_pretrained(folder).state_dict() for folder in (whole, again))
    assert all(torch.equal(a[name], b[name]) for name in a)


def test_a_run_goes_on_where_its_warm_start_was_cut(corpus, tmp_path, monkeypatch):
    warm = WarmStart(steps=5, batch_windows=2, components=3, field_steps=5)
    train = TrainConfig(steps=2, learning_rate=1e-3, log_every=1000, save_every=2)
    whole = train_gava(options(corpus, tmp_path / "whole", warm=warm, train=train), progress=False)
    asked = {}
    for part in (warm_start._SpeechFit, warm_start._FieldFit):

        def batch(self, number, *shares, part=part, real=part.batch):
            asked.setdefault(part, []).append(number)
            if asked[part] == [0, 1, 2, 3, 4]:
                raise KeyboardInterrupt
            return real(self, number, *shares)

        monkeypatch.setattr(part, "batch", batch)
    cut = options(corpus, tmp_path / "cut", warm=warm, train=train)
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            train_gava(cut, progress=False)
    again = train_gava(cut, progress=False)
    assert all(numbers == [0, 1, 2, 3, 4, 4] for numbers in asked.values()), (
        "steps that were saved are not done again"
    )
    a, b = (Gava.from_pretrained(folder).state_dict() for folder in (whole, again))
    assert all(torch.equal(a[name], b[name]) for name in a)


def test_components_are_the_motion(corpus):
    dataset = MeshanimDataset(corpus)
    templates = np.stack([subject.template for subject in dataset.subjects.values()])
    clips = []
    for name in dataset.split("train"):
        sequence = dataset[name]
        row = list(dataset.subjects).index(sequence.info.subject)
        clips.append(Clip(sequence.info, row, 0, 0, 0.0, sequence.vertices, sequence.pose, [], []))
    components = motion_components(clips, templates, 3)
    assert components.scale[0] > 100 * components.scale[1]  # one field moves it all
    moved = clips[0].vertices - templates[0]
    rebuilt = np.tensordot(components.coefficients(moved).numpy() * components.scale, components.modes, 1)
    np.testing.assert_allclose(rebuilt, moved, atol=1e-6)


def test_bad_options_are_named(corpus, tmp_path):
    warm = WarmStart(steps=1, components=8)
    with pytest.raises(OptionError, match="rank of at least"):
        train_gava(options(corpus, tmp_path, warm=warm), progress=False)
    with pytest.raises(OptionError, match="two consecutive"):
        train_gava(options(corpus, tmp_path, window_frames=1), progress=False)
