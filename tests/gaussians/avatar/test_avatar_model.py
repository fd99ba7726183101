import json
from importlib.resources import files
from pathlib import Path

import pytest
import torch
from made_capture import made_avatar, made_cameras, made_parameters, write_rig

from meshanim.errors import FileFormatError, OptionError, ShapeError
from meshanim.gaussians.avatar import Avatar, AvatarConfig
from meshanim.gaussians.avatar.colors import ExpressionColors
from meshanim.heads import HeadParameters


@pytest.fixture
def head(tmp_path):
    return write_rig(tmp_path / "rig.npz")


def rich_avatar(head):
    avatar = made_avatar(head, latent=4, hidden=8, sh_degree=2)
    with torch.no_grad():
        avatar.sh_rest.normal_(0, 0.1)
        avatar.colors.outer.normal_()
        avatar.means.normal_(0, 0.2)
    return avatar


def test_what_is_saved_is_what_is_loaded(head, tmp_path):
    avatar, cameras, parameters = rich_avatar(head), made_cameras(2), made_parameters(2)
    avatar.save_pretrained(tmp_path / "avatar")
    again = Avatar.from_pretrained(tmp_path / "avatar")
    assert again.config == avatar.config
    assert torch.equal(again(parameters, cameras).rgb, avatar(parameters, cameras).rgb)
    avatar.save_pretrained(tmp_path / "avatar", half=True)
    rough = Avatar.from_pretrained(tmp_path / "avatar")
    difference = (rough(parameters, cameras).rgb - avatar(parameters, cameras).rgb).abs()
    assert 0 < difference.mean() < 1 / 255


def test_a_personal_template_is_kept(head, tmp_path):
    plain = made_avatar(head)
    offset = torch.full((plain.head.n_vertices, 3), 0.01)
    from meshanim.heads import load_head

    avatar = Avatar(plain.config, load_head(head), static_offset=offset)
    avatar.save_pretrained(tmp_path / "avatar")
    again = Avatar.from_pretrained(tmp_path / "avatar")
    moved = again.vertices(HeadParameters()) - plain.vertices(HeadParameters())
    assert torch.allclose(moved, torch.tensor(0.01), atol=1e-6)


def test_parameters_and_vertices_pose_alike(head):
    avatar, cameras, parameters = rich_avatar(head), made_cameras(2), made_parameters(3)
    wanted = avatar(parameters, cameras).rgb
    assert wanted.shape == (3, 2, 20, 20, 3)
    vertices = avatar.vertices(parameters)
    assert torch.equal(avatar(vertices, cameras, parameters=parameters).rgb, wanted)
    one = avatar(vertices[1], cameras, parameters=HeadParameters(expression=parameters.expression[1:2]))
    assert torch.allclose(one.rgb, wanted[1], atol=1e-5)
    # Without parameters the colours are the neutral ones.
    assert not torch.allclose(avatar(vertices, cameras).rgb, wanted, atol=1e-3)
    with pytest.raises(ShapeError, match="vertices must be"):
        avatar(vertices[:, :-1], cameras)


def test_colors_of_a_batch_are_those_of_its_frames():
    torch.manual_seed(0)
    colors = ExpressionColors(4, 5, 8)
    latents, expression = torch.randn(7, 4), torch.randn(3, 5)
    both = torch.cat([latents.expand(3, -1, -1), expression[:, None].expand(-1, 7, -1)], -1)
    weight = torch.cat([colors.by_latent, colors.by_expression])
    hidden = torch.relu(torch.relu(both @ weight + colors.bias) @ colors.inner + colors.inner_bias)
    assert torch.allclose(colors(latents, expression), hidden @ colors.outer, atol=1e-6)
    for row in range(3):
        assert torch.allclose(
            colors(latents, expression[row : row + 1]), (hidden @ colors.outer)[row], atol=1e-6
        )


def test_fewer_expressions_than_the_head_has_and_no_more(head):
    avatar = rich_avatar(head)
    one = avatar.drive(HeadParameters(expression=torch.ones(2, 1), jaw=torch.ones(1, 3)))
    assert one.tolist() == [[1, 0, 1, 1, 1, 0, 0, 0, 0, 0, 0]] * 2
    with pytest.raises(ShapeError, match="expression has 3"):
        avatar.drive(HeadParameters(expression=torch.ones(2, 3)))


def test_damage_is_named(head, tmp_path):
    folder = tmp_path / "avatar"
    with pytest.raises(FileFormatError, match=r"config\.json"):
        Avatar.from_pretrained(folder)
    made_avatar(head).save_pretrained(folder)
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config | {"format": "else"}))
    with pytest.raises(FileFormatError, match="describes no avatar"):
        Avatar.from_pretrained(folder)
    (folder / "config.json").write_text(json.dumps(config))
    whole = (folder / "avatar.safetensors").read_bytes()
    (folder / "avatar.safetensors").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(FileFormatError, match="no whole avatar"):
        Avatar.from_pretrained(folder)
    with pytest.raises(OptionError, match="cannot have"):
        AvatarConfig(sh_degree=4)


def test_the_avatar_that_ships_is_whole_and_small():
    avatar = Avatar.from_pretrained("default")
    assert avatar.config.name == "Bruno"
    assert len(avatar) > 20_000
    rows = [avatar.means, avatar.scales, avatar.rotations, avatar.opacities, avatar.sh0, avatar.latents]
    assert all(torch.isfinite(values).all() for values in rows)
    weights = Path(str(files("meshanim.gaussians.avatar"))) / "weights" / "default"
    assert sum(path.stat().st_size for path in weights.iterdir()) < 2.4e6
