"""Animated meshes as binary glTF 2.0 (.glb): morph targets for the face, one skinned joint for the head pose.

The displacements of all frames are factorised into a few morph targets with time-varying weights, which every
viewer plays and which is a small fraction of the size of a target a frame.
"""

import json
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from meshanim.errors import OptionError, ShapeError
from meshanim.export.blendshape_motion import BlendshapeMotion, smooth_quaternions
from meshanim.files import written_whole
from meshanim.geometry import TriangleMesh
from meshanim.heads import Rig
from meshanim.motion import MeshSequence

__all__ = ["GltfMaterial", "morph_basis", "write_blendshape_glb", "write_glb", "write_morph_targets"]

FLOAT, UNSIGNED_INT, UNSIGNED_BYTE = 5126, 5125, 5121
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963


@dataclass(frozen=True)
class GltfMaterial:
    """One primitive of the file: some faces and how they look.

    Parameters
    ----------
    name : str
    faces : (n,) int
        Indices into the mesh's faces.
    color : 4 floats
        Base colour factor, linear RGBA.
    texture : bytes, optional
        A PNG or JPEG file; needs texture coordinates on the mesh, or `uv`.
    roughness : float
        0 (mirror) to 1.
    uv : (V, 2) float, optional
        Texture coordinates a vertex for this material, instead of the mesh's.
    """

    name: str
    faces: Int[np.ndarray, " faces"]
    color: tuple[float, float, float, float] = (0.8, 0.8, 0.8, 1.0)
    texture: bytes | None = None
    roughness: float = 0.6
    uv: Float[np.ndarray, "vertices 2"] | None = None


