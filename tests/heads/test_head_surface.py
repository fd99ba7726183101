import numpy as np
import pytest
import roma
import scipy.sparse as sp
import torch

from meshanim.errors import FileFormatError, ShapeError
from meshanim.geometry import TriangleMesh
from meshanim.heads import HeadParameters, HeadSurface, RigidPart, load_head
from meshanim.heads.flame import load_flame


@pytest.fixture
def points():
    return np.random.default_rng(0).normal(size=(12, 3))


@pytest.fixture
def surface(points):
    """Three midpoints of head vertices, then a rigid triangle carried by five of them."""
    rows = np.repeat(np.arange(3), 2)
    operator = sp.csr_array((np.full(6, 0.5), (rows, [0, 1, 2, 3, 4, 5])), (3, 12))
    anchors = np.array([3, 5, 7, 9, 11])
    piece = np.random.default_rng(1).normal(size=(3, 3)).astype(np.float32)
    rigid = RigidPart(anchors, points[anchors].astype(np.float32), piece)
    return HeadSurface(np.array([[0, 1, 2], [3, 4, 5]]), operator, [rigid], {"skin": 1, "teeth": 1})


def test_linear_vertices_are_the_operator_and_rigid_ones_follow_a_similarity(surface, points):
    rotation = roma.random_rotmat(2, generator=torch.Generator().manual_seed(0)).double()
    head = torch.from_numpy(points)[None]
    moved = 1.3 * head @ rotation.mT + torch.tensor([0.1, -2.0, 0.3])
    out = surface(moved)
    assert out.shape == (2, 6, 3)
    expected = (moved[:, 0:6:2] + moved[:, 1:6:2]) / 2
    assert torch.allclose(out[:, :3], expected, atol=1e-6)
    piece = torch.from_numpy(surface.rigid[0].vertices).double()
    expected = 1.3 * piece @ rotation.mT + torch.tensor([0.1, -2.0, 0.3])
    assert torch.allclose(out[:, 3:], expected, atol=1e-6)


def test_rigid_fit_is_the_least_squares_one(surface, points):
    """Anchors that do not move rigidly: no small change of the similarity comes closer to them."""
    noise = torch.from_numpy(np.random.default_rng(2).normal(size=points.shape)) * 0.2
    anchors, rest = surface.rigid[0].anchors, torch.from_numpy(surface.rigid[0].rest).double()
    moved = torch.from_numpy(points) + noise
    part = RigidPart(anchors, rest.numpy(), rest.numpy())
    carried = HeadSurface(np.array([[0, 1, 2]]), sp.csr_array((0, 12)), [part])
    fitted = carried(moved[None])[0]
    best = (fitted - moved[anchors]).square().sum()
    generator = torch.Generator().manual_seed(3)
    for _ in range(20):
        turn = roma.rotvec_to_rotmat(0.02 * torch.randn(3, generator=generator).double())
        scale = 1 + 0.02 * torch.randn(1, generator=generator).double()
        shift = 0.02 * torch.randn(3, generator=generator).double()
        center = fitted.mean(0)
        other = scale * (fitted - center) @ turn.T + center + shift
        assert (other - moved[anchors]).square().sum() > best


def test_gradients(surface, points):
    head = torch.from_numpy(points + 0.1 * np.random.default_rng(4).normal(size=points.shape))[None]
    assert torch.autograd.gradcheck(surface, head.requires_grad_(), atol=1e-5, rtol=1e-3)


def test_of_a_mesh_it_is_the_mesh(tetrahedron):
    surface = HeadSurface.of_mesh(tetrahedron)
    vertices = torch.randn(3, 4, 3)
    assert torch.equal(surface(vertices), vertices)
    assert np.array_equal(surface.faces, tetrahedron.faces)


def test_parts(surface):
    assert surface.part("teeth") == slice(1, 2)
    with pytest.raises(KeyError, match="skin, teeth"):
        surface.part("nose")


def test_what_is_saved_reads_back(surface, points, tmp_path):
    surface.save(tmp_path / "surface.npz")
    again = HeadSurface.load(tmp_path / "surface.npz")
    head = torch.from_numpy(points).float()[None]
    assert torch.equal(again(head), surface(head))
    assert again.parts == surface.parts


def test_damage_is_named(surface, tmp_path):
    path = tmp_path / "surface.npz"
    with pytest.raises(FileFormatError, match=r"surface\.npz"):
        HeadSurface.load(path)
    surface.save(path)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(FileFormatError, match=r"surface\.npz"):
        HeadSurface.load(path)
    np.savez(path, faces=surface.faces)
    with pytest.raises(FileFormatError, match="lacks"):
        HeadSurface.load(path)


def test_arrays_that_do_not_fit(surface):
    with pytest.raises(ShapeError, match="carried by 12"):
        surface(torch.zeros(1, 11, 3))
    with pytest.raises(ShapeError, match="up to 9"):
        HeadSurface(np.array([[0, 1, 9]]), sp.eye_array(4, format="csr"))
    with pytest.raises(ShapeError, match="anchors"):
        HeadSurface(
            np.array([[0, 1, 2]]),
            sp.csr_array((0, 4)),
            [RigidPart(np.array([0, 1]), np.zeros((2, 3)), np.zeros((3, 3)))],
        )


def test_a_personal_template_moves_everything_that_hangs_on_it():
    head = load_head("default")
    offset = 0.01 * torch.randn(head.n_vertices, 3, generator=torch.Generator().manual_seed(0))
    params = HeadParameters(jaw=torch.tensor([[0.2, 0.0, 0.0]]))
    moved = head.with_offset(offset)
    assert torch.allclose(moved(HeadParameters())[0], head(HeadParameters())[0] + offset)
    assert not torch.allclose(moved(params)[0], head(params)[0] + offset, atol=1e-4)
    assert isinstance(moved.mesh, TriangleMesh)
    assert np.allclose(moved.mesh.vertices, head.mesh.vertices + offset.double().numpy(), atol=1e-6)
    with pytest.raises(ShapeError, match="offset must be"):
        head.with_offset(offset[1:])


def test_flame_regresses_its_joints_from_the_personal_template(flame_folder, flame_content):
    """As VHAP's FlameHead: the offset is part of the shape before the joints are found."""
    head = load_flame(flame_folder / "generic_model.pkl")
    offset = 0.01 * torch.randn(head.n_vertices, 3, generator=torch.Generator().manual_seed(0))
    joints = head.with_offset(offset).joints()[0]
    expected = flame_content["J_regressor"] @ (flame_content["v_template"] + offset.double().numpy())
    np.testing.assert_allclose(joints, expected, atol=1e-6)
    params = HeadParameters(rotation=torch.tensor([[0.0, 0.7, 0.0]]))
    turned, plain = head.with_offset(offset)(params)[0], head(params)[0]
    assert (turned - plain).abs().max() > 1e-3
