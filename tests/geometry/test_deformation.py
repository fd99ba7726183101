"""Deformation gradients and transfer: exact on affine maps, equal to the original system."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from shapes import collapsed, moved, plane, rotations, sphere, torus, union

from meshanim.errors import MeshError, ShapeError
from meshanim.geometry import DeformationTransfer, TriangleMesh, deformation_gradients


def tensors(mesh: TriangleMesh) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.from_numpy(mesh.vertices), torch.from_numpy(mesh.faces)


def bent(mesh: TriangleMesh, amount: float = 0.3) -> np.ndarray:
    x, y, z = mesh.vertices.T
    return np.stack([x + amount * np.sin(2 * y), y + amount * z**2, z - amount * x * y], axis=1)


@settings(deadline=None, max_examples=15)
@given(rotations(), st.floats(0.1, 10))
def test_gradients_of_similarities(rotation, scale):
    vertices, faces = tensors(torus())
    turn = torch.from_numpy(rotation)
    found = deformation_gradients(vertices, scale * vertices @ turn.T + 1, faces)
    torch.testing.assert_close(found, (scale * turn).expand_as(found), atol=1e-7, rtol=1e-7)


def test_gradients_map_sides_and_chain():
    mesh = torus()
    vertices, faces = tensors(mesh)
    first, second = torch.from_numpy(bent(mesh)), torch.from_numpy(bent(mesh, -0.5))
    to_first = deformation_gradients(vertices, first, faces)
    a, b = faces[:, 0], faces[:, 2]
    mapped = (to_first @ (vertices[b] - vertices[a])[..., None])[..., 0]
    torch.testing.assert_close(mapped, first[b] - first[a])
    onwards = deformation_gradients(first, second, faces)
    torch.testing.assert_close(onwards @ to_first, deformation_gradients(vertices, second, faces))
    batch = deformation_gradients(vertices, torch.stack([first, second]), faces)
    torch.testing.assert_close(batch[0], to_first)


def test_gradients_differentiate_also_on_collapsed_triangles():
    mesh = plane(1)
    rest, faces = tensors(mesh)
    deformed = torch.from_numpy(bent(mesh)).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: deformation_gradients(rest, x, faces), deformed)
    flat = torch.zeros_like(rest, requires_grad=True)
    deformation_gradients(rest, flat, faces).sum().backward()
    assert torch.isfinite(flat.grad).all()
    with pytest.raises(MeshError, match="face 1"):
        deformation_gradients(*tensors(collapsed())[:1] * 2, tensors(collapsed())[1])


def test_transfer_between_equal_meshes_is_exact():
    mesh = union(torus(), moved(sphere(1), (3, 0, 0)))
    frames = np.stack([mesh.vertices, bent(mesh), bent(mesh, -0.2)])
    np.testing.assert_allclose(DeformationTransfer(mesh, mesh).solve(frames), frames, atol=1e-9)


@settings(deadline=None, max_examples=10)
@given(st.integers(0, 1000))
def test_affine_maps_carry_over_exactly_up_to_place(seed):
    random = np.random.default_rng(seed)
    source, target = torus(), torus(0.8, 0.3)
    matrix = np.eye(3) + 0.4 * random.standard_normal((3, 3))
    # In-plane parts of an affine map are affine; its action on normals is free.
    solved = DeformationTransfer(source, target).solve(source.vertices @ matrix.T)
    expected = target.vertices @ matrix.T
    np.testing.assert_allclose(solved - solved.mean(0), expected - expected.mean(0), atol=1e-9)


def test_transfer_equals_the_system_with_fourth_vertices():
    # Sumner and Popovic's own unknowns: every vertex and one more per triangle, least squares on all nine
    # entries of each gradient; with area weights it must give the same vertices.
    source, target = sphere(1), sphere(1).with_vertices(bent(sphere(1), 0.1))
    frame = bent(source, 0.4)
    wanted = deformation_gradients(*tensors(source)[:1], torch.from_numpy(frame), tensors(source)[1]).numpy()
    n, f = target.n_vertices, target.n_faces
    rows, right = np.zeros((9 * f, 3 * (n + f))), np.zeros(9 * f)
    for t, face in enumerate(target.faces):
        a, b, c = target.vertices[face]
        normal = np.cross(b - a, c - a)
        inverse = np.linalg.inv(np.stack([b - a, c - a, normal / np.sqrt(np.linalg.norm(normal))], axis=1))
        root = np.sqrt(target.face_areas[t])
        for row in range(3):
            for column in range(3):
                line = 9 * t + 3 * row + column
                right[line] = root * wanted[t, row, column]
                for corner, weight in zip([*face[1:], n + t], inverse[:, column]):
                    rows[line, 3 * corner + row] += root * weight
                    rows[line, 3 * face[0] + row] -= root * weight
    solution = np.linalg.lstsq(rows, right, rcond=None)[0].reshape(-1, 3)[:n]
    ours = DeformationTransfer(source, target).solve(frame)
    np.testing.assert_allclose(ours - ours.mean(0), solution - solution.mean(0), atol=1e-8)


def test_correspondence_rotation_scale_and_still_faces():
    source, target = torus(), torus()
    order = np.random.default_rng(0).permutation(source.n_faces)
    shuffled = TriangleMesh(source.vertices, source.faces[order])
    frame = bent(source)
    np.testing.assert_allclose(
        DeformationTransfer(shuffled, target, np.argsort(order)).solve(frame), frame, atol=1e-9
    )
    turn = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    turned = target.with_vertices(2 * target.vertices @ turn.T)
    solved = DeformationTransfer(source, turned, rotation=turn, scale=2.0).solve(frame)
    np.testing.assert_allclose(solved, 2 * frame @ turn.T, atol=1e-9)
    still = DeformationTransfer(source, target, np.full(target.n_faces, -1)).solve(frame)
    np.testing.assert_allclose(still, target.vertices, atol=1e-9)


def test_many_frames_in_single_precision_and_none():
    mesh = sphere(1)
    transfer = DeformationTransfer(mesh, mesh)
    frames = np.stack([bent(mesh, 0.01 * k) for k in range(150)]).astype(np.float32).reshape(3, 50, -1, 3)
    solved = transfer.solve(frames)
    assert solved.dtype == np.float32
    np.testing.assert_allclose(solved, frames, atol=1e-5)
    assert transfer.solve(frames[0, :0]).shape == (0, mesh.n_vertices, 3)


def test_refusals():
    mesh = sphere(1)
    with pytest.raises(ShapeError, match="give the correspondence"):
        DeformationTransfer(torus(), mesh)
    with pytest.raises(ShapeError, match="entries"):
        DeformationTransfer(torus(), mesh, np.zeros(3, int))
    with pytest.raises(MeshError, match="source faces"):
        DeformationTransfer(mesh, mesh, np.full(mesh.n_faces, 80))
    with pytest.raises(MeshError, match="target: 1 triangles have no area"):
        DeformationTransfer(plane(1), collapsed())
    lonely = TriangleMesh(np.vstack([mesh.vertices, [[9.0, 9, 9]]]), mesh.faces)
    with pytest.raises(MeshError, match="belong to no face"):
        DeformationTransfer(mesh, lonely)
    with pytest.raises(ShapeError, match="frames have 5"):
        DeformationTransfer(mesh, mesh).solve(np.zeros((5, 3)))