def morph_basis(
    displacements: Float[np.ndarray, "frames vertices 3"], tolerance: float = 1e-4, most: int = 96
) -> tuple[Float[np.ndarray, "targets vertices 3"], Float[np.ndarray, "frames targets"], float]:
    """Factorise displacements into morph targets and weights by a truncated singular value decomposition.

    Parameters
    ----------
    displacements : (T, V, 3) float32
        Vertices minus template, metres.
    tolerance : float
        The largest distance of any vertex in any frame from the truth that is aimed at, metres.
    most : int
        Targets at most; the tolerance yields to it.

    Returns
    -------
    targets : (K, V, 3) float32
        Displacement at weight 1; each target's largest weight over the frames is 1.
    weights : (T, K) float32
    error : float
        The largest distance that is left, metres.
    """
    frames, vertices = displacements.shape[:2]
    flat = displacements.reshape(frames, -1)
    stride = max(1, frames // 1500)  # the subspace of a long sequence is found on a regular subset
    _, values, basis = np.linalg.svd(flat[::stride], full_matrices=False)
    most = min(most, int((values > values[0] * 1e-7).sum()) if values[0] > 0 else 0)
    weights = flat @ basis[:most].T
    low, high = 0, most
    while low < high:  # the error falls with the number of targets: bisect
        middle = (low + high) // 2
        if _largest_error(flat, weights[:, :middle], basis[:middle]) <= tolerance:
            high = middle
        else:
            low = middle + 1
    weights, basis = weights[:, :low], basis[:low]
    error = _largest_error(flat, weights, basis)
    peak = np.abs(weights).max(0, initial=0.0)
    targets = (basis * peak[:, None]).reshape(low, vertices, 3)
    return targets.astype(np.float32), (weights / np.maximum(peak, 1e-30)).astype(np.float32), error


def _largest_error(flat: np.ndarray, weights: np.ndarray, basis: np.ndarray) -> float:
    largest = 0.0
    for start in range(0, len(flat), 256):
        rest = flat[start : start + 256] - weights[start : start + 256] @ basis
        largest = max(largest, float(np.square(rest.reshape(-1, 3)).sum(1).max()))
    return largest**0.5


def write_glb(
    path: str | Path,
    sequence: MeshSequence,
    materials: list[GltfMaterial] | None = None,
    pivot: Float[np.ndarray, " 3"] | None = None,
    pose_weights: Float[np.ndarray, " vertices"] | None = None,
    tolerance: float = 1e-4,
) -> float:
    """Write an animated mesh that plays in any glTF 2.0 viewer (no sound: the format has none).

    Parameters
    ----------
    path : str or Path
        The .glb file, written whole.
    sequence : MeshSequence
        Template, displacements and head pose.
    materials : list of GltfMaterial, optional
        One primitive each; a plain grey one over all faces if not given.
    pivot : (3,) float, optional
        The point that the head pose turns about, metres; the origin if not given.
    pose_weights : (V,) float in [0, 1], optional
        How much of the head pose each vertex follows; 1 everywhere if not given.
    tolerance : float
        Largest distance from the true vertices that is aimed at, metres.

    Returns
    -------
    float
        The largest distance of a stored vertex from the true one, metres (before the pose).

    Raises
    ------
    ShapeError
        If the sequence has no frames or `pose_weights` does not fit the mesh.
    """
    _check_motion(len(sequence), sequence.mesh, pose_weights)
    template = sequence.mesh.vertices.astype(np.float32)
    targets, weights, error = morph_basis(sequence.vertices - template, tolerance)
    names = [f"component_{index:02d}" for index in range(len(targets))]
    _write_animation(
        path,
        sequence.mesh,
        targets,
        weights,
        names,
        sequence.fps,
        sequence.pose,
        materials,
        pivot,
        pose_weights,
    )
    return error


def write_blendshape_glb(
    path: str | Path, motion: BlendshapeMotion, materials: list[GltfMaterial] | None = None
) -> None:
    """Write a mesh that its named blendshapes move; the names are in mesh.extras.targetNames.

    Parameters
    ----------
    path : str or Path
        The .glb file, written whole.
    motion : BlendshapeMotion
        Shapes that stay at zero are written as well: a user may want to animate on.
    materials : list of GltfMaterial, optional
        As of `write_glb`.

    Raises
    ------
    ShapeError
        If the motion has no frames.
    """
    _check_motion(len(motion.weights), motion.mesh, motion.follow)
    _write_animation(
        path,
        motion.mesh,
        motion.deltas,
        motion.weights,
        list(motion.names),
        motion.fps,
        motion.pose,
        materials,
        motion.pivot,
        motion.follow,
    )


def _check_motion(frames: int, mesh: TriangleMesh, pose_weights: np.ndarray | None) -> None:
    if frames == 0:
        raise ShapeError("a glTF animation needs at least one frame")
    if pose_weights is not None and pose_weights.shape != (mesh.n_vertices,):
        raise ShapeError(f"pose_weights has shape {pose_weights.shape}, the mesh {mesh.n_vertices} vertices")


def _write_animation(
    path: str | Path,
    mesh: TriangleMesh,
    targets: Float[np.ndarray, "targets vertices 3"],
    weights: Float[np.ndarray, "frames targets"],
    names: list[str],
    fps: float,
    pose: Float[np.ndarray, "frames 3"],
    materials: list[GltfMaterial] | None,
    pivot: Float[np.ndarray, " 3"] | None,
    pose_weights: Float[np.ndarray, " vertices"] | None,
) -> None:
    buffer = _Buffer()
    pivot = np.zeros(3) if pivot is None else np.asarray(pivot, np.float64)
    weight = np.ones(mesh.n_vertices) if pose_weights is None else np.asarray(pose_weights)
    materials = materials or [GltfMaterial("surface", np.arange(mesh.n_faces))]
    weights = np.asarray(weights, np.float32)
    normals = _normals(mesh)
    changes = [_normals(mesh.with_vertices(mesh.vertices + target)) - normals for target in targets]
    primitives = [
        _primitive(buffer, mesh, targets, normals, changes, weight, one, index)
        for index, one in enumerate(materials)
    ]
    bind = np.tile(np.eye(4, dtype=np.float32), (2, 1, 1))
    bind[1, 3, :3] = -pivot  # column-major: the translation is the last row
    nodes: list[dict] = [
        {"name": "head", "mesh": 0, "skin": 0},
        {"name": "root", "children": [2]},
        {"name": "neck", "translation": pivot.tolist()},
    ]
    rotation = smooth_quaternions(pose)
    times = (np.arange(len(weights)) / fps).astype(np.float32)
    time = buffer.accessor(times, "SCALAR", bounds=True)
    samplers = [{"input": time, "output": buffer.accessor(rotation, "VEC4"), "interpolation": "LINEAR"}]
    channels = [{"sampler": 0, "target": {"node": 2, "path": "rotation"}}]
    face: dict = {"name": "head", "primitives": primitives}
    if len(targets):
        flat = buffer.accessor(weights.reshape(-1), "SCALAR")
        samplers.append({"input": time, "output": flat, "interpolation": "LINEAR"})
        channels.append({"sampler": 1, "target": {"node": 0, "path": "weights"}})
        face |= {"weights": weights[0].tolist(), "extras": {"targetNames": names}}
    gltf = {
        "asset": {"version": "2.0", "generator": "meshanim"},
        "scene": 0,
        "scenes": [{"nodes": [0, 1]}],
        "nodes": nodes,
        "meshes": [face],
        "skins": [
            {
                "joints": [1, 2],
                "skeleton": 1,
                "inverseBindMatrices": buffer.accessor(bind.reshape(2, 16), "MAT4"),
            }
        ],
        "materials": [_material(buffer, one) for one in materials],
        "animations": [{"name": "speech", "samplers": samplers, "channels": channels}],
        **buffer.sections(),
    }
    with written_whole(path) as temporary:
        temporary.write_bytes(_glb(gltf, bytes(buffer.data)))


def write_morph_targets(path: str | Path, rig: Rig) -> None:
    """Write a rig as a still mesh with named morph targets, their names in mesh.extras.targetNames.

    Parameters
    ----------
    path : str or Path
        The .glb file, written whole.
    rig : Rig
        One vertex a vertex of the rig, or one a corner of its texture where it has one.
    """
    mesh = TriangleMesh(rig.neutral, rig.faces, rig.uv, rig.uv_faces)
    buffer = _Buffer()
    normals = _normals(mesh)
    targets = rig.deltas.astype(np.float32)
    changes = [_normals(mesh.with_vertices(mesh.vertices + delta)) - normals for delta in rig.deltas]
    material = GltfMaterial("surface", np.arange(mesh.n_faces))
    primitive = _primitive(buffer, mesh, targets, normals, changes, None, material, 0)
    gltf = {
        "asset": {"version": "2.0", "generator": "meshanim"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "head", "mesh": 0}],
        "meshes": [{"name": "head", "primitives": [primitive], "extras": {"targetNames": list(rig.names)}}],
        "materials": [_material(buffer, material)],
        **buffer.sections(),
    }
    with written_whole(path) as temporary:
        temporary.write_bytes(_glb(gltf, bytes(buffer.data)))


