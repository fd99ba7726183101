"""Morph targets of a glTF 2.0 file, which trimesh does not read."""

import base64
import binascii
import json
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import roma
import torch
from jaxtyping import Float

from meshanim.errors import FileFormatError
from meshanim.heads.rig_data import Rig

__all__ = ["read_gltf_morphs"]

GLB_MAGIC = 0x46546C67
COMPONENTS: dict[int, Any] = {
    5120: np.int8,
    5121: np.uint8,
    5122: np.int16,
    5123: np.uint16,
    5125: np.uint32,
    5126: np.float32,
}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
TRIANGLES = 4
DAMAGED = (KeyError, IndexError, TypeError, ValueError, struct.error, UnicodeError, binascii.Error)


class _Document:
    """The JSON of a file and its buffers."""

    def __init__(self, path: Path):
        self.path = path
        content = path.read_bytes()
        embedded: bytes | None = None
        if content[:4] == struct.pack("<I", GLB_MAGIC):
            chunks = self._chunks(content)
            text = chunks[0]
            embedded = chunks[1] if len(chunks) > 1 else None
        else:
            text = content
        self.json: dict = json.loads(text.decode("utf-8"))
        if self.json.get("asset", {}).get("version", "")[:1] != "2":
            raise FileFormatError(f"{path} is not glTF 2")
        self.buffers = [self._buffer(buffer, embedded) for buffer in self.json.get("buffers", [])]

    def _chunks(self, content: bytes) -> list[bytes]:
        _, version, length = struct.unpack_from("<III", content)
        if version != 2 or length > len(content):
            raise FileFormatError(f"{self.path} is cut short or not glTF 2")
        chunks, at = [], 12
        while at < length:
            size, _ = struct.unpack_from("<II", content, at)
            if at + 8 + size > length:
                raise FileFormatError(f"{self.path} is cut short")
            chunks.append(content[at + 8 : at + 8 + size])
            at += 8 + size
        return chunks

    def _buffer(self, buffer: dict, embedded: bytes | None) -> bytes:
        uri = buffer.get("uri")
        if uri is None:
            if embedded is None:
                raise FileFormatError(f"{self.path} has a buffer without data")
            data = embedded
        elif uri.startswith("data:"):
            data = base64.b64decode(uri.partition(",")[2], validate=True)
        else:
            path = (self.path.parent / unquote(uri)).resolve()
            if not path.is_relative_to(self.path.parent.resolve()):
                raise FileFormatError(f"{self.path} names a buffer outside its folder: {uri}")
            if not path.is_file():
                raise FileFormatError(f"{self.path} needs {path}, which does not exist")
            data = path.read_bytes()
        if len(data) < buffer["byteLength"]:
            raise FileFormatError(f"{self.path}: a buffer has {len(data)} of {buffer['byteLength']} bytes")
        return data

    def _view(self, index: int, offset: int, dtype: Any, count: int, width: int) -> np.ndarray:
        view = self.json["bufferViews"][index]
        item = np.dtype(dtype).itemsize * width
        stride = view.get("byteStride", item)
        if offset + (count - 1) * stride + item > view["byteLength"]:
            raise FileFormatError(f"{self.path}: an accessor leaves its buffer view")
        start = view.get("byteOffset", 0) + offset
        array = np.ndarray(
            (count, width),
            np.dtype(dtype).newbyteorder("<"),
            self.buffers[view["buffer"]],
            start,
            (stride, np.dtype(dtype).itemsize),
        )
        return np.array(array)

    def accessor(self, index: int) -> np.ndarray:
        """One accessor as (count, width); sparse values filled in, normalised integers as floats."""
        accessor = self.json["accessors"][index]
        dtype, width = COMPONENTS[accessor["componentType"]], WIDTHS[accessor["type"]]
        count = accessor["count"]
        if "bufferView" in accessor:
            offset = accessor.get("byteOffset", 0)
            values = self._view(accessor["bufferView"], offset, dtype, count, width)
        else:
            values = np.zeros((count, width), dtype)
        if sparse := accessor.get("sparse"):
            where, what = sparse["indices"], sparse["values"]
            number = sparse["count"]
            kind = COMPONENTS[where["componentType"]]
            rows = self._view(where["bufferView"], where.get("byteOffset", 0), kind, number, 1)
            values[rows[:, 0]] = self._view(
                what["bufferView"], what.get("byteOffset", 0), dtype, number, width
            )
        if accessor.get("normalized") and np.issubdtype(values.dtype, np.integer):
            return np.maximum(values / np.iinfo(values.dtype).max, -1.0)
        return values

    def node_transform(self, mesh: int) -> Float[np.ndarray, "4 4"]:
        """World matrix of the first node that shows the mesh; the identity if none does."""
        nodes = self.json.get("nodes", [])
        parent = {child: index for index, node in enumerate(nodes) for child in node.get("children", [])}
        index = next((index for index, node in enumerate(nodes) if node.get("mesh") == mesh), None)
        matrix = np.eye(4)
        seen: set[int] = set()
        while index is not None:
            if index in seen:
                raise FileFormatError(f"{self.path}: its nodes form a ring")
            seen.add(index)
            matrix = _local_matrix(nodes[index]) @ matrix
            index = parent.get(index)
        return matrix


