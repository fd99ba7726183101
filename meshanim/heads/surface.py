"""`HeadSurface`: a triangle mesh that a head carries, such as the one a renderer draws."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import roma
import scipy.sparse as sp
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from meshanim.errors import FileFormatError, MeshanimError, ShapeError
from meshanim.files import read_npz, written_whole
from meshanim.geometry import TriangleMesh

__all__ = ["HeadSurface", "RigidPart"]


@dataclass(frozen=True)
class RigidPart:
    """A piece that keeps its shape and follows a few vertices of the head: an eyeball, a jaw of teeth.

    Parameters
    ----------
    anchors : (m,) int
        The head's vertices that carry it, three or more.
    rest : (m, 3) float
        Where they are on the resting head, metres.
    vertices : (n, 3) float
        The piece on the resting head, metres.
    """

    anchors: Int[np.ndarray, " anchors"]
    rest: Float[np.ndarray, "anchors 3"]
    vertices: Float[np.ndarray, "vertices 3"]


class HeadSurface(nn.Module):
    """Triangles whose vertices follow from a head's: linear ones first, then rigid pieces.

    A renderer draws a head subdivided, with eyes and teeth of its own. What is to lie on the drawn surface
    (Gaussians, landmarks) is bound to this mesh, not to the head's control cage, from which a Catmull-Clark
    surface keeps a distance.

    Parameters
    ----------
    faces : (F, 3) int
        Vertex indices.
    operator : (n, V) sparse
        Times the head's V vertices gives the first n vertices; rows sum to one.
    rigid : sequence of RigidPart
        The vertices after those: the similarity that carries `rest` best onto the moved anchors, applied to
        them (Umeyama 1991).
    parts : mapping of str to int
        Number of faces of each part, in their order; their sum is F.

    Raises
    ------
    ShapeError
        If the arrays do not fit each other.
    """

    def __init__(
        self,
        faces: Int[np.ndarray, "faces 3"],
        operator: sp.csr_array,
        rigid: Sequence[RigidPart] = (),
        parts: Mapping[str, int] | None = None,
    ):
        super().__init__()
        self.faces = np.ascontiguousarray(faces, np.int64)
        self.operator = sp.csr_array(operator).astype(np.float32)
        self.rigid = tuple(rigid)
        self.parts = {"head": len(self.faces)} if parts is None else dict(parts)
        self.n_head_vertices = self.operator.shape[1]
        self.n_vertices = self.operator.shape[0] + sum(len(part.vertices) for part in self.rigid)
        self._check()
        rows = self.operator.tocoo()
        indices = torch.from_numpy(np.stack(rows.coords).astype(np.int64))
        self.matrix: Tensor
        matrix = torch.sparse_coo_tensor(
            indices, torch.from_numpy(rows.data), self.operator.shape, check_invariants=True
        )
        self.register_buffer("matrix", matrix.coalesce(), persistent=False)
        for index, part in enumerate(self.rigid):
            for name in ("anchors", "rest", "vertices"):
                dtype = np.int64 if name == "anchors" else np.float32
                array = np.ascontiguousarray(getattr(part, name), dtype)
                self.register_buffer(f"{name}_{index}", torch.from_numpy(array.copy()), persistent=False)

    def _check(self) -> None:
        count = self.n_vertices
        if self.faces.ndim != 2 or self.faces.shape[1] != 3:
            raise ShapeError(f"faces must be (F, 3), not {self.faces.shape}")
        if self.faces.size and not 0 <= self.faces.min() <= self.faces.max() < count:
            raise ShapeError(f"faces name vertices up to {self.faces.max()}, the surface has {count}")
        if sum(self.parts.values()) != len(self.faces):
            raise ShapeError(f"parts have {sum(self.parts.values())} faces, the surface {len(self.faces)}")
        for part in self.rigid:
            if len(part.anchors) < 3 or part.rest.shape != (len(part.anchors), 3):
                raise ShapeError(
                    f"a rigid part has {len(part.anchors)} anchors and rest {part.rest.shape}; expected "
                    "three or more, and a row each"
                )
            if part.anchors.min() < 0 or part.anchors.max() >= self.n_head_vertices:
                raise ShapeError(
                    f"a rigid part hangs on vertex {part.anchors.max()}, the head has {self.n_head_vertices}"
                )

    @classmethod
    def of_mesh(cls, mesh: TriangleMesh) -> "HeadSurface":
        """The head's own triangles."""
        return cls(mesh.faces, sp.eye_array(mesh.n_vertices, format="csr"))

    def part(self, name: str) -> slice:
        """The faces of a part.

        Raises
        ------
        KeyError
            If there is none of that name.
        """
        names = list(self.parts)
        if name not in names:
            raise KeyError(f"no part named {name}; there are {', '.join(names)}")
        start = sum(self.parts[before] for before in names[: names.index(name)])
        return slice(start, start + self.parts[name])

    def forward(
        self, head_vertices: Float[Tensor, "batch head_vertices 3"]
    ) -> Float[Tensor, "batch vertices 3"]:
        """The surface on posed heads, metres; differentiable.

        Parameters
        ----------
        head_vertices : (B, V, 3)
            Of the head.

        Raises
        ------
        ShapeError
            If the head has another number of vertices.
        """
        batch, count = head_vertices.shape[:2]
        if count != self.n_head_vertices:
            raise ShapeError(f"the surface is carried by {self.n_head_vertices} vertices, not {count}")
        flat = head_vertices.transpose(0, 1).reshape(count, 3 * batch)
        pieces = [torch.sparse.mm(self.matrix.to(flat.dtype), flat).unflatten(1, (batch, 3)).transpose(0, 1)]
        for index in range(len(self.rigid)):
            anchors, rest, vertices = (
                getattr(self, f"{name}_{index}") for name in ("anchors", "rest", "vertices")
            )
            moved = head_vertices[:, anchors]
            pieces.append(_carried(rest.to(flat.dtype), moved, vertices.to(flat.dtype)))
        return torch.cat(pieces, dim=1)

    def save(self, path: str | Path) -> None:
        """Write it as one .npz."""
        arrays = {
            "faces": self.faces.astype(np.int32),
            "operator_data": self.operator.data,
            "operator_indices": self.operator.indices.astype(np.int32),
            "operator_starts": self.operator.indptr.astype(np.int32),
            "n_head_vertices": np.int64(self.n_head_vertices),
            "part_names": np.array(list(self.parts)),
            "part_faces": np.array(list(self.parts.values()), np.int64),
        }
        for index, part in enumerate(self.rigid):
            arrays[f"rigid_{index}_anchors"] = part.anchors.astype(np.int32)
            arrays[f"rigid_{index}_rest"] = part.rest.astype(np.float32)
            arrays[f"rigid_{index}_vertices"] = part.vertices.astype(np.float32)
        with written_whole(path) as temporary:
            np.savez_compressed(temporary, **arrays)

    @classmethod
    def load(cls, path: str | Path) -> "HeadSurface":
        """Read what `save` wrote.

        Raises
        ------
        FileFormatError
            If the file is missing, cut short or no surface.
        """
        arrays = read_npz(path)
        try:
            starts = arrays["operator_starts"]
            operator = sp.csr_array(
                (arrays["operator_data"], arrays["operator_indices"], starts),
                (len(starts) - 1, int(arrays["n_head_vertices"])),
            )
            rigid, index = [], 0
            while f"rigid_{index}_anchors" in arrays:
                keys = (f"rigid_{index}_{name}" for name in ("anchors", "rest", "vertices"))
                rigid.append(RigidPart(*(arrays[key] for key in keys)))
                index += 1
            names, counts = arrays["part_names"].tolist(), arrays["part_faces"].tolist()
            return cls(arrays["faces"], operator, rigid, dict(zip(names, counts)))
        except KeyError as error:
            raise FileFormatError(f"{path} is no surface of a head: it lacks {error}") from error
        except (ValueError, IndexError, RuntimeError, MeshanimError) as error:
            raise FileFormatError(f"{path} is no surface of a head: {error}") from error

    def extra_repr(self) -> str:
        parts = ", ".join(f"{count} {name}" for name, count in self.parts.items())
        return f"{self.n_vertices} vertices, {len(self.faces)} faces ({parts})"


def _carried(
    rest: Float[Tensor, "anchors 3"],
    moved: Float[Tensor, "batch anchors 3"],
    vertices: Float[Tensor, "vertices 3"],
) -> Float[Tensor, "batch vertices 3"]:
    """`vertices` under the similarity that best carries `rest` onto `moved`."""
    rest_center, moved_center = rest.mean(0), moved.mean(1, keepdim=True)
    source, target = rest - rest_center, moved - moved_center
    covariance = target.mT @ source
    rotation = roma.special_procrustes(covariance, gradient_eps=1e-5)
    scale = (rotation * covariance).sum((1, 2)) / source.square().sum()
    turned = (vertices - rest_center) @ rotation.mT
    return scale[:, None, None] * turned + moved_center