def _primitive(
    buffer, mesh: TriangleMesh, targets, normals, changes, weight, material: GltfMaterial, index: int
) -> dict:
    faces = mesh.faces[material.faces]
    if material.uv is not None:
        uv_faces, uv = faces, material.uv
    elif mesh.uv is not None and mesh.uv_faces is not None:
        uv_faces, uv = mesh.uv_faces[material.faces], mesh.uv
    else:
        if material.texture is not None:
            raise OptionError(
                f"material '{material.name}' has a texture, but the mesh no texture coordinates"
            )
        uv_faces, uv = faces, None
    # glTF has one index for all attributes: split vertices along texture seams.
    corners, inverse = np.unique(np.stack([faces, uv_faces], -1).reshape(-1, 2), axis=0, return_inverse=True)
    vertex = corners[:, 0]
    attributes = {
        "POSITION": buffer.accessor(
            mesh.vertices[vertex].astype(np.float32), "VEC3", ARRAY_BUFFER, bounds=True
        )
    }
    attributes["NORMAL"] = buffer.accessor(normals[vertex], "VEC3", ARRAY_BUFFER)
    if uv is not None:
        flipped = np.stack([uv[corners[:, 1], 0], 1 - uv[corners[:, 1], 1]], 1).astype(np.float32)
        attributes["TEXCOORD_0"] = buffer.accessor(flipped, "VEC2", ARRAY_BUFFER)
    if weight is not None:
        joints = np.zeros((len(vertex), 4), np.uint8)
        joints[:, 1] = weight[vertex] > 0  # a joint without weight must be named 0
        blend = np.zeros((len(vertex), 4), np.float32)
        blend[:, 0], blend[:, 1] = 1 - weight[vertex], weight[vertex]
        attributes["JOINTS_0"] = buffer.accessor(joints, "VEC4", ARRAY_BUFFER)
        attributes["WEIGHTS_0"] = buffer.accessor(blend, "VEC4", ARRAY_BUFFER)
    moved = [
        {
            "POSITION": buffer.accessor(target[vertex], "VEC3", ARRAY_BUFFER, bounds=True),
            "NORMAL": buffer.accessor(change[vertex], "VEC3", ARRAY_BUFFER),
        }
        for target, change in zip(targets, changes)
    ]
    return {
        "attributes": attributes,
        "indices": buffer.accessor(inverse.reshape(-1).astype(np.uint32), "SCALAR", ELEMENT_ARRAY_BUFFER),
        "material": index,
        **({"targets": moved} if moved else {}),
    }


