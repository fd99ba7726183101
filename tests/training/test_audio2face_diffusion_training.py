import pickle
import shutil

import numpy as np
import pytest
import roma
import torch
from diffusion_runs import options, task_of
from states_small import FPS, write_states

from meshanim.audio import load_encoder
from meshanim.datasets.animation_states import AnimationStates
from meshanim.errors import OptionError
from meshanim.models.audio2face import Audio2FaceDiffusion, EmotionTrack, animate_diffusion
from meshanim.models.audio2face.head_motion import head_of_rotation, head_rotation
from meshanim.models.audio2face.prompts import TextEncoder, text_track
from meshanim.models.audio2face.speech import features_at
from meshanim.training import audio2face_diffusion as training
from meshanim.training.audio2face_diffusion import DiffusionWeights, TrainDiffusionOptions, train_diffusion
from meshanim.training.trainer import TrainConfig

CURVES = ("jawOpen", "mouthSmileLeft")


@pytest.fixture(scope="module")
def states(tmp_path_factory):
    """Three subjects, of whom one turns her head."""
    folder = tmp_path_factory.mktemp("states")
    return write_states(folder, ("anna", "ben", "cleo"), turning=("ben",), curve_names=CURVES)


def mean_loss(task, network, batches=24):
    """Without dropout, over segments that no run of these tests gets to."""
    network.eval()
    with torch.no_grad():
        return np.mean([task.loss(network, task.batch(10_000 + k))[0].item() for k in range(batches)])


def test_it_learns_to_take_the_noise_away(states, monkeypatch, tmp_path):
    train = TrainConfig(steps=45, learning_rate=6e-3, schedule="cosine", log_every=1000, save_every=1000)
    changes = {"subject": ("ben",), "pure_noise": 0.0}
    model = train_diffusion(options(states, tmp_path / "run", train=train, **changes), progress=False)
    network = Audio2FaceDiffusion.from_pretrained(model)
    assert network.config.identities == ("ben",)
    assert network.config.emotions == ("joy",)
    task, fresh, _ = task_of(states, monkeypatch, tmp_path, **changes)
    assert mean_loss(task, network) < 0.6 * mean_loss(task, fresh)


@pytest.mark.parametrize(
    "changes", [{}, {"head_motion": True}, {"target": "rig", "experts": 8}, {"text": True}], ids=str
)
def test_a_run_goes_on_where_it_was_cut(states, tmp_path, monkeypatch, changes):
    monkeypatch.setattr(training, "load_text_encoder", lambda name: Words())
    train = TrainConfig(steps=4, learning_rate=1e-3, accumulation=2, log_every=1000, save_every=2)
    whole = train_diffusion(options(states, tmp_path / "whole", train=train, **changes), progress=False)
    cut = tmp_path / "cut"
    train_diffusion(options(states, cut, train=train, **changes), progress=False)
    shutil.rmtree(cut / "checkpoints" / "0000004")
    shutil.rmtree(cut / "model")
    again = train_diffusion(options(states, cut, train=train, **changes), progress=False)
    a, b = (Audio2FaceDiffusion.from_pretrained(folder).state_dict() for folder in (whole, again))
    assert a.keys() == b.keys()
    assert all(torch.equal(a[name], b[name]) for name in a)


def test_worker_processes_make_the_same_batches(states, monkeypatch, tmp_path):
    task, _, _ = task_of(states, monkeypatch, tmp_path, head_motion=True)
    batch = task.batch(5)  # the source is open, its files are cached
    other = pickle.loads(pickle.dumps(task)).batch(5)
    assert batch.keys() == other.keys()
    for name, value in batch.items():
        assert torch.equal(value, other[name]) if isinstance(value, torch.Tensor) else value == other[name]


def test_the_schedule_is_the_papers(states, monkeypatch, tmp_path):
    train = TrainDiffusionOptions(states).train
    task, _, config = task_of(states, monkeypatch, tmp_path, epochs=400, train=train)
    assert (config.learning_rate, config.schedule, config.accumulation) == (5e-5, "cosine", 4)
    assert config.learning_rate * config.floor == pytest.approx(1e-5)
    assert config.steps == 400 * len(task.clips) // 4
    assert config.warmup == round(10 * len(task.clips) / 4)
    assert task.segment == (30, 600)
    assert TrainDiffusionOptions(states).weights == DiffusionWeights(25.0, 1e-5)


