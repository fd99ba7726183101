import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from states_small import FPS, write_states

from meshanim.audio import Waveform, load_encoder
from meshanim.datasets.animation_states import AnimationStates
from meshanim.errors import OptionError
from meshanim.models.audio2face import Audio2FaceRegression, EmotionTrack
from meshanim.models.audio2face.regression import STEP_TIMES, WINDOW
from meshanim.models.audio2face.regression_stream import animate_regression
from meshanim.models.audio2face.speech import features_at
from meshanim.training import audio2face_regression as training
from meshanim.training.audio2face_data import load_speech_clips
from meshanim.training.audio2face_losses import PRESETS
from meshanim.training.audio2face_regression import TrainRegressionOptions, open_runs, train_regression
from meshanim.training.trainer import TrainConfig


@pytest.fixture(scope="module")
def states(tmp_path_factory):
    return write_states(tmp_path_factory.mktemp("states"))


def options(states, output, **changes):
    defaults = {
        "data": states,
        "output": output,
        "encoder": "mel",
        "epochs": 0,
        "batch_pairs": 6,
        "cpu": True,
        "train": TrainConfig(steps=42, learning_rate=1e-3, log_every=1000, save_every=1000),
    }
    return TrainRegressionOptions(**(defaults | changes))


def lips(network, states, name):
    """Mean distance of the lips' vertices, and of those of the mean training face, millimetres."""
    data, encoder = AnimationStates(states), load_encoder("mel")
    clip, template = data.clips[name], data.templates["anna"]
    emotions = EmotionTrack.of(network.config.emotions, (0.0, {clip.emotion: clip.intensity}))
    found = animate_regression(network, encoder, data.audio(name), emotions=emotions)[: clip.frames]
    arrays = data.arrays(name)
    truth = torch.from_numpy(data.vertices(name, arrays.timeline))
    rows = data.basis.parts.lip_pairs.ravel()
    errors = []
    for state in (found, network.state_mean[None].expand(clip.frames, -1)):
        made = data.basis.vertices(state, template)
        errors.append(1000 * (made - truth)[:, rows].norm(dim=-1).mean().item())
    return errors


def test_it_learns_to_speak_and_to_smile(states, tmp_path):
    train = TrainConfig(steps=60, learning_rate=2e-3, schedule="cosine", log_every=1000, save_every=1000)
    run = options(states, tmp_path / "run", train=train, batch_pairs=8)
    model = train_regression(run, progress=False)
    network = Audio2FaceRegression.from_pretrained(model)
    assert network.config.emotions == ("joy",)
    assert network.config.fps == FPS
    assert network.config.languages == ()  # deployed: no phoneme heads
    assert not any("heads" in name for name in network.state_dict())
    assert {clip.name for clip in network.config.spans} >= {"anna_sentence01", "anna~silence-neutral"}
    for name, share in (("anna_sentence01", 0.6), ("anna_sentence02", 0.6), ("anna_sentence03", 0.75)):
        found, mean = lips(network, states, name)
        assert found < share * mean, name
    # Of a sentence that it never heard: lower lips open with the sound, and joy is a smile in every frame.
    data, encoder = AnimationStates(states), load_encoder("mel")
    assert data.clips["anna_sentence03"].split == "test"

    def skin(name):
        moved = data.vertices(name, data.arrays(name).timeline) - data.templates["anna"].numpy()
        return torch.from_numpy(moved)[:, data.basis.parts.skin]

    truth, spoken = skin("anna_sentence03"), {}
    for emotion in ("neutral", "joy"):
        track = EmotionTrack.of(network.config.emotions, (0.0, {emotion: 1.0}))
        found = animate_regression(network, encoder, data.audio("anna_sentence03"), emotions=track)
        spoken[emotion] = data.basis.decode(found[: len(truth)]).skin
    lower = data.basis.parts.lip_pairs[:, 1]
    opened = torch.stack([x[:, lower, 1].mean(1) for x in (spoken["neutral"], truth)])
    assert torch.corrcoef(opened)[0, 1] > 0.8
    smile = skin("anna_sentence02")[0] - skin("anna_sentence01")[0]
    shown = (spoken["joy"] - spoken["neutral"]).mean(0)
    assert (shown * smile).sum() / smile.square().sum() > 0.1