def _normals(mesh: TriangleMesh) -> np.ndarray:
    """Vertex normals of unit length everywhere, as the format asks: +z where a mesh has none."""
    normals = mesh.vertex_normals
    return np.where(normals.any(1, keepdims=True), normals, [0.0, 0.0, 1.0]).astype(np.float32)


def _material(buffer, material: GltfMaterial) -> dict:
    surface: dict = {
        "baseColorFactor": list(material.color),
        "metallicFactor": 0.0,
        "roughnessFactor": material.roughness,
    }
    if material.texture is not None:
        surface["baseColorTexture"] = {"index": buffer.texture(material.texture)}
    return {"name": material.name, "pbrMetallicRoughness": surface, "doubleSided": True}


class _Buffer:
    """The binary chunk, with the accessors, views, images and textures that point into it."""

    def __init__(self):
        self.data = bytearray()
        self.views: list[dict] = []
        self.accessors: list[dict] = []
        self.images: list[dict] = []

    def view(self, data: bytes, target: int | None = None) -> int:
        self.data.extend(b"\0" * (-len(self.data) % 4))
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data)})
        if target is not None:
            self.views[-1]["target"] = target
        self.data.extend(data)
        return len(self.views) - 1

    def accessor(self, array: np.ndarray, kind: str, target: int | None = None, bounds: bool = False) -> int:
        array = np.ascontiguousarray(array)
        component = {"f": FLOAT, "I": UNSIGNED_INT, "B": UNSIGNED_BYTE}[array.dtype.char]
        entry = {
            "bufferView": self.view(array.tobytes(), target),
            "componentType": component,
            "count": len(array),
            "type": kind,
        }
        if bounds:
            rows = array.reshape(len(array), -1)
            entry |= {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
        self.accessors.append(entry)
        return len(self.accessors) - 1

    def texture(self, file: bytes) -> int:
        kind = "image/png" if file[:4] == b"\x89PNG" else "image/jpeg"
        self.images.append({"bufferView": self.view(file), "mimeType": kind})
        return len(self.images) - 1

    def sections(self) -> dict:
        sections: dict = {
            "buffers": [{"byteLength": len(self.data)}],
            "bufferViews": self.views,
            "accessors": self.accessors,
        }
        if self.images:
            sections["images"] = self.images
            sections["textures"] = [{"source": index} for index in range(len(self.images))]
        return sections


def _glb(gltf: dict, binary: bytes) -> bytes:
    text = json.dumps(gltf, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    length = 12 + 8 + len(text) + 8 + len(binary)
    return b"".join(
        [
            struct.pack("<4sII", b"glTF", 2, length),
            struct.pack("<I4s", len(text), b"JSON"),
            text,
            struct.pack("<I4s", len(binary), b"BIN\0"),
            binary,
        ]
    )
