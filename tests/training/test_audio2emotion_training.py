"""Training and testing a classifier of emotions on small made speech: the pitch of a buzz is the emotion."""

import json

import numpy as np
import pytest
import soundfile
import torch

from meshanim.cli import main
from meshanim.datasets.emotional import read_emotional, split_speakers
from meshanim.errors import FileFormatError, OptionError
from meshanim.models.audio2emotion import Audio2Emotion, Audio2EmotionConfig, load_audio2emotion
from meshanim.models.audio2emotion.features import EmotionFeatures
from meshanim.motion.emotions import HEARD_EMOTIONS
from meshanim.training.audio2emotion import EmotionCrops, EmotionTask, fine_tuned, set_statistics
from meshanim.training.audio2emotion_evaluation import confusion_table, evaluate_emotion
from meshanim.training.trainer import TrainConfig, learning_rate_factor


def run(*words) -> int:
    return main([str(word) for word in words])


def buzz(path, pitch, generator):
    time = np.arange(14000) / 16000
    tone = sum(np.sin(2 * np.pi * pitch * k * time + generator.uniform(0, 6)) / k for k in range(1, 12))
    path.parent.mkdir(parents=True, exist_ok=True)
    soundfile.write(path, 0.1 * tone + 0.003 * generator.normal(size=len(time)), 16000)


@pytest.fixture(scope="module")
def corpus(tmp_path_factory):
    """Five voices, two clips an emotion; each voice has a pitch of its own as well."""
    folder = tmp_path_factory.mktemp("buzz")
    generator = np.random.default_rng(0)
    for speaker, own in zip("abcde", (0.96, 1.03, 0.99, 1.05, 1.0)):
        for k, emotion in enumerate(HEARD_EMOTIONS):
            for number in (1, 2):
                buzz(folder / speaker / emotion / f"{number}.wav", own * 90 * 1.25**k, generator)
    return folder


