import json
import struct

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from meshanim.errors import OptionError, ShapeError
from meshanim.export.gltf import GltfMaterial, morph_basis, write_glb
from meshanim.geometry import TriangleMesh
from meshanim.motion import MeshSequence


def sphere_sequence(frames=20, uv=False, seed=0):
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    rng = np.random.default_rng(seed)
    shapes = rng.normal(0, 0.002, (3, *ball.vertices.shape))
    weights = rng.uniform(-1, 1, (frames, 3))
    vertices = ball.vertices + np.einsum("tk,kvc->tvc", weights, shapes)
    texture = ball.vertices[:, :2] * 5 + 0.5 if uv else None
    mesh = TriangleMesh(ball.vertices, ball.faces, texture)
    pose = rng.normal(0, 0.2, (frames, 3)).astype(np.float32)
    return MeshSequence(vertices.astype(np.float32), 25.0, mesh, pose)


def read_glb(path):
    data = path.read_bytes()
    magic, version, length, size = struct.unpack_from("<4sIII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    gltf = json.loads(data[20 : 20 + size])
    binary = data[28 + size :]

    def array(index):
        accessor = gltf["accessors"][index]
        view = gltf["bufferViews"][accessor["bufferView"]]
        dtype = {5126: np.float32, 5125: np.uint32, 5121: np.uint8}[accessor["componentType"]]
        columns = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}[accessor["type"]]
        flat = np.frombuffer(binary, dtype, accessor["count"] * columns, view["byteOffset"])
        return flat.reshape(accessor["count"], columns)

    return gltf, array


def play(gltf, array, frame):
    """The file's triangles at one key frame, by the letter of the glTF 2.0 specification."""
    channels = {
        c["target"]["path"]: gltf["animations"][0]["samplers"][c["sampler"]]
        for c in gltf["animations"][0]["channels"]
    }
    rotation = Rotation.from_quat(array(channels["rotation"]["output"])[frame]).as_matrix()
    neck = np.eye(4)
    neck[:3, :3], neck[:3, 3] = rotation, gltf["nodes"][2]["translation"]
    bind = array(gltf["skins"][0]["inverseBindMatrices"]).reshape(2, 4, 4).transpose(0, 2, 1)
    joints = np.stack([np.eye(4) @ bind[0], neck @ bind[1]])
    triangles = []
    for primitive in gltf["meshes"][0]["primitives"]:
        position = array(primitive["attributes"]["POSITION"]).astype(np.float64)
        targets = primitive.get("targets", [])
        if targets:
            weight = array(channels["weights"]["output"]).reshape(-1, len(targets))[frame]
            position = position + sum(w * array(t["POSITION"]) for w, t in zip(weight, targets, strict=True))
        matrices = joints[array(primitive["attributes"]["JOINTS_0"])]
        blend = array(primitive["attributes"]["WEIGHTS_0"])
        matrix = np.einsum("vj,vjab->vab", blend, matrices)
        posed = np.einsum("vab,vb->va", matrix, np.c_[position, np.ones(len(position))])[:, :3]
        triangles.append(posed[array(primitive["indices"]).reshape(-1, 3)])
    return np.concatenate(triangles)


@pytest.mark.parametrize("uv", [False, True])
def test_playing_the_file_gives_the_posed_vertices(tmp_path, uv):
    sequence = sphere_sequence(uv=uv)
    pivot = np.array([0.0, -0.08, 0.01])
    follow = np.clip((sequence.mesh.vertices[:, 1] + 0.1) / 0.1, 0, 1)
    faces = np.arange(sequence.mesh.n_faces)
    materials = [GltfMaterial("upper", faces[::2]), GltfMaterial("lower", faces[1::2], (1.0, 0.0, 0.0, 1.0))]
    path = tmp_path / "talk.glb"
    error = write_glb(path, sequence, materials, pivot, follow, tolerance=1e-5)
    assert error <= 1e-5
    gltf, array = read_glb(path)
    order = np.concatenate([material.faces for material in materials])
    for frame in (0, 7, 19):
        rest = sequence.vertices[frame].astype(np.float64)
        turned = (rest - pivot) @ Rotation.from_rotvec(sequence.pose[frame]).as_matrix().T + pivot
        expected = rest + follow[:, None] * (turned - rest)
        np.testing.assert_allclose(play(gltf, array, frame), expected[sequence.mesh.faces[order]], atol=2e-5)
    times = array(gltf["animations"][0]["samplers"][0]["input"])[:, 0]
    np.testing.assert_allclose(times, np.arange(20) / 25, atol=1e-6)


def test_trimesh_reads_the_file(tmp_path):
    sequence = sphere_sequence(uv=True)
    write_glb(tmp_path / "talk.glb", sequence)
    scene = trimesh.load(tmp_path / "talk.glb")
    assert sum(len(geometry.faces) for geometry in scene.geometry.values()) == sequence.mesh.n_faces


def test_a_still_sequence_has_no_targets(tmp_path):
    mesh = sphere_sequence().mesh
    still = MeshSequence(np.repeat(mesh.vertices[None].astype(np.float32), 4, 0), 30.0, mesh)
    assert write_glb(tmp_path / "still.glb", still) < 1e-6
    gltf, _ = read_glb(tmp_path / "still.glb")
    assert "targets" not in gltf["meshes"][0]["primitives"][0]


def test_what_does_not_fit_is_named(tmp_path):
    sequence = sphere_sequence()
    with pytest.raises(ShapeError, match="pose_weights"):
        write_glb(tmp_path / "a.glb", sequence, pose_weights=np.ones(3))
    with pytest.raises(OptionError, match="texture coordinates"):
        write_glb(tmp_path / "a.glb", sequence, [GltfMaterial("skin", np.arange(3), texture=b"\x89PNG")])
    with pytest.raises(ShapeError, match="at least one frame"):
        write_glb(tmp_path / "a.glb", MeshSequence(sequence.vertices[:0], 30.0, sequence.mesh))
    assert list(tmp_path.iterdir()) == []


@settings(max_examples=20, deadline=None)
@given(rank=st.integers(0, 5), frames=st.integers(1, 12), seed=st.integers(0, 99))
def test_morph_basis_reaches_the_tolerance_with_no_more_targets_than_the_rank(rank, frames, seed):
    rng = np.random.default_rng(seed)
    displacements = (rng.normal(size=(frames, rank)) @ rng.normal(size=(rank, 30)) * 0.01).reshape(
        frames, 10, 3
    )
    targets, weights, error = morph_basis(displacements.astype(np.float32), tolerance=1e-5)
    assert len(targets) <= min(rank, frames)
    assert error <= 1e-5
    rebuilt = np.einsum("tk,kvc->tvc", weights, targets)
    np.testing.assert_allclose(rebuilt, displacements, atol=2e-5)
    assert np.abs(weights).max(initial=0) <= 1 + 1e-5
