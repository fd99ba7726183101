import pytest
import torch
from audio2face_small import small_actors, small_diffusion
from diffusion_runs import options, task_of
from states_small import write_states

from meshanim.audio import load_encoder
from meshanim.datasets.animation_states import AnimationStates
from meshanim.errors import OptionError
from meshanim.models.audio2face import Audio2FaceDiffusion, EmotionTrack, FrameNoise, animate_diffusion
from meshanim.training.audio2face_diffusion import DiffusionWeights, TrainDiffusionOptions, train_diffusion
from meshanim.training.diffusion_components import ComponentDiffusion, upper_shapes
from meshanim.training.trainer import TrainConfig


@pytest.fixture(scope="module")
def states(tmp_path_factory):
    return write_states(tmp_path_factory.mktemp("states"), ("anna", "ben"), sentences=4)


def small_components(head_motion=False):
    """With weights that make every input matter."""
    whole = small_diffusion(head_motion=head_motion)
    network = ComponentDiffusion(whole.config, small_actors(skin=7, names=("anna", "ben"))).eval()
    torch.manual_seed(1)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.normal_(std=0.2)
        network.mean.normal_(std=0.1)
        network.scale[:7] = 0.3
        network.gain[:7] = torch.rand(7) * 9 + 1
    return network


@pytest.mark.parametrize("head_motion", [False, True])
def test_the_folded_network_says_the_same_of_vertices(head_motion):
    network = small_components(head_motion)
    folded = network.folded()
    assert type(folded) is Audio2FaceDiffusion
    components, mean = (
        x.flatten(-2) for x in (network.actors.basis.skin_components, network.actors.basis.skin_mean)
    )
    count = components.shape[1]
    features, emotions, noise = torch.randn(20, 80), torch.rand(20, 2), torch.randn(3, 20, folded.numbers)
    seen = torch.cat([noise[..., :count] @ components.T, noise[..., count:]], dim=-1)
    for steps in (1, 2, 3):
        whole = folded.sample(features, emotions, 1, FrameNoise(steps, folded.numbers, given=noise), steps)
        own = network.sample(features, emotions, 1, FrameNoise(steps, network.numbers, given=seen), steps)
        torch.testing.assert_close(whole[:, :count], mean + own[:, :7] @ components, atol=2e-5, rtol=1e-4)
        torch.testing.assert_close(whole[:, count:], own[:, 7:], atol=2e-5, rtol=1e-4)


def test_the_upper_face_moves_as_much():
    basis = small_actors(skin=9).basis
    upper = torch.tensor([3, 17, 40, 59])
    coefficients = torch.randn(50, 9)
    moved = torch.einsum("tk,kvc->tvc", coefficients, basis.skin_components[:, upper])
    found = (coefficients @ upper_shapes(basis, upper)).square().mean(1)
    torch.testing.assert_close(found, moved.square().mean((1, 2)), rtol=1e-4, atol=1e-6)


def prepared(states, monkeypatch, tmp_path, **changes):
    """The task and the network of a run in components that does not run."""
    return task_of(states, monkeypatch, tmp_path, **({"skin": "components"} | changes))[:2]


def test_the_loss_is_that_of_vertices(states, monkeypatch, tmp_path):
    alone = {"subject": ("anna",), "batch": 3}
    task, network = prepared(states, monkeypatch, tmp_path, **alone)
    whole_task, _ = prepared(states, monkeypatch, tmp_path, **alone, skin="vertices")
    torch.manual_seed(2)
    with torch.no_grad():
        for layer in network.outputs:
            layer.weight.normal_(std=0.1)
    network.eval()
    folded = network.folded()
    components = network.actors.basis.skin_components.flatten(1)
    for number in range(3):
        batch, whole = task.batch(number), whole_task.batch(number)
        assert batch["clean"].shape[:2] == whole["clean"].shape[:2] == (3, batch["noise"].shape[1])
        noise = torch.randn(whole["clean"].shape)
        batch["noise"] = torch.cat(
            [noise[..., : components.shape[1]] @ components.T, noise[..., components.shape[1] :]], dim=-1
        )
        for name in ("features", "times", "emotions", "identities"):
            whole[name] = batch[name]
        (loss, terms), (whole_loss, whole_terms) = (
            task.loss(network, batch),
            whole_task.loss(folded, whole | {"noise": noise}),
        )
        assert loss.item() == pytest.approx(whole_loss.item(), rel=1e-3)
        for name, value in terms.items():
            assert value.item() == pytest.approx(whole_terms[name].item(), rel=1e-3, abs=1e-9), name


