import dataclasses
import inspect
import json

import numpy as np
import pytest
import torch
from conftest_gava import awake, inputs, small_config, sphere

from meshanim.errors import FileFormatError, MeshError, OptionError, ShapeError
from meshanim.geometry import TriangleMesh
from meshanim.models.gava import Gava, GavaConfig
from meshanim.training.trainer import TrainConfig


def n_parameters(model):
    return sum(parameter.numel() for parameter in model.parameters())


def test_facts_of_the_paper():
    config = GavaConfig(feature_dim=29)
    assert (config.window, config.mel_bands, config.tokens) == (16, 80, "vertices")
    assert (config.features, config.fusion, config.decoder) == ("LG", "sum", "gava")
    assert config.layers >= 3
    assert config.rings == 1
    assert config.self_loops
    assert TrainConfig().steps == 70_000


@pytest.mark.parametrize("decoder", ["gava", "sa", "mlp"])
@pytest.mark.parametrize("features", ["LG", "L", "G"])
def test_every_ablation_runs_and_moves(features, decoder):
    torch.manual_seed(0)
    model = awake(Gava(small_config(features=features, decoder=decoder), sphere(1)))
    out = model(*inputs(model))
    assert out.displacements.shape == (3, 42, 3)
    assert out.pose.shape == (3, 3)
    assert out.displacements.abs().max() > 1e-6
    # Frames of different speech differ.
    assert (out.displacements[0] - out.displacements[1]).abs().max() > 1e-7


def test_ablations_differ():
    outputs = []
    for options in ({}, {"features": "L"}, {"features": "G"}, {"decoder": "sa"}, {"fusion": "concat"}):
        torch.manual_seed(0)
        model = awake(Gava(small_config(**options), sphere(1)))
        outputs.append(model(*inputs(model)).displacements)
    for i in range(len(outputs)):
        for j in range(i):
            assert not torch.allclose(outputs[i], outputs[j], atol=1e-7)


def test_an_untrained_model_holds_the_template_still():
    model = Gava(small_config(), sphere(1))
    out = model(*inputs(model))
    assert out.displacements.abs().max() == 0
    assert out.pose.abs().max() == 0


def test_parameters_do_not_grow_with_the_mesh():
    small, large = Gava(small_config(), sphere(1)), Gava(small_config(), sphere(3))
    assert n_parameters(small) == n_parameters(large)
    large.load_state_dict(small.state_dict() | large.surface.state_dict(prefix="surface."))
    per_vertex = [Gava(small_config(decoder="mlp"), sphere(k)) for k in (1, 2)]
    assert n_parameters(per_vertex[0]) < n_parameters(per_vertex[1])


def test_renumbered_vertices_give_renumbered_frames(model):
    mesh = model.mesh
    order = np.random.default_rng(0).permutation(mesh.n_vertices)
    rank = np.argsort(order)
    renumbered = TriangleMesh(mesh.vertices[order], rank[mesh.faces])
    other = Gava(model.config, renumbered).eval()
    surface = other.surface.state_dict(prefix="surface.")
    # The eigenfunctions of a sphere are not unique: carry those of the first mesh over.
    surface["surface.descriptors"] = model.surface.descriptors[order]
    other.load_state_dict(model.state_dict() | surface)
    window, mel, _, style = inputs(model)
    expected = model(window, mel, model.embed(model.surface.template[None]), style)
    found = other(window, mel, other.embed(other.surface.template[None]), style)
    torch.testing.assert_close(found.displacements, expected.displacements[:, order], atol=1e-6, rtol=1e-4)
    torch.testing.assert_close(found.pose, expected.pose, atol=1e-6, rtol=1e-4)


def test_any_topology_two_parts_and_a_hole():
    one = sphere(1)
    vertices = np.concatenate([one.vertices, one.vertices * 0.2 + [0.3, 0, 0]])
    faces = np.concatenate([one.faces[1:], one.faces + one.n_vertices])
    model = awake(Gava(small_config(), TriangleMesh(vertices, faces)))
    out = model(*inputs(model))
    assert out.displacements.shape == (3, 84, 3)
    assert torch.isfinite(out.displacements).all()


def test_vertices_do_not_see_the_pose_token(model):
    window, mel, embedding, style = inputs(model)
    out, other = model(window, mel, embedding, style), model(window, mel + 1, embedding, style)
    torch.testing.assert_close(out.displacements, other.displacements)
    assert not torch.allclose(out.pose, other.pose)


def test_movement_spreads_one_ring_a_layer(model):
    """With local features alone, what is three edges away or more cannot matter after three layers."""
    window, mel, embedding, style = inputs(model, batch=1)
    changed = embedding.clone()
    changed[0, 0] += 1
    moved = (
        model(window, mel, changed, style).displacements - model(window, mel, embedding, style).displacements
    )
    reach = np.linalg.matrix_power(model.mesh.adjacency.toarray() + np.eye(model.n_vertices), 3)[0] > 0
    size = moved[0].abs().amax(1).numpy(force=True)
    assert size[~reach].max() == 0
    assert size[reach].max() > 0
    assert 3 < reach.sum() < model.n_vertices