@pytest.fixture(scope="module")
def trained(corpus, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "emotion"
    words = ["--data", corpus, "--output", out, "--encoder", "mel", "--epochs", 12, "--crops", 2, "--cpu"]
    assert run("train", "audio2emotion", *words) == 0
    return out


def test_it_learns_and_is_tested_on_other_voices(trained, corpus, capsys):
    rows = json.loads((trained / "results.json").read_text())["rows"]
    value = {(row["implementation"], row["metric"]): row["value"] for row in rows}
    assert value["alone", "chance"] == pytest.approx(1 / 6)
    assert value["alone", "accuracy"] > 0.5
    assert value["neutral sample", "accuracy"] > 0.5
    assert {row["case"] for row in rows} == {"11 clips, 1 speakers"}  # one of twelve is the neutral sample
    # The same numbers again, and the third way, by the verb for trained classifiers.
    words = ["--data", corpus, "--model", trained, "--held-out", 0.2, "--fine-tune", 1]
    assert run("evaluate", "audio2emotion", *words, "--json", trained / "again.json") == 0
    out = capsys.readouterr().out
    assert "fine-tuned:" in out
    again = json.loads((trained / "again.json").read_text())["rows"]
    assert {row["implementation"] for row in again} == {"alone", "neutral sample", "fine-tuned"}
    assert all(0 <= row["value"] <= 1 for row in again)


def test_a_run_that_is_over_changes_nothing(trained, corpus):
    before = (trained / "model" / "model.safetensors").read_bytes()
    words = ["--data", corpus, "--output", trained, "--encoder", "mel", "--epochs", 12, "--crops", 2, "--cpu"]
    assert run("train", "audio2emotion", *words) == 0
    assert (trained / "model" / "model.safetensors").read_bytes() == before
    assert run("train", "audio2emotion", *words, "--batch", 8) == 2


def test_fine_tuning_by_the_verb(trained, corpus, tmp_path):
    words = [
        "--data",
        corpus,
        "--output",
        tmp_path / "tuned",
        "--start",
        trained,
        "--held-out",
        0,
        "--crops",
        1,
    ]
    assert run("train", "audio2emotion", *words, "--epochs", 1, "--cpu", "--learning-rate", 1e-4) == 0
    tuned, first = load_audio2emotion(tmp_path / "tuned"), load_audio2emotion(trained)
    assert tuned.config == first.config
    torch.testing.assert_close(tuned.feature_mean, first.feature_mean)
    assert (tuned.attention.weight - first.attention.weight).abs().max() > 0
    assert not (tmp_path / "tuned" / "results.json").exists()  # nobody was held out


@pytest.fixture(scope="module")
def crops(corpus):
    features = EmotionFeatures(Audio2EmotionConfig(83, encoder="mel"))
    train, _ = split_speakers(read_emotional(corpus), 0.6)
    return features, EmotionCrops(train, features, crops=2)


def test_batches_are_a_function_of_their_number(crops):
    _, crops = crops
    assert len(crops) == 2 * 12 * 2
    task = EmotionTask(crops, 10, 0.5, 0.0, seed=1)
    assert task.epoch() == 5
    for name, value in task.batch(3).items():
        torch.testing.assert_close(value, task.batch(3)[name])
    assert not torch.equal(task.batch(3)["features"], task.batch(8)["features"])
    labels = torch.cat([task.batch(k, share, 2)["labels"] for k in range(2) for share in range(2)])
    assert len(labels) == 40
    known = torch.cat([task.batch(k)["known"] for k in range(40)])
    assert 0.4 < known.mean() < 0.6
    assert EmotionTask(crops, 10, 0.0, 0.0, 1).batch(0)["known"].sum() == 0
    assert crops.known.all()  # another neutral clip is there for each


def test_fine_tuned_copies(crops, corpus):
    features, crops = crops
    torch.manual_seed(0)
    network = Audio2Emotion(features.config)
    set_statistics(network, crops)
    before = {name: value.clone() for name, value in network.state_dict().items()}
    clips = [clip for clip in read_emotional(corpus) if clip.speaker == "folders:e"]
    tuned = fine_tuned(network, features, clips[::2], epochs=30, rate=2e-3)
    for name, value in network.state_dict().items():
        torch.testing.assert_close(value, before[name])
    results, confusion = evaluate_emotion(tuned, clips[1::2])
    assert results.value("5 clips, 1 speakers", "alone", "accuracy") > 0.7
    assert confusion["alone"].sum() == 5
    assert len(confusion_table(confusion["alone"]).splitlines()) == 7


def test_linear_schedule():
    config = TrainConfig(steps=101, warmup=1, schedule="linear", floor=0.1)
    factors = [learning_rate_factor(config, step) for step in (0, 1, 51, 101)]
    assert factors == pytest.approx([1, 1, 0.55, 0.1])


def test_bad_input(corpus, tmp_path, capsys):
    broken = tmp_path / "broken" / "a" / "joy" / "1.wav"
    broken.parent.mkdir(parents=True)
    broken.write_bytes((corpus / "a" / "joy" / "1.wav").read_bytes()[:30])
    for words, message in (
        (("train", "audio2emotion", "--data", tmp_path / "none"), "not a folder"),
        (("train", "audio2emotion", "--data", tmp_path / "broken", "--output", tmp_path / "r"), "1.wav"),
        (("train", "audio2emotion", "--data", corpus, "--epochs", 0), "epochs"),
        (("train", "audio2emotion", "--data", corpus, "--held-out", 1.5), "share"),
        (("train", "audio2emotion", "--data", corpus, "--start", tmp_path / "none"), "no classifier"),
        (("evaluate", "audio2emotion", "--data", corpus, "--held-out", 0), "held_out"),
    ):
        assert run(*words) == 2, words
        assert message in capsys.readouterr().err
    with pytest.raises(FileFormatError):
        read_emotional(tmp_path / "none")
    with pytest.raises(OptionError):
        split_speakers([], 2.0)