def test_an_epoch_sees_every_clip_and_segments_differ(states, monkeypatch, tmp_path):
    task, _, _ = task_of(states, monkeypatch, tmp_path, segment=(5, 20))
    count = len(task.clips)
    seen, lengths = [], set()
    monkeypatch.setattr(
        task.target,
        "frames",
        lambda clip, first, last: (seen.append((clip, first)), torch.zeros(last - first, 180 + 2 + 19))[1],
    )
    for number in range(2 * count):
        batch = task.batch(number)
        lengths.add(batch["clean"].shape[1])
        assert 5 <= batch["clean"].shape[1] <= 20
    names = [clip.clip.name for clip, _ in seen]
    assert sorted(names[:count]) == sorted(names[count:]) == sorted(clip.clip.name for clip in task.clips)
    assert names[:count] != names[count:]
    assert len(lengths) > 5
    assert len({first for _, first in seen}) > 5
    again = task.batch(3)
    assert torch.equal(again["noise"], task.batch(3)["noise"])
    assert torch.equal(task.batch(1, 1, 2)["noise"], again["noise"])


def test_a_batch_is_the_data(states, monkeypatch, tmp_path):
    task, _, _ = task_of(states, monkeypatch, tmp_path, head_motion=True, substitution=0.0)
    data, encoder = AnimationStates(states), load_encoder("mel")
    for number in range(6):
        batch = task.batch(number)
        clean, subject = batch["clean"][0], list(data.templates)[batch["subject"]]
        network_part = {part.name: part.columns for part in task.parts}
        # Find the clip and the frames again by their tongue and jaw.
        found = None
        for clip in task.clips:
            state = torch.from_numpy(clip.arrays.state[:, data.basis.sizes["skin"] :])
            for first in range(len(clip) - len(clean) + 1):
                if (
                    torch.equal(
                        state[first : first + len(clean)],
                        clean[:, network_part["tongue"].start : network_part["eyes"].stop],
                    )
                    and clip.clip.subject == subject
                ):
                    found = (clip, first) if found is None or clip.clip.made != "silence" else found
        assert found is not None
        clip, first = found
        rows = slice(first, first + len(clean))
        vertices = data.vertices(clip.clip.name, clip.arrays.timeline[rows])
        skin = vertices[:, data.basis.parts.skin] - data.templates[subject].numpy()[data.basis.parts.skin]
        np.testing.assert_allclose(clean[:, network_part["skin"]], skin.reshape(len(clean), -1), atol=1e-7)
        head = head_rotation(clean[:, network_part["head"]])
        pose = data.source.motion(clip.clip.sequence).pose[np.rint(clip.arrays.timeline[rows]).astype(int)]
        np.testing.assert_allclose(head, pose, atol=1e-6)
        assert batch["head"] == (subject == "ben")
        assert task.config.identities[int(batch["identities"])] == subject
        if clip.clip.made == "recorded":
            times = (torch.arange(first, first + len(clean), dtype=torch.float64) + 0.5) / FPS
            heard = features_at(encoder(data.audio(clip.clip.name)), encoder.rate, times)
            torch.testing.assert_close(batch["features"][0], heard, atol=0.01, rtol=0.01)


def plain_loss(task, model, batch):
    """Eq. 9 by loops over the frames, in float64."""
    mean, scale, schedule = task.mean.double(), task.scale.double(), task.schedule
    truth = batch["clean"].double()
    kept = schedule.kept[int(batch["times"])]
    noisy = np.sqrt(kept) * (truth - mean) / scale + np.sqrt(1 - kept) * batch["noise"].double()
    out = model(
        batch["features"].double(), noisy, batch["times"], batch["emotions"].double(), batch["identities"]
    )
    found, truth = (mean + scale * out)[0], truth[0]
    basis, weights = model.actors.basis, task.weights
    at = {part.name: part.columns for part in task.parts}
    total = float((100 * (found - truth)[:, at["skin"]]).square().mean())
    moved = [
        100 * torch.einsum("k,kvc->vc", row, basis.tongue_components.double())
        for row in (found - truth)[:, at["tongue"]]
    ]
    total += weights.tongue * float(torch.stack(moved).square().mean())
    total += float((100 * (found - truth)[:, at["jaw"]]).square().mean())
    total += float((1.2 * (found - truth)[:, at["eyes"]]).square().mean())
    upper = [k for k, v in enumerate(basis.parts.skin) if v in set(basis.parts.upper_face.tolist())]
    skin = 100 * found[:, at["skin"]].reshape(len(found), -1, 3)
    steps = [(skin[n + 1, upper] - skin[n, upper]).square().mean() for n in range(len(skin) - 1)]
    total += weights.upper_face * float(torch.stack(steps).mean())
    template = list(model.actors.templates.values())[batch["subject"]].double()
    lips = 0.0
    for n in range(len(found)):
        for upper_lip, lower_lip in basis.parts.lip_pairs:
            gaps = [
                100
                * float(
                    (
                        template[upper_lip]
                        + x[n, 3 * upper_lip : 3 * upper_lip + 3]
                        - template[lower_lip]
                        - x[n, 3 * lower_lip : 3 * lower_lip + 3]
                    )[1]
                )
                for x in (found, truth)
            ]
            lips += np.exp(-weights.gamma * max(gaps[1], 0)) * (gaps[0] - gaps[1]) ** 2
    return total + weights.lip_distance * lips / len(found)


