"""One network on several topologies: what is shared, what is each one's own, and what old checkpoints do."""

from importlib.resources import files

import numpy as np
import pytest
import torch
from corpus_small import write_small_corpus
from safetensors.torch import load_file
from test_batches import scalars_of

from meshanim.animator import Animator
from meshanim.audio import Waveform, load_encoder
from meshanim.cli import main
from meshanim.errors import OptionError
from meshanim.geometry import TriangleMesh, decimate
from meshanim.heads import load_head
from meshanim.models.gava import Gava, GavaConfig, Topology
from meshanim.training.gava import TrainGavaOptions, train_gava
from meshanim.training.trainer import TrainConfig
from meshanim.training.warm_start import WarmStart


@pytest.fixture(scope="module")
def meshes():
    head = load_head("default").mesh
    return head, decimate(head, 700).mesh


@pytest.fixture(scope="module")
def run(meshes, tmp_path_factory):
    folder = tmp_path_factory.mktemp("two")
    for name, mesh, head, fps in (("full", meshes[0], "default", 25.0), ("coarse", meshes[1], "", 30.0)):
        write_small_corpus(folder / name, 2, mesh=mesh, head=head, fps=fps)
    options = ["--encoder", "mel", "--width", "16", "--heads", "2", "--rank", "12", "--tokens", "150"]
    options += ["--variants", "0", "--train.steps", "60", "--train.learning-rate", "5e-3", "--cpu"]
    options += ["--train.log-every", "1", "--train.save-every", "1000", "--lip-weight", "2"]
    data = ["--data", str(folder / "full"), "--data", str(folder / "coarse")]
    assert main(["train", "gava", *data, "--output", str(folder / "run"), *options]) == 0
    return folder / "run"


@pytest.fixture(scope="module")
def model(run):
    return Gava.from_pretrained(run / "model")


def test_the_loss_falls_on_both(run):
    scalars = scalars_of(run / "tensorboard")
    for name in ("full", "coarse"):
        curve = [value for _, value in scalars[f"{name}/reconstruction"]]
        assert np.mean(curve[-5:]) < 0.5 * np.mean(curve[:2])
    steps = [{step for step, _ in scalars[f"{name}/reconstruction"]} for name in ("full", "coarse")]
    assert steps[0] | steps[1] == set(range(1, 61))
    assert not steps[0] & steps[1]
    assert abs(len(steps[1]) - len(steps[0]) * 30 / 25) <= 3  # as often as it has frames


def test_a_checkpoint_holds_its_topologies(model, meshes):
    assert [entry.name for entry in model.config.each] == ["full", "coarse"]
    assert model.config.subjects == ("full/anna", "full/ben", "coarse/anna", "coarse/ben")
    for k, (name, fps, head) in enumerate((("full", 25.0, "default"), ("coarse", 30.0, ""))):
        view = model.on(name)
        assert np.array_equal(view.mesh.faces, meshes[k].faces)
        assert (view.config.fps, view.config.head) == (fps, head)
        assert view.to_token is model.to_token
        assert view.graph().n_vertices == view.surface.n_tokens
    assert model.on(1).surface is model.others[0]
    with pytest.raises(OptionError, match="it has full, coarse"):
        model.on("other")


def test_the_card_says_what_it_is_made_of(run):
    card = (run / "model" / "README.md").read_text()
    assert "full: 5,124 vertices, 150 tokens, 25 frames a second, head `default`" in card
    assert "- sphere (`coarse`): 2 training sequences" not in card  # four: two people, two sentences
    assert "- sphere (`coarse`): 4 training sequences, 0.1 min at 30 frames a second" in card
    assert "--data" in card
    assert "--train.steps 60" in card
    assert "lip vertex error" not in card  # there is no held-out split


def test_a_view_moves_its_mesh_and_saves_alone(model, tmp_path):
    generator = torch.Generator().manual_seed(0)
    window, mel = torch.randn(2, 16, 80, generator=generator), torch.randn(2, 32, 80, generator=generator)
    for k in (0, 1):
        view = model.on(k)

        def frames(network):
            with torch.no_grad():
                embedding = network.embed(network.surface.template[None])
                return network(window, mel, embedding, network.style_of("full/ben").expand(2, -1))

        out = frames(view)
        assert out.displacements.shape == (2, view.n_vertices, 3)
        assert out.displacements.abs().max() > 1e-4
        view.save_pretrained(tmp_path / str(k))
        alone = Gava.from_pretrained(tmp_path / str(k))
        assert alone.n_topologies == 1
        assert torch.equal(frames(alone).displacements, out.displacements)


