import numpy as np
import pytest
import torch
from corpus_small import write_small_corpus
from PIL import Image

from meshanim.cli import main
from meshanim.datasets.meshanim_format import MeshanimDataset
from meshanim.errors import OptionError
from meshanim.models.gava import Gava, GavaConfig
from meshanim.training.gava_maps import GavaMapsOptions, draw_gava_maps, vertex_maps


@pytest.fixture(scope="module")
def corpus(tmp_path_factory):
    return write_small_corpus(tmp_path_factory.mktemp("corpus") / "sphere", seconds=0.6)


def network(mesh, **changes):
    torch.manual_seed(3)
    settings = {"width": 8, "heads": 2, "layers": 3, "rank": 6, "tokens": 60, "encoder": "mel"}
    return Gava(GavaConfig(feature_dim=80, feature_rate=100.0, **(settings | changes)), mesh).eval()


def maps_of(model, frames=2):
    generator = torch.Generator().manual_seed(0)
    window = torch.randn(frames, 16, 80, generator=generator)
    mel = torch.randn(frames, 32, 80, generator=generator) if model.config.pose else None
    return vertex_maps(model, window, mel, model.surface.template, model.style_of()), window, mel


@pytest.mark.parametrize("decoder", ["gava", "sa"])
@pytest.mark.parametrize("tokens", [60, "vertices"])
def test_maps_have_a_number_for_every_vertex_and_their_scale(corpus, decoder, tokens):
    model = network(MeshanimDataset(corpus).mesh, decoder=decoder, tokens=tokens)
    maps, _, _ = maps_of(model)
    assert maps.audio.shape == maps.pose.shape == (3, 2, 162)
    assert ((maps.audio > 0) & (maps.audio <= 1)).all()
    assert (maps.pose > 0).all()
    at_tokens = maps.pose[:, :, model.surface.vertices]
    assert torch.allclose(at_tokens.mean(-1), torch.ones(3, 2), atol=1e-5)  # even shares
    assert maps.vertices.shape == (2, 162, 3)
    assert (maps.pose.std(-1) > 1e-4).all()


def test_received_attention_is_the_column_maximum_of_the_softmax(corpus):
    model = network(MeshanimDataset(corpus).mesh, decoder="sa", tokens="vertices", layers=1, heads=1)
    maps, window, mel = maps_of(model)
    with torch.no_grad():
        embedding, style = model.embed(model.surface.template[None]), model.style_of().expand(2, -1)
        features, pose = model.tokens(window, mel, embedding, style)
        tokens = torch.cat([features, pose[:, None]], 1)
        block = model.decoder.blocks[0]
        query, key, _ = block.attention.project_in(block.norm_attention(tokens)).chunk(3, dim=-1)
        scores = query @ key.mT / 8**0.5
    expected = scores[:, :-1, :-1].softmax(-1).amax(1)
    assert torch.allclose(maps.audio[0], expected, atol=1e-5)
    row = scores[:, -1].softmax(-1)[:, :-1]
    assert torch.allclose(maps.pose[0], row / row.sum(1, keepdim=True) * 162, atol=1e-4)


def test_without_pose_token_there_is_no_pose_map_and_without_attention_none(corpus):
    mesh = MeshanimDataset(corpus).mesh
    maps, _, _ = maps_of(network(mesh, pose=False))
    assert maps.pose is None
    assert not maps.rotation.any()
    with pytest.raises(OptionError, match="no attention"):
        maps_of(network(mesh, decoder="mlp"))


def test_the_command_draws_a_row_a_sound_and_a_column_a_layer(corpus, tmp_path):
    dataset = MeshanimDataset(corpus)
    for name, changes in (("with", {}), ("without", {"pose": False})):
        network(dataset.mesh, **changes).save_pretrained(tmp_path / name / "model")
    file = tmp_path / "maps.png"
    models = [str(tmp_path / name / "model") for name in ("with", "without")]
    words = ["evaluate", "gava-maps", "--data", str(corpus), "--output", str(file), "--size", "48"]
    assert main([*words, "--phonemes", "B", "--models", *models]) == 0
    picture = np.asarray(Image.open(file))
    assert picture.shape == (2 * 48, 5 * 48, 3)
    tiles = picture.reshape(2, 48, 5, 48, 3).transpose(0, 2, 1, 3, 4)
    saturation = (tiles.max(-1).astype(int) - tiles.min(-1)).mean((2, 3))
    assert (saturation[:, 1:4] > 5 * saturation[:, :1] + 1).all()  # clay is grey, maps are not
    assert saturation[1, 4] == 0  # no pose token, no tile
    with pytest.raises(OptionError, match="no sequence"):
        draw_gava_maps(GavaMapsOptions(corpus, file, phonemes=("ZH",)))