def test_the_loss_is_eq_9(states, monkeypatch, tmp_path):
    weights = DiffusionWeights(upper_face=25.0, lip_distance=0.5)
    task, model, _ = task_of(states, monkeypatch, tmp_path, weights=weights)
    model.eval()
    with torch.no_grad():
        for layer in model.outputs:
            layer.weight.normal_(std=0.1)
    batch = task.batch(2)
    loss, terms = task.loss(model, batch)
    assert set(terms) == {"skin", "tongue", "jaw", "eyes", "upper_face", "lip_distance"}
    loss.backward()
    assert all(p.grad is not None for p in model.parameters())
    with torch.no_grad():
        expected = plain_loss(task, model.double(), batch)
    assert loss.item() == pytest.approx(expected, rel=1e-4)


def test_identities_without_head_motion_are_taught_by_others(states, monkeypatch, tmp_path):
    task, model, _ = task_of(states, monkeypatch, tmp_path, head_motion=True, substitution=0.5)
    assert task.turning == {"ben"}
    assert [task.config.identities[k] for k in task.still] == ["anna", "cleo"]
    kinds = set()
    for number in range(40):
        batch = task.batch(number)
        person, subject = task.config.identities[int(batch["identities"])], task.people[batch["subject"]]
        kinds.add((subject, person))
        if subject != "ben":
            assert (batch["head"], batch["face"], person) == (False, True, subject)
        else:
            assert batch["head"]
            assert batch["face"] == (person == "ben")
    assert {("ben", "anna"), ("ben", "cleo"), ("ben", "ben")} <= kinds
    batches = [task.batch(number) for number in range(40)]
    face_only = next(b for b in batches if not b["head"])
    head_only = next(b for b in batches if not b["face"])
    at = {part.name: part.columns for part in model.parts}
    for batch, counted, ignored in ((face_only, "skin", "head"), (head_only, "head", "skin")):
        loss, _ = task.loss(model, batch)
        for name, changes in ((counted, True), (ignored, False)):
            other = dict(batch, clean=batch["clean"].clone())
            noise = dict(other, noise=batch["noise"])
            # The truth of what does not count may be anything, given the same noisy input.
            kept = task.schedule.noised(
                (batch["clean"] - task.mean) / task.scale, batch["noise"], batch["times"]
            )
            other["clean"][..., at[name]] += 0.01
            monkeypatch.setattr(type(task.schedule), "noised", lambda *a, kept=kept: kept)
            again, _ = task.loss(model, noise | {"clean": other["clean"]})
            monkeypatch.undo()
            assert (abs(again.item() - loss.item()) > 1e-7) == changes, (name, counted)


def test_acceleration_of_the_head_counts(states, monkeypatch, tmp_path):
    weights = DiffusionWeights(acceleration=7.0)
    task, model, _ = task_of(
        states, monkeypatch, tmp_path, head_motion=True, weights=weights, substitution=0.0
    )
    with torch.no_grad():
        model.outputs[-1].weight.normal_(std=0.3)
    batch = next(b for b in map(task.batch, range(40)) if b["head"])
    torch.manual_seed(0)
    loss, terms = task.loss(model, batch)
    assert terms["acceleration"] > 0
    task.weights = DiffusionWeights(acceleration=0.0)
    torch.manual_seed(0)
    without, _ = task.loss(model, batch)
    assert loss.item() - without.item() == pytest.approx(7 * terms["acceleration"].item(), rel=1e-3)


