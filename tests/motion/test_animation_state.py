import json

import numpy as np
import pytest
import roma
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from meshanim.errors import FileFormatError, MeshError, ShapeError
from meshanim.heads import Head, load_head
from meshanim.motion.animation_state import (
    Actors,
    StateBasis,
    eye_angles,
    eye_rotation,
    read_actors,
    write_actors,
)
from meshanim.motion.components import principal_components
from meshanim.motion.face_parts import FaceParts, face_parts


@pytest.fixture(scope="module")
def head():
    return load_head("default")


@pytest.fixture(scope="module")
def parts(head):
    return face_parts(head)


def basis_of(parts, vertices, template, skin=140, tongue=10):
    tensors = []
    for which, count in ((parts.skin, skin), (parts.tongue, tongue)):
        moved = (vertices - template)[:, which].reshape(len(vertices), -1).numpy().astype(np.float64)
        found = principal_components(lambda moved=moved: iter([moved]), count, passes=2)
        for array in (found.mean, found.components):
            tensors.append(
                torch.from_numpy(array.reshape(*array.shape[:-1], array.shape[-1] // 3, 3).astype(np.float32))
            )
    return StateBasis(parts, *tensors, eyes=True)


def rotation(axis, angle):
    return roma.rotvec_to_rotmat(torch.tensor(axis) * angle)


def test_a_state_has_the_169_numbers_of_the_paper(parts, head):
    generator = torch.Generator().manual_seed(0)
    template = head.template_vertices
    vertices = template + 1e-3 * torch.randn(170, *template.shape, generator=generator)
    basis = basis_of(parts, vertices, template)
    assert basis.sizes == {"skin": 140, "tongue": 10, "jaw": 15, "eyes": 4}
    assert basis.encode(vertices[:3], template).shape == (3, 169)
    assert basis.columns["eyes"] == slice(165, 169)


def test_faces_come_back(parts, head, tmp_path):
    """Every vertex, jaw and eyes rigidly moved included, from the state alone, also after a file."""
    generator = torch.Generator().manual_seed(1)
    template = head.template_vertices
    fields = 1e-3 * torch.randn(6, *template.shape, generator=generator)
    vertices = template + torch.einsum("tk,kvc->tvc", torch.randn(40, 6, generator=generator), fields)
    fixed = np.setdiff1d(
        np.concatenate([head.regions["teeth"]]), np.concatenate([parts.jaw_rigid, parts.jaw_points])
    )
    vertices[:, fixed] = template[fixed]
    jaw = np.union1d(parts.jaw_rigid, parts.jaw_points)
    for frame in range(40):
        turn = rotation([1.0, 0.0, 0.0], 0.005 * frame)
        vertices[frame, jaw] = template[jaw] @ turn.mT + torch.tensor([0.0, -1e-4 * frame, 0.0])
        for side, ball in enumerate((parts.right_eye, parts.left_eye)):
            centre = template[ball].mean(0)
            angles = torch.tensor([0.004 * frame, -0.006 * frame + 0.1 * side])
            vertices[frame, ball] = (template[ball] - centre) @ eye_rotation(angles).mT + centre
    basis = basis_of(parts, vertices, template)
    write_actors(tmp_path / "basis.safetensors", Actors(basis, {"anna": template}, head.mesh.faces))
    basis, templates, faces = read_actors(tmp_path / "basis.safetensors")
    assert torch.equal(templates["anna"], template)
    assert np.array_equal(faces, head.mesh.faces)
    states = basis.encode(vertices, template)
    torch.testing.assert_close(
        states[:, basis.columns["eyes"]][10], torch.tensor([0.04, -0.06, 0.04, 0.04]), atol=1e-5, rtol=0
    )
    torch.testing.assert_close(basis.vertices(states, template), vertices, atol=2e-5, rtol=0)
    found = basis.jaw_transform(basis.decode(states).jaw, template)
    torch.testing.assert_close(found.rotation[20], rotation([1.0, 0.0, 0.0], 0.1), atol=1e-5, rtol=0)


@settings(max_examples=50, deadline=None)
@given(st.floats(-1.2, 1.2), st.floats(-1.2, 1.2), st.floats(-0.5, 0.5))
def test_eye_angles_say_where_the_gaze_goes(pitch, yaw, torsion):
    angles = torch.tensor([pitch, yaw], dtype=torch.float64)
    turned = eye_rotation(angles)
    torch.testing.assert_close(eye_angles(turned), angles, atol=1e-9, rtol=0)
    twisted = turned @ rotation([0.0, 0.0, 1.0], torsion).double()
    torch.testing.assert_close(eye_angles(twisted), angles, atol=1e-6, rtol=0)


def test_signs_of_the_eyes():
    left = eye_rotation(torch.tensor([0.0, 0.3])) @ torch.tensor([0.0, 0.0, 1.0])
    down = eye_rotation(torch.tensor([0.3, 0.0])) @ torch.tensor([0.0, 0.0, 1.0])
    assert left[0] > 0
    assert left[1] == 0
    assert down[1] < 0


def test_parts_of_the_default_head(head, parts):
    vertices = head.mesh.vertices
    assert len(parts.skin) + sum(len(head.regions[r]) for r in ("tongue", "eyes", "teeth")) == head.n_vertices
    points = vertices[parts.jaw_points]
    assert points[0, 0] > 0.02 > -0.02 > points[1, 0]  # back teeth, the wearer's left first
    assert abs(points[4, 0]) < 1e-6
    assert points[4, 2] == points[:, 2].max()
    assert (head.weights[parts.jaw_points, 2] == 1).all()
    assert (np.diff(vertices[parts.lip_pairs[:, 0], 0]) > 0).all()
    assert (vertices[parts.upper_lip[:, 0], 1] > vertices[parts.upper_lip[:, 1], 1] + 0.005).all()
    assert (vertices[parts.lower_lip[:, 0], 1] > vertices[parts.lower_lip[:, 1], 1] + 0.005).all()
    assert (vertices[parts.left_eye, 0] > 0).all()
    weights = head.expression({"eyeBlinkLeft": 1.0, "eyeBlinkRight": 1.0})
    shut = head.deform(expression=weights)[0].numpy()
    upper, lower = parts.lid_pairs.T
    gap = np.linalg.norm(shut[upper] - shut[lower], axis=1).mean()
    assert gap < 0.3 * np.linalg.norm(vertices[upper] - vertices[lower], axis=1).mean()
    weights = head.expression({"jawOpen": 1.0})
    opened = head.deform(expression=weights)[0].numpy()
    upper, lower = parts.lip_pairs.T
    assert (opened[upper, 1] - opened[lower, 1] > 0.01).all()


def test_a_head_without_pairs_of_its_own_gets_them_from_its_jaw(head, parts):
    plain = Head(
        head.mesh,
        np.zeros((head.n_vertices, 3, 0)),
        np.moveaxis(head.expression_directions.unflatten(1, (-1, 3)).numpy(), 0, -1),
        [],
        head.expression_names,
        head.rest_joints.numpy(),
        np.zeros((5, 3, 0)),
        head.weights.numpy(),
        head.regions,
    )
    found = face_parts(plain)
    vertices = head.mesh.vertices
    distance = np.linalg.norm(vertices[found.lip_pairs] - vertices[parts.lip_pairs], axis=-1)
    assert found.lip_pairs.shape == (5, 2)
    assert distance.max() < 0.01
    opened = head.deform(expression=head.expression({"jawOpen": 1.0}))[0].numpy()
    upper, lower = found.lip_pairs.T
    assert (opened[upper, 1] - opened[lower, 1] > 0.008).all()


def test_a_rig_without_joints_follows_its_shape_jaw_open(head, parts):
    plain = Head(
        head.mesh,
        np.zeros((head.n_vertices, 3, 0)),
        np.moveaxis(head.expression_directions.unflatten(1, (-1, 3)).numpy(), 0, -1),
        [],
        head.expression_names,
        head.rest_joints.numpy(),
        np.zeros((5, 3, 0)),
        np.eye(5)[np.ones(head.n_vertices, int)],
        head.regions,
    )
    found = face_parts(plain)
    assert set(found.jaw_points) <= set(head.regions["teeth"])
    assert (head.weights[found.jaw_points, 2] == 1).all()
    np.testing.assert_array_equal(found.jaw_rigid, parts.jaw_rigid)


def test_parts_in_a_file(parts, tmp_path, unchecked):
    parts.save(tmp_path / "parts.json")
    loaded = FaceParts.load(tmp_path / "parts.json")
    assert all(np.array_equal(a, b) for a, b in zip(parts.arrays().values(), loaded.arrays().values()))
    (tmp_path / "few.json").write_text(json.dumps({"skin": [0, 1, 2]}))
    assert FaceParts.load(tmp_path / "few.json").jaw_points.shape == (0,)
    for text in (
        "[1]",
        "{}",
        '{"skin": [0], "nose": [1]}',
        '{"skin": [-1]}',
        '{"skin": [0], "jaw_points": [1]}',
    ):
        (tmp_path / "bad.json").write_text(text)
        with pytest.raises(FileFormatError, match=r"bad\.json"):
            FaceParts.load(tmp_path / "bad.json")
    with pytest.raises(FileFormatError, match="cannot read"):
        FaceParts.load(tmp_path / "none.json")


def test_bad_input_is_named(parts, head, tmp_path, unchecked):
    template = head.template_vertices
    basis = basis_of(parts, template + torch.zeros(3, 1, 1), template)
    assert basis.width == 19
    with pytest.raises(ShapeError, match="100 vertices"):
        basis.encode(template[None, :100], template[:100])
    with pytest.raises(ShapeError, match="169"):
        basis.decode(torch.zeros(2, 169))
    without = StateBasis(
        FaceParts.from_arrays({"skin": np.arange(3)}),
        torch.zeros(3, 3),
        torch.zeros(0, 3, 3),
        torch.zeros(0, 3),
        torch.zeros(0, 0, 3),
        eyes=True,
    )
    with pytest.raises(MeshError, match="no jaw points"):
        without.jaw_transform(torch.zeros(1, 5, 3), torch.zeros(3, 3))
    with pytest.raises(ShapeError, match="no eyeballs"):
        without.encode(torch.zeros(1, 3, 3), torch.zeros(3, 3))
    (tmp_path / "basis.safetensors").write_bytes(b"\x10" * 100)
    with pytest.raises(FileFormatError, match="no basis"):
        read_actors(tmp_path / "basis.safetensors")