def test_pose_can_be_left_out():
    model = awake(Gava(small_config(pose=False), sphere(1)))
    window, _, embedding, style = inputs(model)
    out = model(window, None, embedding, style)
    assert out.pose.abs().max() == 0
    assert model.graph().n_tokens == 42


def test_styles(model):
    assert not torch.equal(model.style_of("anna"), model.style_of("ben"))
    assert not torch.equal(model.style_of("anna"), model.style_of())
    half = model.style_of("anna", "happy", 0.5)
    expected = model.style_of("anna", "happy", 0.0).lerp(model.style_of("anna", "happy", 1.0), 0.5)
    torch.testing.assert_close(half, expected)
    with pytest.raises(OptionError, match="it has anna, ben"):
        model.style_of("carl")
    with pytest.raises(OptionError, match="neutral, happy"):
        model.style_of("anna", "angry")


def test_subjects_of_one_batch_keep_their_templates(model):
    templates = torch.stack([model.surface.template, model.surface.template * 1.1])
    embedding = model.embed(templates)
    window, mel, _, style = inputs(model, batch=2)
    both = model(window, mel, embedding, style, torch.tensor([1, 0])).displacements
    alone = model(window[:1], mel[:1], embedding[1:], style[:1]).displacements
    torch.testing.assert_close(both[:1], alone, atol=1e-7, rtol=1e-4)


def test_attention_maps(model):
    window, mel, embedding, style = inputs(model)
    for maps in model.attention_maps(window, mel, embedding, style):
        assert maps.received.shape == (3, model.n_vertices, 2)
        assert (maps.received > 0).all()
        assert (maps.received <= 1).all()
        assert (maps.global_row.sum(1) < 1).all()  # the rest goes to the pose token itself
    dense = awake(Gava(small_config(decoder="sa"), sphere(1)))
    maps = dense.attention_maps(*inputs(dense))
    assert len(maps) == dense.config.layers
    assert (maps[0].global_row.sum(1) < 1).all()
    mlp = Gava(small_config(decoder="mlp"), sphere(1))
    with pytest.raises(OptionError, match="no attention"):
        mlp.attention_maps(*inputs(mlp))


def test_dense_attention_is_the_mesh_attention_of_a_complete_graph(model):
    from meshanim.attention import MeshAttention, MeshGraph
    from meshanim.models.gava_parts import DenseAttention

    torch.manual_seed(0)
    sparse, dense = MeshAttention(16, 2), DenseAttention(16, 2)
    dense.load_state_dict(sparse.state_dict())
    pairs = np.stack(np.meshgrid(np.arange(9), np.arange(9)), -1).reshape(-1, 2)
    graph = MeshGraph.from_edges(pairs, 9)
    tokens = torch.randn(2, 10, 16)
    torch.testing.assert_close(dense(tokens, graph), sparse(tokens, graph), atol=1e-6, rtol=1e-4)


def test_checkpoint_round_trip(model, tmp_path):
    model.surface.amplitude.mul_(3)
    model.save_pretrained(tmp_path / "gava")
    assert json.loads((tmp_path / "gava" / "config.json").read_text())["window"] == 16
    loaded = Gava.from_pretrained(tmp_path / "gava")
    assert loaded.config == model.config
    assert not loaded.training
    assert np.array_equal(loaded.mesh.faces, model.mesh.faces)
    window, mel, embedding, style = inputs(model)
    for found, expected in zip(loaded(window, mel, embedding, style), model(window, mel, embedding, style)):
        assert torch.equal(found, expected)


def test_damaged_checkpoints_are_named(model, tmp_path):
    model.save_pretrained(tmp_path)
    weights = tmp_path / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:1000])
    with pytest.raises(FileFormatError, match="no checkpoint of GAVA"):
        Gava.from_pretrained(tmp_path)
    (tmp_path / "config.json").unlink()
    with pytest.raises(FileFormatError, match=r"config\.json"):
        Gava.from_pretrained(tmp_path)


def test_bad_input_is_named(model):
    window, mel, embedding, style = inputs(model)
    with pytest.raises(ShapeError, match="encoder 'visemes'"):
        model(window[..., :5], mel, embedding, style)
    with pytest.raises(ShapeError, match="speech windows"):
        model(window[:0], mel[:0], embedding, style[:0])
    with pytest.raises(ShapeError, match="mel windows"):
        model(window, None, embedding, style)
    with pytest.raises(ShapeError, match="NaN"):
        model(window * torch.nan, mel, embedding, style)
    with pytest.raises(MeshError, match="162"):
        model.embed(torch.zeros(1, 7, 3))
    for options in ({"heads": 3}, {"tokens": 1}, {"layers": 0}):
        with pytest.raises(OptionError, match=next(iter(options))):
            small_config(**options)


def test_the_configuration_is_frozen():
    assert dataclasses.is_dataclass(GavaConfig)
    with pytest.raises(dataclasses.FrozenInstanceError):
        small_config().width = 3
    assert "config" in inspect.signature(Gava).parameters