def test_rig_weights_straight_from_speech(states, tmp_path):
    train = TrainConfig(steps=90, learning_rate=5e-3, log_every=1000, save_every=1000)
    run = options(states, tmp_path / "rig", train=train, target="rig", experts=16)
    network = Audio2FaceDiffusion.from_pretrained(train_diffusion(run, progress=False))
    assert network.config.rig == CURVES
    assert network.numbers == 2
    data = AnimationStates(states)
    for name in ("anna_sentence01", "ben_sentence02"):
        clip = data.clips[name]
        emotions = EmotionTrack.of(network.config.emotions, (0.0, {clip.emotion: clip.intensity}))
        frames = animate_diffusion(network, load_encoder("mel"), data.audio(name), clip.subject, emotions)
        weights = network.rig_weights(frames)[: clip.frames].numpy()
        truth = data.source.motion(name).curves
        assert np.abs(weights - truth).mean() < 0.6 * np.abs(truth - truth.mean(0)).mean()
        assert weights.min() >= 0
        with pytest.raises(OptionError, match="rig_weights"):
            network.vertices(frames)


class Words(TextEncoder):
    """A vector for the emotion that a sentence names."""

    name, dim = "words", 5

    def __call__(self, sentences):
        rows = torch.zeros(len(sentences), 5)
        for row, sentence in zip(rows, sentences):
            row[0 if any(w in sentence for w in ("happy", "joyful", "delighted")) else 1] = 1
        return rows


def test_sentences_take_the_place_of_emotions(states, monkeypatch, tmp_path):
    monkeypatch.setattr(training, "load_text_encoder", lambda name: Words())
    changes = {"text": True, "text_encoder": "words", "subject": ("anna",)}
    network = Audio2FaceDiffusion.from_pretrained(
        train_diffusion(options(states, tmp_path / "text", **changes), progress=False)
    )
    assert (network.config.text, network.config.emotions, network.config.text_encoder) == (5, (), "words")
    task, _, _ = task_of(states, monkeypatch, tmp_path, **changes)
    for number in range(12):
        batch = task.batch(number)
        order = torch.randperm(
            len(task.clips), generator=torch.Generator().manual_seed(number // len(task.clips))
        )
        clip = task.clips[int(order[number % len(task.clips)])].clip
        assert batch["emotions"].shape == (1, batch["clean"].shape[1], 5)
        assert (batch["emotions"][..., 0] == float(clip.emotion == "joy")).all()
    audio, encoder = AnimationStates(states).audio("anna_sentence02"), load_encoder("mel")
    joy, neutral = (
        animate_diffusion(network, encoder, audio, emotions=text_track(Words(), (0.0, sentence)))
        for sentence in ("a person looks joyful", "a person appears neutral")
    )
    assert (joy - neutral).abs().max() > 1e-7
    with pytest.raises(OptionError, match="text_track"):
        animate_diffusion(network, encoder, audio)


def test_head_angles():
    pose = torch.randn(20, 3) * 0.3
    motion = head_of_rotation(pose)
    assert motion.shape == (20, 9)
    assert not motion[:, 3:].any()
    torch.testing.assert_close(head_rotation(motion), pose, atol=1e-5, rtol=0)
    both = torch.cat([motion[:, :3], motion[:, :3], torch.zeros(20, 3)], dim=1)
    rotation = roma.rotvec_to_rotmat(pose)
    torch.testing.assert_close(
        roma.rotvec_to_rotmat(head_rotation(both)), rotation @ rotation, atol=1e-5, rtol=0
    )


def test_bad_options_are_named(states, tmp_path):
    with pytest.raises(OptionError, match="substitution"):
        TrainDiffusionOptions(states, substitution=2.0)
    with pytest.raises(OptionError, match="segments of 1 to 5"):
        TrainDiffusionOptions(states, segment=(1, 5))
    with pytest.raises(OptionError, match="no subject 'dan'"):
        train_diffusion(options(states, tmp_path, subject=("dan",)), progress=False)
    still = write_states(tmp_path / "one", sentences=2)
    with pytest.raises(OptionError, match="no head turns"):
        train_diffusion(options(still, tmp_path / "run", head_motion=True), progress=False)
    with pytest.raises(OptionError, match="no curves"):
        train_diffusion(options(still, tmp_path / "run", target="rig"), progress=False)