def _local_matrix(node: dict) -> Float[np.ndarray, "4 4"]:
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    quaternion = torch.tensor(node.get("rotation", [0.0, 0.0, 0.0, 1.0]), dtype=torch.float64)
    matrix = np.eye(4)
    # glTF and roma both write quaternions as (x, y, z, w).
    matrix[:3, :3] = roma.unitquat_to_rotmat(quaternion / quaternion.norm()).numpy() * node.get(
        "scale", [1.0, 1.0, 1.0]
    )
    matrix[:3, 3] = node.get("translation", [0.0, 0.0, 0.0])
    return matrix


def read_gltf_morphs(path: Path) -> Rig:
    """The meshes with morph targets of a .glb or .gltf as one rig, in world space.

    Meshes and primitives that share morph target names move together; one without a name gets zeros there.
    Meshes without morph targets are left out.

    Raises
    ------
    FileFormatError
        If the file is damaged, not glTF 2, or has no morph targets.
    """
    try:
        return _read(_Document(path))
    except DAMAGED as error:
        raise FileFormatError(f"{path} is no whole glTF file: {error!r}") from error


def _read(document: _Document) -> Rig:
    vertices: list[np.ndarray] = []
    faces: list[np.ndarray] = []
    uv: list[np.ndarray] = []
    pieces: list[tuple[int, dict[str, np.ndarray]]] = []
    count = 0
    for index, mesh in enumerate(document.json.get("meshes", [])):
        matrix = document.node_transform(index)
        for primitive in mesh["primitives"]:
            targets = primitive.get("targets", [])
            if not targets or primitive.get("mode", TRIANGLES) != TRIANGLES:
                continue
            names = mesh.get("extras", {}).get("targetNames") or [
                f"target_{i:02d}" for i in range(len(targets))
            ]
            if len(names) != len(targets):
                raise FileFormatError(f"{document.path}: {len(names)} target names, {len(targets)} targets")
            rest = document.accessor(primitive["attributes"]["POSITION"]).astype(np.float64)
            moved = {
                str(name): document.accessor(target["POSITION"]).astype(np.float64) @ matrix[:3, :3].T
                for name, target in zip(names, targets)
                if "POSITION" in target
            }
            if any(delta.shape != rest.shape for delta in moved.values()):
                raise FileFormatError(
                    f"{document.path}: a morph target has another vertex count than its mesh"
                )
            if "indices" in primitive:
                triangles = document.accessor(primitive["indices"]).astype(np.int64).reshape(-1, 3)
            else:
                triangles = np.arange(len(rest)).reshape(-1, 3)
            coordinates = primitive["attributes"].get("TEXCOORD_0")
            if coordinates is not None:
                uv.append(document.accessor(coordinates) * [1, -1] + [0, 1])
            vertices.append(rest @ matrix[:3, :3].T + matrix[:3, 3])
            faces.append(triangles + count)
            pieces.append((count, moved))
            count += len(rest)
    if not pieces:
        raise FileFormatError(f"{document.path} has no morph targets")
    names = tuple(dict.fromkeys(name for _, moved in pieces for name in moved))
    deltas = np.zeros((len(names), count, 3))
    for start, moved in pieces:
        for name, delta in moved.items():
            deltas[names.index(name), start : start + len(delta)] = delta
    all_faces = np.concatenate(faces)
    solid = (all_faces != np.roll(all_faces, 1, axis=1)).all(1)
    all_faces = all_faces[solid]
    textured = len(uv) == len(pieces)
    return Rig(
        np.concatenate(vertices),
        all_faces,
        names,
        deltas,
        np.concatenate(uv).astype(np.float64) if textured else None,
        all_faces if textured else None,
    )