def test_the_animator_takes_the_topology_of_the_head_or_template(model, meshes, tmp_path):
    coarse = meshes[1]
    sound = Waveform(np.random.default_rng(0).normal(0, 0.1, 4000).astype(np.float32), 16000)
    animator = Animator(model, load_encoder("mel"), load_head("default"))
    assert animator(sound).vertices.shape[1] == meshes[0].n_vertices
    spoken = animator(sound, template=coarse.vertices.astype(np.float32))
    assert spoken.vertices.shape[1] == coarse.n_vertices
    assert spoken.fps == 30
    deltas = 0.001 * np.ones((1, coarse.n_vertices, 3))
    np.savez(
        tmp_path / "rig.npz", neutral=coarse.vertices, faces=coarse.faces, deltas=deltas, names=["jawOpen"]
    )
    rig = load_head(f"rig:{tmp_path / 'rig.npz'}")
    own = Animator(model, load_encoder("mel"), load_head("default"), rig)
    assert own.correspondence is None
    assert np.array_equal(own(sound).vertices, spoken.vertices)


def test_a_warm_start_gives_every_topology_its_components(run, tmp_path):
    options = TrainGavaOptions(
        data=(run.parent / "full", run.parent / "coarse"),
        output=tmp_path,
        encoder="mel",
        width=16,
        heads=2,
        rank=12,
        tokens=150,
        variants=0,
        cpu=True,
        warm=WarmStart(steps=60, batch_windows=8, components=4, learning_rate=1e-2, field_steps=120),
        train=TrainConfig(steps=2, learning_rate=1e-5, log_every=1, save_every=1000),
    )
    train_gava(options, progress=False)
    cold = scalars_of(run / "tensorboard")
    warm = scalars_of(tmp_path / "tensorboard")
    for name in ("full", "coarse"):
        first, second = (scalars[f"{name}/reconstruction"][0][1] for scalars in (cold, warm))
        assert second < 0.5 * first


def test_what_cannot_be_shared_is_named(meshes):
    entries = (Topology("a"), Topology("b"))
    with pytest.raises(OptionError, match="vertices of one topology"):
        GavaConfig(80, decoder="mlp", topologies=entries)
    small = TriangleMesh(np.eye(4, 3), np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]]))
    with pytest.raises(OptionError, match="2 topologies are named, there are 1"):
        Gava(GavaConfig(80, topologies=entries), small)


def test_the_shipped_checkpoint_gives_the_frames_it_gave():
    """Numbers of the release before checkpoints could hold several topologies."""
    animator = Animator.from_pretrained("default")
    model = animator.model
    assert model.n_topologies == 1
    assert model.on(0) is model
    generator = torch.Generator().manual_seed(1)
    window = torch.randn(3, 16, 53, generator=generator)
    mel = torch.randn(3, 32, 80, generator=generator) * 2 - 8
    with torch.no_grad():
        style = model.style_of("S02", "joy", 0.7).expand(3, -1)
        out = model(window, mel, model.embed(model.surface.template[None]), style)
    expected = [
        [-1.9094568e-05, 2.1584786e-04, 2.0718133e-05],
        [7.9502890e-05, -1.2608280e-04, -5.2544830e-05],
        [-1.7736720e-05, 6.3680630e-04, -1.2279618e-04],
    ]
    found = out.displacements[[0, 1, 2], [100, 2500, 5000]]
    torch.testing.assert_close(found, torch.tensor(expected), rtol=0, atol=1e-7)
    assert out.displacements.abs().mean().item() == pytest.approx(7.1491359e-4, rel=1e-4)
    assert out.pose[1].tolist() == pytest.approx([-0.01803295, 0.00805286, 0.01546767], abs=1e-5)
    weights = files("meshanim") / "models" / "weights" / "gava-default" / "model.safetensors"
    assert load_file(str(weights)).keys() == model.state_dict().keys()
