"""FLAME (Li et al. 2017) from its own files: 2019, 2020 and 2023, .pkl or .npz."""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import roma
import torch
from jaxtyping import Float, Int
from torch import Tensor

from meshanim.errors import FileFormatError, OptionError
from meshanim.geometry import TriangleMesh
from meshanim.heads.flame_regions import flame_regions, regions_from_default
from meshanim.heads.flame_teeth import FlameArrays, add_teeth, offset_on_teeth, split_teeth
from meshanim.heads.head import JOINT_PARENTS, Head, HeadParameters
from meshanim.unpickle import load_npy_objects, load_pickle

__all__ = ["FlameHead", "load_flame"]

N_VERTICES, N_FACES = 5023, 9976
SHARED_OFFSETS = (5023, 5083, 5143)
"""Rows of VHAP's static offsets, in all its versions."""
N_SHAPE, N_EXPRESSION = 300, 100
TEETH = ("none", "plain", "split")
YAW_LIMIT = 39
TEMPLATES = ("head_template_mesh.obj", "head_template.obj")


class FlameHead(Head):
    """FLAME with its masks and landmarks; made by `load_flame`.

    Attributes
    ----------
    masks : dict of str to index array
        Those of FLAME_masks.pkl, by their own names; empty without the file.
    """

    def __init__(
        self,
        arrays: FlameArrays,
        regions: Mapping[str, np.ndarray],
        masks: Mapping[str, np.ndarray],
        embedding: Mapping[str, np.ndarray],
        texture: tuple[np.ndarray, np.ndarray] | None = None,
    ):
        shape, expression = np.split(arrays.shape_directions, [N_SHAPE], axis=2)
        regressed = np.tensordot(arrays.joint_regressor, arrays.shape_directions, axes=1)
        super().__init__(
            TriangleMesh(arrays.vertices, arrays.faces, *(texture or ())),
            shape,
            expression,
            [f"shape_{index:03d}" for index in range(N_SHAPE)],
            [f"expression_{index:03d}" for index in range(N_EXPRESSION)],
            arrays.joint_regressor @ arrays.vertices,
            regressed[..., :N_SHAPE],
            arrays.weights,
            regions,
            arrays.pose_directions,
            regressed[..., N_SHAPE:],
        )
        self.joint_regressor: Tensor
        self._buffer("joint_regressor", arrays.joint_regressor, (5, len(arrays.vertices)))
        self.masks = dict(masks)
        self._embedding = {name: np.asarray(value) for name, value in embedding.items()}

    def with_offset(self, offset: Float[Tensor, "shared 3"]) -> "FlameHead":
        """The same head with a personal template; its joints are regressed from that, as VHAP does.

        Offsets that are shared for another set of teeth (5,023, 5,083 or 5,143 rows) fit as well: see
        `offset_on_teeth`.
        """
        if len(offset) != self.n_vertices and len(offset) in SHARED_OFFSETS:
            carried = offset_on_teeth(offset.detach().cpu().numpy(), self.mesh, N_VERTICES, N_FACES)
            offset = torch.from_numpy(carried)
        head = super().with_offset(offset)
        assert isinstance(head, FlameHead)
        head.rest_joints = self.rest_joints + self.joint_regressor @ offset.to(self.joint_regressor)
        return head

    def landmarks(
        self,
        vertices: Float[Tensor, "batch vertices 3"],
        kind: str = "full",
        params: HeadParameters | None = None,
    ) -> Float[Tensor, "batch landmarks 3"]:
        """Landmarks on posed vertices, by the embedding that came with the model.

        Parameters
        ----------
        vertices : (B, V, 3)
            What `forward` gave, metres.
        kind : str
            "static": 51 points of brows, nose, eyes and mouth. "full": 68 points of a fixed contour.
            "dynamic": 17 points of the contour seen at the head's yaw, then the static ones; needs `params`.
        params : HeadParameters, optional
            The pose that made `vertices`.

        Raises
        ------
        OptionError
            If there is no such kind, the embedding lacks it, or "dynamic" is asked for without `params`.
        """
        keys = {"static": "static_lmk", "full": "full_lmk", "dynamic": "dynamic_lmk"}
        if kind not in keys:
            raise OptionError(f"landmarks are static, full or dynamic, not {kind}")
        needed = [keys[kind]] if kind != "dynamic" else ["dynamic_lmk", "static_lmk"]
        if any(f"{name}_faces_idx" not in self._embedding for name in needed):
            raise OptionError(
                f"no {kind} landmarks: put landmark_embedding.npy beside the model; it must hold "
                f"{' and '.join(needed)}"
            )
        if kind == "dynamic" and params is None:
            raise OptionError("dynamic landmarks need the pose: give params")
        batch = len(vertices)
        faces, weights = [], []
        for name in needed:
            face = torch.from_numpy(self._embedding[f"{name}_faces_idx"].astype(np.int64))
            weight = torch.from_numpy(self._embedding[f"{name}_bary_coords"]).to(vertices)
            face = face.to(vertices.device)
            if name == "dynamic_lmk":
                assert params is not None
                bins = self._yaw_bin(params, batch)
                faces.append(face[bins])
                weights.append(weight[bins])
            else:
                faces.append(face.reshape(1, -1).expand(batch, -1))
                weights.append(weight.reshape(1, -1, 3).expand(batch, -1, -1))
        corners = torch.from_numpy(self.mesh.faces).to(vertices.device)[torch.cat(faces, 1)]
        picked = vertices[torch.arange(batch, device=vertices.device)[:, None, None], corners]
        return (picked * torch.cat(weights, 1)[..., None]).sum(2)

    def _yaw_bin(self, params: HeadParameters, batch: int) -> Int[Tensor, " batch"]:
        """Row of the dynamic embedding: 0 to 39 degrees of yaw to one side, then 1 to 39 to the other."""
        zero = self.template_vertices.new_zeros(batch, 3)
        turns = [zero if turn is None else turn.expand(batch, 3) for turn in (params.rotation, params.neck)]
        root, neck = (roma.rotvec_to_rotmat(turn) for turn in turns)
        matrix = root @ neck
        side = torch.hypot(matrix[:, 0, 0], matrix[:, 1, 0])
        yaw = -torch.rad2deg(torch.atan2(-matrix[:, 2, 0], side))
        degrees = yaw.clamp(-YAW_LIMIT, YAW_LIMIT).round().long()
        return torch.where(degrees < 0, YAW_LIMIT - degrees, degrees)


