import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from meshanim.errors import ShapeError
from meshanim.heads import JOINT_PARENTS, HeadParameters, joint_transforms, linear_blend_skinning, load_head


@pytest.fixture(scope="module")
def head():
    return load_head("default")


def skinned_by_matrices(vertices, joints, rotation_vectors, parents, weights):
    """Linear blend skinning by 4 x 4 matrices, one vertex batch at a time, in float64."""
    world = []
    for j, parent in enumerate(parents):
        local = np.eye(4)
        local[:3, :3] = Rotation.from_rotvec(rotation_vectors[j]).as_matrix()
        local[:3, 3] = joints[j] - (joints[parent] if parent >= 0 else 0)
        world.append(local if parent < 0 else world[parent] @ local)
    out = np.zeros_like(vertices)
    for j, transform in enumerate(world):
        back = np.eye(4)
        back[:3, 3] = -joints[j]
        matrix = transform @ back
        out += weights[:, j : j + 1] * (vertices @ matrix[:3, :3].T + matrix[:3, 3])
    return out


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31), st.floats(0, 3))
def test_against_matrices(seed, angle):
    generator = np.random.default_rng(seed)
    vertices, joints = generator.normal(size=(7, 3)), generator.normal(size=(5, 3))
    turns = generator.normal(size=(5, 3)) * angle
    weights = generator.dirichlet(np.ones(5), size=7)
    expected = skinned_by_matrices(vertices, joints, turns, JOINT_PARENTS, weights)
    tensors = [torch.from_numpy(array) for array in (vertices, joints, turns)]
    out = linear_blend_skinning(*tensors, JOINT_PARENTS, torch.from_numpy(weights))
    np.testing.assert_allclose(out.numpy(), expected, atol=1e-12)


def test_gradients():
    generator = torch.Generator().manual_seed(0)
    inputs = [
        torch.randn(2, n, 3, dtype=torch.float64, generator=generator, requires_grad=True) for n in (6, 5, 5)
    ]
    weights = torch.rand(6, 5, dtype=torch.float64, generator=generator).softmax(1)
    assert torch.autograd.gradcheck(
        lambda *tensors: linear_blend_skinning(*tensors, JOINT_PARENTS, weights), inputs
    )


def test_gradient_at_rest_is_finite_and_right():
    vertices = torch.randn(4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    joints = torch.zeros(5, 3, dtype=torch.float64)
    weights = torch.zeros(4, 5, dtype=torch.float64)
    weights[:, 0] = 1
    turns = torch.zeros(5, 3, dtype=torch.float64, requires_grad=True)
    out = linear_blend_skinning(vertices, joints, turns, JOINT_PARENTS, weights)
    (gradient,) = torch.autograd.grad(out[0, 1], turns)
    # d(w x v)_y / dw = (-v_z, 0, v_x) read off w x v = (.., w_z v_x - w_x v_z, ..)
    expected = torch.stack([-vertices[0, 2], vertices.new_zeros(()), vertices[0, 0]])
    torch.testing.assert_close(gradient[0], expected)


def test_one_rotation_of_all_is_rigid(head):
    turn = torch.tensor([[0.3, -0.7, 0.2]])
    vertices = head(HeadParameters(rotation=turn))[0].double().numpy()
    matrix = Rotation.from_rotvec(turn[0].numpy()).as_matrix()
    root = head.rest_joints[0].double().numpy()
    np.testing.assert_allclose(vertices, (head.mesh.vertices - root) @ matrix.T + root, atol=1e-6)


def test_pose_is_the_neck_of_forward(head):
    generator = torch.Generator().manual_seed(0)
    shape, turn = (torch.randn(3, n, generator=generator) for n in (len(head.shape_names), 3))
    posed = head.pose(head.template(shape), 0.3 * turn, shape)
    torch.testing.assert_close(posed, head(HeadParameters(shape=shape, neck=0.3 * turn)), atol=1e-6, rtol=0)


def test_weights_are_a_partition_of_unity(head):
    torch.testing.assert_close(head.weights.sum(1), torch.ones(head.n_vertices))
    assert head.weights.min() >= 0


def test_a_child_before_its_parent_is_refused():
    with pytest.raises(ShapeError, match="parents"):
        joint_transforms(torch.zeros(2, 3), torch.eye(3).expand(2, 3, 3), (1, -1))
    with pytest.raises(ShapeError, match="agree"):
        joint_transforms(torch.zeros(2, 3), torch.eye(3).expand(2, 3, 3), (-1,))