def test_segments_side_by_side_are_those_one_after_the_other(states, monkeypatch, tmp_path):
    together, network = prepared(states, monkeypatch, tmp_path, batch=4, segment=(20, 20))
    alone, _ = prepared(states, monkeypatch, tmp_path, segment=(20, 20))
    batch = together.batch(1)
    network.eval()
    single = [alone.batch(4 + k) for k in range(4)]
    for name, value in batch.items():
        torch.testing.assert_close(value, torch.cat([row[name] for row in single]))
    with torch.no_grad():
        losses = [alone.loss(network, row)[0].item() for row in single]
        assert together.loss(network, batch)[0].item() == pytest.approx(sum(losses) / 4, rel=1e-4)


def test_half_of_the_segments_are_pure_noise(states, monkeypatch, tmp_path):
    task, _ = prepared(states, monkeypatch, tmp_path)
    times = torch.cat([task.batch(number)["times"] for number in range(200)])
    assert 70 < (times == 999).sum() < 130
    assert times.min() < 100
    for share in (0.0, 1.0):
        task, _ = prepared(states, monkeypatch, tmp_path, pure_noise=share)
        assert all((task.batch(number)["times"] == 999).all() == bool(share) for number in range(20))


def test_it_follows_unheard_speech_and_shows_the_emotion(states, tmp_path):
    train = TrainConfig(
        steps=100, learning_rate=4e-3, schedule="cosine", floor=0.02, log_every=1000, save_every=1000
    )
    run = options(
        states,
        tmp_path / "run",
        skin="components",
        train=train,
        batch=6,
        segment=(20, 30),
        dropout=0.0,
        weights=DiffusionWeights(upper_face=0.0),
    )
    network = Audio2FaceDiffusion.from_pretrained(train_diffusion(run, progress=False))
    data, encoder = AnimationStates(states), load_encoder("mel")
    basis, lips = data.basis, data.basis.parts.lip_pairs
    for name in data.templates:
        clip = data.clips[f"{name}_sentence04"]
        assert clip.split == "test"
        spoken = {
            emotion: network.pose(
                animate_diffusion(
                    network,
                    encoder,
                    data.audio(clip.name),
                    name,
                    EmotionTrack.of(network.config.emotions, (0.0, {emotion: 1.0})),
                )
            ).skin[: clip.frames]
            for emotion in ("neutral", "joy")
        }
        truth = (
            torch.from_numpy(data.vertices(clip.name, data.arrays(clip.name).timeline)) - data.templates[name]
        )
        truth = truth[:, basis.parts.skin]
        # Lower lips open with the sound.
        opened, true = (x[:, lips[:, 1], 1].mean(1) for x in (spoken["neutral"], truth))
        assert torch.corrcoef(torch.stack([opened, true]))[0, 1] > 0.9
        assert (opened - true).square().mean() < 0.2 * (true - true.mean()).square().mean()
        # Joy is a smile, the same in every frame.
        first, second = (data.arrays(f"{name}_sentence{k:02d}").timeline for k in (1, 2))
        joyful, plain = (
            torch.from_numpy(data.vertices(f"{name}_sentence{k:02d}", line))[:, basis.parts.skin]
            for k, line in ((2, second), (1, first))
        )
        smile = joyful[0] - plain[0]
        shown = (spoken["joy"] - spoken["neutral"]).mean(0)
        share = (shown * smile).sum() / smile.square().sum()
        assert 0.6 < share < 1.4


def test_options_are_checked(states):
    with pytest.raises(OptionError, match="leave out --skin"):
        TrainDiffusionOptions(states, skin="components", target="rig")
    with pytest.raises(OptionError, match="pure_noise"):
        TrainDiffusionOptions(states, pure_noise=1.5)
    with pytest.raises(OptionError, match="a batch needs"):
        TrainDiffusionOptions(states, batch=0)