def load_flame(path: str | Path, teeth: str = "none") -> FlameHead:
    """Read a FLAME model file, and what lies beside it of masks, landmarks and texture coordinates.

    FLAME_masks.pkl, landmark_embedding.npy, and head_template_mesh.obj or head_template.obj: the texture
    coordinates become `mesh.uv`; triangles of the teeth have none and share the point (0, 0).

    Parameters
    ----------
    path : str or Path
        generic_model.pkl, flame2023.pkl or an .npz with the same names.
    teeth : str
        "none": 5,023 vertices, 9,976 faces. "plain": with the teeth of VHAP and GaussianAvatars, 5,143 and
        10,144. "split": the triangles of the teeth in four (GaussianSpeech, Sec. 4.1), 5,431 and 10,648.

    Raises
    ------
    FileFormatError
        If the file is missing, damaged, names anything but arrays, or is not FLAME.
    OptionError
        If `teeth` is none of the three.
    """
    path = Path(path)
    if teeth not in TEETH:
        raise OptionError(f"teeth must be one of {', '.join(TEETH)}, not {teeth}")
    arrays = _read_arrays(path)
    masks_path, embedding_path = path.parent / "FLAME_masks.pkl", path.parent / "landmark_embedding.npy"
    masks = _read_masks(masks_path) if masks_path.is_file() else {}
    embedding = load_npy_objects(embedding_path) if embedding_path.is_file() else {}
    if not isinstance(embedding, dict):
        raise FileFormatError(f"{embedding_path} holds {type(embedding).__name__}, expected a dictionary")
    if masks:
        regions = flame_regions(arrays, masks)
    else:
        warnings.warn(
            f"{masks_path} does not exist: the regions are those of the default head, carried over by "
            "nearest points",
            stacklevel=2,
        )
        regions = regions_from_default(arrays)
    texture = _read_texture(path.parent, arrays.faces)
    if teeth != "none":
        arrays = add_teeth(arrays)
        if teeth == "split":
            arrays = split_teeth(arrays)
        regions = {**regions, "teeth": np.arange(N_VERTICES, len(arrays.vertices))}
        if texture is not None:
            texture = _without_teeth(*texture, len(arrays.faces))
    return FlameHead(arrays, regions, masks, embedding, texture)


