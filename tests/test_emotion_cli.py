"""`meshanim emotion` and `animate --emotion auto` as a user runs them."""

import csv
import json

import numpy as np
import pytest

from meshanim.animator import Animator
from meshanim.audio import load_waveform
from meshanim.automatic_emotion import with_heard_emotions
from meshanim.cli import main
from meshanim.errors import OptionError
from meshanim.models.audio2emotion import Audio2Emotion, Audio2EmotionConfig, EmotionDetector, EmotionOptions
from meshanim.motion import MeshSequence
from meshanim.performance import AnimationOptions, told_emotions
from tests.face_networks import head_diffusion, head_regression

SPEECH = "tests/audio/data/arctic_a0009.flac"


def run(*words) -> int:
    return main([str(word) for word in words])


class Sure(Audio2Emotion):
    """A classifier that is sure of one class, whatever it hears."""

    def __init__(self, name):
        super().__init__(Audio2EmotionConfig(163))
        self.name = name

    def forward(self, features, reference=None, known=None):
        from meshanim.motion.emotions import HEARD_EMOTIONS

        logits = features.new_full((len(features), 6), -20.0)
        logits[:, HEARD_EMOTIONS.index(self.name)] = 20.0
        return logits


def test_what_is_heard_and_written(tmp_path, capsys):
    words = ["-o", tmp_path / "e.csv", "--json", tmp_path / "e.json", "--emotion-strength", "1"]
    assert run("emotion", SPEECH, *words) == 0
    out = capsys.readouterr().out
    assert "not validated on people" in out
    with open(tmp_path / "e.csv", newline="") as text:
        rows = list(csv.DictReader(text))
    duration = load_waveform(SPEECH).duration
    assert len(rows) == np.ceil(duration / 0.033)
    assert all(0 <= float(row["emotion_values.joy"]) <= 1 for row in rows)
    record = json.loads((tmp_path / "e.json").read_text())["rows"]
    windows = {row["case"] for row in record}
    assert len(windows) == np.ceil((duration - 1.9) / 0.5) + 1
    for window in windows:
        assert sum(row["value"] for row in record if row["case"] == window) == pytest.approx(1)
    assert run("emotion", SPEECH, "--live", "--neutral", SPEECH, "-o", tmp_path / "live.csv") == 0
    assert (tmp_path / "live.csv").read_text() != (tmp_path / "e.csv").read_text()


@pytest.mark.parametrize("make", [head_regression, head_diffusion])
def test_audio2face_follows_what_is_heard(make):
    network, speech = make(), load_waveform(SPEECH)
    options = AnimationOptions(emotion="auto", intensity=0.5)
    told = with_heard_emotions(network, speech, options, EmotionDetector(Sure("joy")))
    joy = [name for name in network.config.emotions if name != "neutral"].index("joy")
    strengths = told.emotions.at(np.array([0.0, 2.5]))
    assert strengths[0, joy] < 0.1  # it begins neutral
    assert strengths[1, joy] == pytest.approx(0.5 * 0.6, abs=0.01)
    assert strengths[:, [k for k in range(strengths.shape[1]) if k != joy]].abs().max() < 1e-6
    none = make(emotions=("grief",))
    with pytest.raises(OptionError, match="none of anger"):
        with_heard_emotions(none, speech, options, EmotionDetector(Sure("joy")))


def test_gava_follows_what_is_heard():
    network = Animator.from_pretrained("default").model
    speech, options = load_waveform(SPEECH), AnimationOptions(emotion="auto")
    post = EmotionOptions(transition_smoothing=0.0, live_blend_coef=0.0, emotion_strength=0.8)
    told = with_heard_emotions(network, speech, options, EmotionDetector(Sure("anger")), post)
    strengths = told.emotions.strengths
    anger = told_emotions(network).index("anger")
    np.testing.assert_allclose(strengths[:, anger], 0.8, atol=1e-6)
    assert np.delete(strengths, anger, axis=1).max() < 1e-6
    calm = with_heard_emotions(network, speech, options, EmotionDetector(Sure("neutral")), post)
    assert calm.emotions.strengths.max() < 1e-6


def test_animate_by_what_is_heard(tmp_path, capsys):
    assert run("animate", SPEECH, "-o", tmp_path / "a.npz", "--emotion", "auto", "--neutral", SPEECH) == 0
    assert "heard by the default classifier" in capsys.readouterr().out
    assert len(MeshSequence.load(tmp_path / "a.npz")) == np.ceil(30 * load_waveform(SPEECH).duration - 1e-6)


def test_bad_input_is_one_line_and_exit_2(tmp_path, capsys):
    (tmp_path / "cut.wav").write_bytes(b"RIFF")
    for words, message in (
        (("emotion", tmp_path / "none.wav"), "none.wav"),
        (("emotion", tmp_path / "cut.wav"), "cut.wav"),
        (("emotion", SPEECH, "-o", tmp_path / "e.json"), ".csv"),
        (("emotion", SPEECH, "--json", tmp_path / "none" / "e.json"), "cannot write"),
        (("emotion", SPEECH, "--model", tmp_path / "none"), "neither a folder here nor a repository"),
        (("emotion", SPEECH, "--max-emotions", 0), "max_emotions"),
        (("emotion", SPEECH, "--enable-preferred-emotion", "--preferred", "bliss", 1), "bliss"),
        (("animate", SPEECH, "-o", tmp_path / "a.npz", "--neutral", SPEECH), "--emotion auto"),
        (
            ("animate", SPEECH, "-o", tmp_path / "a.npz", "--emotion", "joy", "--emotion-keys", "0:fear"),
            "both",
        ),
    ):
        assert run(*words) == 2, words
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert message in error
