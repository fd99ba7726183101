import base64
import json
import struct

import numpy as np
import pytest
import torch
import trimesh

from meshanim.errors import FileFormatError
from meshanim.heads import REGION_NAMES, HeadParameters, load_head
from meshanim.heads.rig import read_rig

NAMES = ("jawOpen", "eyeBlinkLeft", "mouthFunnel")


@pytest.fixture(scope="module")
def sphere():
    mesh = trimesh.creation.icosphere(2, 0.1)
    deltas = np.random.default_rng(0).normal(0, 1e-3, (3, len(mesh.vertices), 3))
    return np.array(mesh.vertices), np.array(mesh.faces), deltas


def gltf(sphere, sparse=False, node=None):
    """A glTF document (JSON, bytes) of the sphere with three morph targets."""
    vertices, faces, deltas = sphere
    blob, views, accessors = b"", [], []

    def view(array):
        nonlocal blob
        data = np.ascontiguousarray(array).tobytes()
        views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": len(data)})
        blob += data + b"\0" * (-len(data) % 4)
        return len(views) - 1

    def accessor(array, kind, component):
        accessors.append(
            {"bufferView": view(array), "componentType": component, "count": len(array), "type": kind}
        )
        return len(accessors) - 1

    position = accessor(vertices.astype(np.float32), "VEC3", 5126)
    indices = accessor(faces.astype(np.uint16).ravel(), "SCALAR", 5123)
    targets = []
    for delta in deltas.astype(np.float32):
        if sparse:
            rows = np.flatnonzero(np.abs(delta).sum(1) > 0)
            accessors.append(
                {
                    "componentType": 5126,
                    "count": len(delta),
                    "type": "VEC3",
                    "sparse": {
                        "count": len(rows),
                        "indices": {"bufferView": view(rows.astype(np.uint16)), "componentType": 5123},
                        "values": {"bufferView": view(delta[rows])},
                    },
                }
            )
            targets.append({"POSITION": len(accessors) - 1})
        else:
            targets.append({"POSITION": accessor(delta, "VEC3", 5126)})
    document = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": len(blob)}],
        "bufferViews": views,
        "accessors": accessors,
        "meshes": [
            {
                "primitives": [
                    {"attributes": {"POSITION": position}, "indices": indices, "targets": targets}
                ],
                "extras": {"targetNames": list(NAMES)},
            }
        ],
        "nodes": [{"children": [1], "translation": [0.0, 1.0, 0.0]}, {"mesh": 0, **(node or {})}],
    }
    return document, blob


def glb(document, blob):
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = (
        struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(blob), 0x004E4942) + blob
    )
    return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks


@pytest.mark.parametrize("sparse", [False, True])
def test_glb_round_trip(tmp_path, sphere, sparse):
    vertices, faces, deltas = sphere
    if sparse:
        deltas = deltas.copy()
        deltas[:, ::3] = 0
    (tmp_path / "a.glb").write_bytes(glb(*gltf((vertices, faces, deltas), sparse)))
    head = load_head(f"rig:{tmp_path / 'a.glb'}")
    assert head.expression_names == NAMES
    np.testing.assert_array_equal(head.mesh.faces, faces)
    np.testing.assert_allclose(head.mesh.vertices, np.add(vertices, [0, 1, 0]), atol=1e-7)
    weights = {"jawOpen": 0.5, "mouthFunnel": -1.0}
    out = head(HeadParameters(expression=head.expression(weights)))[0]
    expected = head.mesh.vertices + 0.5 * deltas[0] - deltas[2]
    np.testing.assert_allclose(out, expected, atol=1e-6)


def test_node_transforms_turn_deltas_as_well(tmp_path, sphere):
    vertices, _, deltas = sphere
    half = np.sqrt(0.5)
    node = {"rotation": [0.0, half, 0.0, half], "scale": [2.0, 2.0, 2.0], "translation": [1.0, 0.0, 0.0]}
    (tmp_path / "a.glb").write_bytes(glb(*gltf(sphere, node=node)))
    rig = read_rig(tmp_path / "a.glb")
    quarter = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    np.testing.assert_allclose(rig.neutral, 2 * vertices @ quarter.T + [1, 1, 0], atol=1e-6)
    np.testing.assert_allclose(rig.deltas, 2 * deltas @ quarter.T, atol=1e-8)


