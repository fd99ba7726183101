"""Surface correspondence: found again after deformation and change of topology."""

import numpy as np
import pytest
import torch
from shapes import collapsed, moved, plane, sphere, union

from meshanim.errors import MeshError, OptionError, ShapeError
from meshanim.geometry import Similarity, TriangleMesh, decimate, subdivide, surface_correspondence


def face(subdivisions: int = 3) -> TriangleMesh:
    """An egg with a nose, chin and brow, so that no motion along itself leaves it alone; 20 cm high."""
    mesh = sphere(subdivisions)
    x, y, z = mesh.vertices.T
    nose = 0.35 * np.exp(-((x / 0.25) ** 2 + (y / 0.35) ** 2)) * (z > 0)
    chin = 0.2 * np.exp(-((x / 0.4) ** 2 + ((y + 0.8) / 0.25) ** 2)) * (z > 0)
    return mesh.with_vertices(0.1 * np.stack([0.75 * x, y, 0.9 * z + nose + chin], axis=1))


def other_person(vertices: np.ndarray) -> np.ndarray:
    x, y, z = vertices.T
    return np.stack([1.08 * x, 0.95 * y + 0.004 * np.sin(30 * x), z + 0.004 * np.cos(25 * y)], axis=1)


def test_a_head_corresponds_to_itself():
    mesh = face()
    found = surface_correspondence(mesh, mesh)
    np.testing.assert_allclose(found.operator @ mesh.vertices, mesh.vertices, atol=5e-4)
    assert found.distance.max() < 1e-3
    centres = mesh.vertices[mesh.faces].mean(1)
    assert np.linalg.norm(centres[found.faces] - centres, axis=1).max() < 0.006


def test_another_persons_topology():
    source = face()
    finer = subdivide(source, "midpoint")
    coarse = decimate(finer.mesh, 1500)
    truth = coarse.operator @ finer.operator
    target = coarse.mesh.with_vertices(truth @ other_person(source.vertices))
    found = surface_correspondence(source, target)
    error = np.linalg.norm((found.operator - truth) @ source.vertices, axis=1)
    np.testing.assert_allclose(found.operator.sum(1), 1)
    assert np.median(error) < 0.005
    assert np.median(found.distance) < 1e-3
    colours = source.vertices / 0.1
    np.testing.assert_allclose(np.median(np.abs(found.carry(colours) - truth @ colours)), 0, atol=0.04)


def test_animations_cross_by_displacement_and_by_deformation():
    source = face()
    target = subdivide(source, "midpoint").mesh
    target = target.with_vertices(1.3 * other_person(target.vertices))
    found = surface_correspondence(source, target)

    def opened(vertices: np.ndarray, size: float) -> np.ndarray:
        return vertices - size * np.array([0, 0.02, 0]) * (
            1 / (1 + np.exp(vertices[:, 1:2] / (0.01 * size) + 3))
        )

    frames = np.stack([source.vertices, opened(source.vertices, 1.0)])
    expected = opened(target.vertices, 1.3 * 0.95)
    for carried in (found.carry_displacements(frames), found.deformation_transfer().solve(frames)):
        assert carried.shape == (2, target.n_vertices, 3)
        np.testing.assert_allclose(carried[0], target.vertices, atol=1e-9)
        move = np.linalg.norm(expected - target.vertices, axis=1)
        error = np.linalg.norm(carried[1] - expected, axis=1)
        assert error.mean() < 0.15 * move.max()


def test_landmarks_bring_turned_heads_together_and_are_kept():
    source = face()
    turn = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    target = source.with_vertices(2 * source.vertices @ turn.T + 0.5)
    picked = np.array([0, 40, 80, 120, 200, 333, 500])
    found = surface_correspondence(source, target, np.stack([picked, picked], axis=1))
    truth = Similarity(torch.from_numpy(turn), torch.full((3,), 0.5).double(), torch.tensor(2.0).double())
    for a, b in zip(found.alignment, truth):
        torch.testing.assert_close(a, b, atol=1e-6, rtol=0)
    np.testing.assert_allclose(found.operator @ source.vertices, source.vertices, atol=1e-3)
    np.testing.assert_allclose(found.registered[picked], target.vertices[picked], atol=1e-3)


def test_parts_that_only_one_head_has_are_told_by_their_distance():
    source = face()
    target = union(
        other := source.with_vertices(other_person(source.vertices)), moved(sphere(1, 0.01), (0.2, 0, 0))
    )
    found = surface_correspondence(source, target)
    assert np.median(found.distance[: other.n_vertices]) < 1e-3
    assert found.distance[other.n_vertices :].min() > 0.05


def test_open_target_and_flat_triangles_are_taken():
    source = face()
    keep = source.vertices[source.faces].mean(1)[:, 1] > -0.05
    used, faces = np.unique(source.faces[keep], return_inverse=True)
    target = TriangleMesh(source.vertices[used], faces.reshape(-1, 3))
    found = surface_correspondence(source, target, np.stack([used[::40], np.arange(len(used))[::40]], axis=1))
    error = np.linalg.norm(found.operator @ source.vertices - target.vertices, axis=1)
    assert np.median(error) < 1e-3
    assert surface_correspondence(plane(3), collapsed()).operator.shape == (4, 16)


def test_refusals():
    mesh = sphere(1)
    lonely = TriangleMesh(np.vstack([mesh.vertices, [[9.0, 9, 9]]]), mesh.faces)
    with pytest.raises(MeshError, match="target: correspondence needs every vertex"):
        surface_correspondence(mesh, lonely)
    with pytest.raises(MeshError, match="no area"):
        surface_correspondence(collapsed(), mesh)
    with pytest.raises(ShapeError, match="three pairs"):
        surface_correspondence(mesh, mesh, np.array([[0, 0]]))
    with pytest.raises(OptionError, match="source vertices up to 42 of 42"):
        surface_correspondence(mesh, mesh, np.array([[0, 0], [42, 1], [2, 2]]))
