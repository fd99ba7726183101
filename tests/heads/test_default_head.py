import hashlib
from importlib.resources import files

import numpy as np
import pytest
import torch

from meshanim.errors import OptionError, ShapeError
from meshanim.heads import JOINT_NAMES, REGION_NAMES, HeadParameters, load_head


@pytest.fixture(scope="module")
def head():
    return load_head("default")


def test_the_file_is_the_one_of_the_provenance():
    folder = files("meshanim.heads.default")
    digest, name = (folder / "head.npz.sha256").read_text().split()
    assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == digest
    assert (folder / name).stat().st_size < 2.5e6


def test_it_stands_where_the_conventions_say(head):
    left, right = (head.rest_joints[JOINT_NAMES.index(f"{side}_eye")] for side in ("left", "right"))
    torch.testing.assert_close(left, torch.tensor([0.031, 0.033, 0.038]), atol=1e-3, rtol=0)
    torch.testing.assert_close(right, left * torch.tensor([-1, 1, 1]), atol=1e-6, rtol=0)
    vertices = head.mesh.vertices
    nose = vertices[head.regions["nose"]]
    assert nose[:, 2].max() == vertices[:, 2].max()
    assert vertices[head.regions["scalp"], 1].max() == vertices[:, 1].max()
    assert 0.10 < np.ptp(vertices[:, 0]) < 0.20


def test_left_shapes_act_on_the_left(head):
    names = head.expression_names
    directions = head.expression_directions.unflatten(1, (-1, 3)).norm(dim=-1).numpy()
    for name in ("eyeBlink", "browDown", "cheekSquint", "mouthSmile", "noseSneer", "eyeSquint"):
        travel = directions[names.index(f"{name}Left")]
        assert (travel * head.mesh.vertices[:, 0]).sum() > 0
        travel = directions[names.index(f"{name}Right")]
        assert (travel * head.mesh.vertices[:, 0]).sum() < 0


def test_parts_tile_the_mesh(head):
    vertices = np.concatenate([part.vertices for part in head.parts.values()])
    np.testing.assert_array_equal(vertices, np.arange(head.n_vertices))
    for part in head.parts.values():
        assert set(part.quads.ravel()) == set(part.vertices)
        np.testing.assert_array_equal(
            head.mesh.faces[part.faces], part.quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
        )
    skin = head.parts["skin"]
    edges = np.sort(skin.quads[:, [[0, 1], [1, 2], [2, 3], [3, 0]]].reshape(-1, 2), axis=1)
    unique, counts = np.unique(edges, axis=0, return_counts=True)
    boundary = unique[counts == 1]
    assert set(head.neck_loop) <= set(boundary.ravel())
    assert counts.max() == 2


def test_the_atlas_has_no_overlap(head):
    size = 256
    uv = head.atlas_uv[head.mesh.uv_faces]
    assert uv.min() >= 0
    assert uv.max() <= 1
    area = np.abs(np.linalg.det(uv[:, 1:] - uv[:, :1])).sum() / 2
    centres = (uv.mean(1) * size).astype(int)
    assert 0.4 < area < 0.8
    owners = {}
    for name, part in head.parts.items():
        for cell in set(map(tuple, centres[part.faces])):
            assert owners.setdefault(cell, name) == name


def test_every_region_is_there_and_apart(head):
    assert set(REGION_NAMES) <= set(head.regions)
    assert all(len(head.regions[name]) > 100 for name in REGION_NAMES)
    exclusive = ["eyes", "teeth", "tongue", "ears", "neck", "scalp", "face"]
    joined = np.concatenate([head.regions[name] for name in exclusive])
    assert len(joined) == len(set(joined))
    assert set(head.regions["nose"]) <= set(head.regions["face"])
    assert set(head.regions["lips"]) <= set(head.regions["face"])


def test_identity_moves_joints_with_the_mesh(head):
    shape = torch.randn(4, len(head.shape_names), generator=torch.Generator().manual_seed(0))
    eye = torch.from_numpy(head.parts["left_eye"].vertices)
    centre = head.template(shape)[:, eye].mean(1)
    torch.testing.assert_close(head.joints(shape)[:, 3], centre, atol=2e-5, rtol=0)


def test_jaw_rotation_and_jaw_open_both_lower_the_chin(head):
    chin = head.regions["jaw"]
    rest = head()[0, chin, 1]
    turned = head(HeadParameters(jaw=torch.tensor([[0.2, 0, 0]])))[0, chin, 1]
    shaped = head(HeadParameters(expression=head.expression({"jawOpen": 1.0})))[0, chin, 1]
    assert (turned - rest).mean() < -0.005
    assert (shaped - rest).mean() < -0.005


def test_the_seal_closes_the_middle_of_every_mouth(head):
    shape = head.sample_shapes(50, torch.Generator().manual_seed(1))
    upper, lower = torch.from_numpy(head.lip_pairs).T
    for jaw in (0.0, 0.1, 0.3):
        weights = {"jawOpen": jaw, "mouthClose": jaw, "lipSeal": 1.0}
        vertices = head(HeadParameters(shape=shape, expression=head.expression(weights)))
        gap = vertices[:, upper, 1] - vertices[:, lower, 1]
        assert gap.mean(1).max() < 0
        assert gap.mean(1).min() > -0.0025
    delta = head.seal(shape)
    change = head.deform(shape, head.expression({"lipSeal": 1.0})) - head.deform(shape)
    torch.testing.assert_close(change, delta, atol=1e-7, rtol=0)


def test_wrong_names_and_widths_are_named(head):
    with pytest.raises(OptionError, match="mouthOpen"):
        head.expression({"mouthOpen": 1.0})
    with pytest.raises(OptionError, match="nobody"):
        head.person("nobody")
    with pytest.raises(ShapeError, match="columns"):
        head(HeadParameters(shape=torch.zeros(1, 500)))
    with pytest.raises(ShapeError, match="batch"):
        head(HeadParameters(shape=torch.zeros(2, 3), jaw=torch.zeros(3, 3)))
    with pytest.raises(OptionError, match="default"):
        load_head("nothing")


def test_a_dozen_people_differ(head):
    assert len(head.people) == 12
    faces = head.template(torch.cat([head.person(name) for name in head.people]))[:, head.regions["face"]]
    faces = faces - faces.mean(1, keepdim=True)
    distance = (faces[:, None] - faces[None]).square().sum(-1).mean(-1).sqrt()
    assert distance[~torch.eye(12, dtype=bool)].min() > 0.003


def test_the_mean_person_is_a_small_step_from_the_template(head):
    step = head.template(head.shape_mean[None])[0] - head.template_vertices
    assert 0.001 < step.square().sum(-1).mean().sqrt() < 0.004
    sampled = head.sample_shapes(4000, torch.Generator().manual_seed(0))
    torch.testing.assert_close(sampled.mean(0), head.shape_mean, atol=0.08, rtol=0)
    torch.testing.assert_close(sampled.std(0), torch.ones(sampled.shape[1]), atol=0.08, rtol=0)