def test_a_run_goes_on_where_it_was_cut(states, tmp_path):
    train = TrainConfig(steps=6, learning_rate=1e-3, log_every=1000, save_every=3)
    whole = train_regression(options(states, tmp_path / "whole", train=train), progress=False)
    cut = tmp_path / "cut"
    train_regression(options(states, cut, train=train), progress=False)
    shutil.rmtree(cut / "checkpoints" / "0000006")
    shutil.rmtree(cut / "model")
    again = train_regression(options(states, cut, train=train), progress=False)
    a, b = (Audio2FaceRegression.from_pretrained(folder).state_dict() for folder in (whole, again))
    assert a.keys() == b.keys()
    assert all(torch.equal(a[name], b[name]) for name in a)


def task_of(states, monkeypatch, tmp_path, **changes):
    """The task and the learner of a run that does not run."""
    kept = {}

    class Still(training.Trainer):
        def run(self, progress=True):
            kept.update(task=self.task, model=self.bare, config=self.config)

    monkeypatch.setattr(training, "Trainer", Still)
    train_regression(options(states, tmp_path / "still", **changes), progress=False)
    return kept["task"], kept["model"], kept["config"]


def test_epochs_and_decay_are_the_papers(states, monkeypatch, tmp_path):
    train = TrainRegressionOptions(states).train
    task, _, config = task_of(states, monkeypatch, tmp_path, epochs=50, train=train)
    frames = sum(clip.frames for clip in AnimationStates(states).of())
    epoch = round(frames // 2 / 6)
    assert abs(task.epoch - epoch) <= 1
    assert config.steps == 50 * config.decay_steps
    assert config.decay_steps == round(task.epoch)
    assert (config.learning_rate, config.decay, config.schedule, config.weight_decay) == (
        2e-4,
        0.994,
        "steps",
        0,
    )


@pytest.mark.parametrize("heard", ["speech", "window"])
def test_a_batch_is_pairs_of_frames_with_what_is_heard(states, monkeypatch, tmp_path, heard):
    task, _, _ = task_of(states, monkeypatch, tmp_path, shift=0.0, hearing=heard)
    data, encoder = AnimationStates(states), load_encoder("mel")
    batch = task.batch(3)
    spans = task.sampler.spans(3)
    assert batch["state"].shape == (12, data.basis.width)
    for row, span in enumerate(spans):
        k, begun, _ = task.runs[span.clip]
        clip = task.clips[k]
        arrays, waveform = data.arrays(clip.clip.name), data.audio(clip.clip.name)
        for n in range(2):
            frame, at = begun + span.first + n, 2 * row + n
            time = (frame + 0.5) / FPS
            np.testing.assert_array_equal(batch["state"][at], arrays.state[frame])
            start = round(time * 16000 - WINDOW / 2)
            padded = np.pad(waveform.samples, WINDOW)[start + WINDOW : start + 2 * WINDOW]
            np.testing.assert_allclose(batch["windows"][at], padded, atol=1e-6)
            if heard == "speech":
                expected = features_at(encoder(waveform), encoder.rate, torch.from_numpy(time + STEP_TIMES))
            else:
                alone = encoder(Waveform(padded, 16000))
                expected = features_at(alone, encoder.rate, torch.from_numpy(STEP_TIMES + 0.26))
            torch.testing.assert_close(batch["features"][at], expected, atol=0.01, rtol=0.01)
            label = arrays.phonemes[int(time * 50)]
            assert batch["labels"][at, 12] == label
            joy = clip.clip.emotion == "joy"
            assert batch["explicit"][at].tolist() == [float(joy)]
    rows = batch["rows"].reshape(-1, 2)
    assert (rows[:, 1] - rows[:, 0] == 1).all()


def test_shifted_pairs_move_sound_and_states_alike(states, monkeypatch, tmp_path):
    task, _, _ = task_of(states, monkeypatch, tmp_path)
    batch = task.batch(0)
    for row, span in enumerate(task.sampler.spans(0)):
        k, begun, _ = task.runs[span.clip]
        frame = min(max(begun + span.first + 2 * span.coin - 1, 0), len(task.clips[k]) - 1)
        state = task.clips[k].arrays.state
        low = min(int(frame), len(state) - 2)
        expected = state[low] + np.float32(frame - low) * (state[low + 1] - state[low])
        np.testing.assert_allclose(batch["state"][2 * row], expected, atol=1e-6)


def test_the_loss_is_the_weighted_sum(states, monkeypatch, tmp_path):
    task, model, _ = task_of(states, monkeypatch, tmp_path, preset="james")
    loss, terms = task.loss(model, task.batch(0))
    names = ["state", "motion", "phoneme", "phoneme_motion", "volume", "emotion", "lip_distance", "lip_size"]
    assert list(terms) == names
    weights = PRESETS["james"]
    assert loss.item() == pytest.approx(sum(getattr(weights, n) * terms[n].item() for n in names), rel=1e-5)
    assert all(terms[name] > 0 for name in names)
    loss.backward()
    assert all(parameter.grad is not None for parameter in model.parameters())
    task.weights = replace(weights, lip_size=0.0)
    without, _ = task.loss(model, task.batch(0))
    assert loss.item() - without.item() == pytest.approx(0.01 * terms["lip_size"].item(), abs=1e-4)


def test_shares_of_a_batch_are_the_larger_one(states, monkeypatch, tmp_path):
    task, _, _ = task_of(states, monkeypatch, tmp_path)
    parts = [task.batch(1, share, 2)["state"] for share in range(2)]
    larger = training.RegressionTask(
        task.config,
        training.Actors(
            AnimationStates(states).basis, {"anna": torch.zeros(85, 3)}, np.zeros((0, 3), np.int64)
        ),
        task.clips,
        task.rate,
        pairs=12,
    )
    assert torch.equal(torch.cat(parts), larger.batch(1)["state"])


def test_closed_eyes_are_left_out():
    assert open_runs(np.array([1, 1, 0, 1, 0, 1, 1, 1])) == [(0, 2), (5, 3)]
    assert open_runs(np.zeros(4, np.uint8)) == []
    assert open_runs(np.ones(4, np.uint8)) == [(0, 4)]


def test_features_are_made_once(states, tmp_path):
    data, encoder = AnimationStates(states), load_encoder("mel")
    clips = data.of(made=("recorded",))
    window = (WINDOW, STEP_TIMES + WINDOW / 32000)
    first = load_speech_clips(data, clips, encoder, "window", tmp_path, window)
    before = {path: path.stat().st_mtime_ns for path in first[0].features.path.parent.glob("*.npy")}
    load_speech_clips(data, clips, encoder, "window", tmp_path, window)
    assert before == {path: path.stat().st_mtime_ns for path in before}
    assert first[0].features.shape == (45, 25 * 80)


def test_bad_options_are_named(states, tmp_path):
    with pytest.raises(OptionError, match="shift"):
        TrainRegressionOptions(states, shift=2.0)
    with pytest.raises(OptionError, match="no subject 'bob'"):
        train_regression(options(states, tmp_path, subject="bob"), progress=False)
    two = write_states(tmp_path / "two", ("anna", "ben"), sentences=2)
    with pytest.raises(OptionError, match="--subject: anna, ben"):
        train_regression(options(two, tmp_path / "run"), progress=False)