def test_gltf_with_data_and_file_buffers(tmp_path, sphere):
    document, blob = gltf(sphere)
    document["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(blob).decode()
    (tmp_path / "a.gltf").write_text(json.dumps(document))
    document["buffers"][0]["uri"] = "my%20buffer.bin"
    (tmp_path / "b.gltf").write_text(json.dumps(document))
    (tmp_path / "my buffer.bin").write_bytes(blob)
    a, b = read_rig(tmp_path / "a.gltf"), read_rig(tmp_path / "b.gltf")
    np.testing.assert_array_equal(a.deltas, b.deltas)
    document["buffers"][0]["uri"] = "../secret.bin"
    (tmp_path / "c.gltf").write_text(json.dumps(document))
    with pytest.raises(FileFormatError, match="outside"):
        read_rig(tmp_path / "c.gltf")


def test_folder_of_obj_files(tmp_path, sphere):
    vertices, faces, deltas = sphere
    trimesh.Trimesh(vertices, faces, process=False).export(tmp_path / "neutral.obj", digits=9)
    for name, delta in zip(NAMES, deltas):
        trimesh.Trimesh(vertices + delta, faces, process=False).export(tmp_path / f"{name}.obj", digits=9)
    head = load_head(f"rig:{tmp_path}")
    assert head.expression_names == tuple(sorted(NAMES))
    row = head.expression_names.index("mouthFunnel")
    np.testing.assert_allclose(head.expression_directions[row].view(-1, 3), deltas[2], atol=1e-8)
    (tmp_path / "other.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(FileFormatError, match="other"):
        load_head(f"rig:{tmp_path}")


def test_npz_with_regions_and_pose(tmp_path, sphere):
    vertices, faces, deltas = sphere
    content = {"neutral": vertices, "faces": faces, "names": np.array(NAMES), "deltas": deltas}
    np.savez(tmp_path / "a.npz", **content, region_lips=np.arange(5))
    head = load_head(f"rig:{tmp_path / 'a.npz'}")
    assert set(REGION_NAMES) <= set(head.regions)
    np.testing.assert_array_equal(head.regions["lips"], np.arange(5))
    assert 0 < len(head.regions["eyelids"]) < len(vertices)
    assert len(head.regions["teeth"]) == 0
    turn = torch.tensor([[0.0, 0.4, 0.0]])
    torch.testing.assert_close(head.pose(head.template(), turn), head(HeadParameters(neck=turn)))
    distances = torch.pdist(head(HeadParameters(neck=turn))[0]) - torch.pdist(head()[0])
    assert distances.abs().max() < 1e-6


def test_bad_files_are_named(tmp_path, sphere):
    vertices, faces, deltas = sphere
    whole = glb(*gltf(sphere))
    path = tmp_path / "cut.glb"
    for size in (0, 4, 11, 30, len(whole) // 2, len(whole) - 8):
        path.write_bytes(whole[:size])
        with pytest.raises(FileFormatError, match="cut"):
            read_rig(path)
    document, blob = gltf(sphere)
    document["accessors"][0]["count"] = 10**6
    path.write_bytes(glb(document, blob))
    with pytest.raises(FileFormatError, match="leaves"):
        read_rig(path)
    document, blob = gltf(sphere)
    del document["meshes"][0]["primitives"][0]["targets"]
    path.write_bytes(glb(document, blob))
    with pytest.raises(FileFormatError, match="no morph targets"):
        read_rig(path)
    with pytest.raises(FileFormatError, match=r"neutral\.obj"):
        read_rig(tmp_path)
    with pytest.raises(FileFormatError, match="does not exist"):
        read_rig(tmp_path / "none.glb")
    (tmp_path / "a.txt").write_text("")
    with pytest.raises(FileFormatError, match=r"\.glb"):
        read_rig(tmp_path / "a.txt")
    for change, message in (
        ({"deltas": deltas[:, :-1]}, "deltas"),
        ({"deltas": deltas * np.nan}, "NaN"),
        ({"names": np.array(["a", "a", "b"])}, "twice"),
        ({"region_lips": np.array([10**6])}, "lips"),
    ):
        content = {"neutral": vertices, "faces": faces, "names": np.array(NAMES), "deltas": deltas}
        np.savez(tmp_path / "a.npz", **{**content, **change})
        with pytest.raises(FileFormatError, match=message):
            read_rig(tmp_path / "a.npz")