def _read_texture(
    folder: Path, faces: Int[np.ndarray, "faces 3"]
) -> tuple[Float[np.ndarray, "uv 2"], Int[np.ndarray, "faces 3"]] | None:
    """Texture coordinates, each once, and their indices a face; from the template's OBJ file, if any.

    The file's faces must be the model's, in its order: each of the model's vertices must be one point of the
    file and no two the same. Where that point lies does not matter: templates differ between releases.
    """
    path = next((folder / name for name in TEMPLATES if (folder / name).is_file()), None)
    if path is None:
        return None
    import trimesh  # slow to load, and few need it

    try:
        loaded = trimesh.load(path, process=False, force="mesh")
    except (ValueError, IndexError, KeyError, AttributeError, TypeError) as error:
        raise FileFormatError(f"{path} is no OBJ mesh: {error}") from error
    uv = getattr(getattr(loaded, "visual", None), "uv", None)
    if not isinstance(loaded, trimesh.Trimesh) or uv is None:
        raise FileFormatError(f"{path} holds no texture coordinates; remove the file to do without")
    if len(loaded.faces) != N_FACES:
        raise FileFormatError(f"{path} has {len(loaded.faces)} triangles, FLAME has {N_FACES}")
    point = np.unique(loaded.vertices, axis=0, return_inverse=True)[1]
    corner = point.reshape(-1)[loaded.faces].ravel()
    owner = np.full(N_VERTICES, -1)
    owner[faces.ravel()] = corner
    used = owner[owner >= 0]
    if not np.array_equal(owner[faces.ravel()], corner) or len(np.unique(used)) != len(used):
        raise FileFormatError(f"{path}: its triangles are not those of the model in the same order")
    rows, index = np.unique(
        np.asarray(uv, np.float64)[loaded.faces].reshape(-1, 2), axis=0, return_inverse=True
    )
    return rows, index.reshape(-1, 3)


def _without_teeth(uv: np.ndarray, uv_faces: np.ndarray, n_faces: int) -> tuple[np.ndarray, np.ndarray]:
    """Texture coordinates of the head; those of the teeth, the faces behind it, are one point."""
    teeth = np.full((n_faces - len(uv_faces), 3), len(uv))
    return np.concatenate([uv, np.zeros((1, 2))]), np.concatenate([uv_faces, teeth])


def _read_masks(path: Path) -> dict[str, np.ndarray]:
    content = load_pickle(path)
    if not isinstance(content, dict):
        raise FileFormatError(f"{path} holds {type(content).__name__}, expected a dictionary of index arrays")
    masks = {str(name): np.asarray(indices, np.int64).ravel() for name, indices in content.items()}
    for name, indices in masks.items():
        if indices.size and not 0 <= indices.min() <= indices.max() < N_VERTICES:
            raise FileFormatError(f"{path}: mask {name} names vertices outside 0..{N_VERTICES - 1}")
    return masks


def _read_arrays(path: Path) -> FlameArrays:
    content: Mapping[str, Any]
    if path.suffix == ".npz":
        if not path.is_file():
            raise FileFormatError(f"{path} does not exist")
        try:
            with np.load(path, allow_pickle=False) as archive:
                content = {name: archive[name] for name in archive.files}
        except (ValueError, OSError, EOFError, KeyError) as error:
            raise FileFormatError(f"{path} is no .npz of plain arrays: {error}") from error
    else:
        content = load_pickle(path)
    if not isinstance(content, dict):
        raise FileFormatError(f"{path} holds {type(content).__name__}, expected FLAME's dictionary")

    def take(name: str, shape: tuple[int, ...]) -> np.ndarray:
        if name not in content:
            raise FileFormatError(f"{path} lacks {name}; FLAME's file has it")
        value = content[name]
        value = value.toarray() if hasattr(value, "toarray") else np.asarray(value)
        if value.shape != shape or value.dtype == object:
            kind = "objects" if value.dtype == object else f"shape {value.shape}"
            raise FileFormatError(f"{path}: {name} has {kind}, FLAME's has shape {shape}")
        return value

    vertices = take("v_template", (N_VERTICES, 3)).astype(np.float64)
    faces = take("f", (N_FACES, 3)).astype(np.int64)
    shapes = take("shapedirs", (N_VERTICES, 3, N_SHAPE + N_EXPRESSION)).astype(np.float32)
    poses = take("posedirs", (N_VERTICES, 3, 36)).astype(np.float32)
    regressor = take("J_regressor", (5, N_VERTICES)).astype(np.float64)
    weights = take("weights", (N_VERTICES, 5)).astype(np.float64)
    parents = take("kintree_table", (2, 5))[0].astype(np.int64)
    # The root's parent is -1 stored as an unsigned integer.
    if parents[1:].tolist() != list(JOINT_PARENTS[1:]):
        raise FileFormatError(
            f"{path}: joints have parents {parents.tolist()}, FLAME's {list(JOINT_PARENTS)}"
        )
    if faces.max() >= N_VERTICES or faces.min() < 0:
        raise FileFormatError(f"{path}: f names vertex {faces.max()}, there are {N_VERTICES}")
    if not all(np.isfinite(array).all() for array in (vertices, shapes, poses, regressor, weights)):
        raise FileFormatError(f"{path} holds numbers that are NaN or infinite")
    return FlameArrays(vertices, faces, shapes, poses, regressor, weights)
