"""The two topologies of Multiface: 7,306 vertices as tracked, 6,172 as MeshTalk left them."""

import json
from pathlib import Path

import igl
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from meshanim.errors import FileFormatError, MeshanimError
from meshanim.geometry import TriangleMesh

__all__ = ["FULL", "REDUCED", "exact_vertices", "read_dropped", "read_obj", "without_vertices"]

FULL, REDUCED = 7306, 6172


def read_obj(path: str | Path) -> TriangleMesh:
    """Vertices, faces and texture coordinates of an OBJ file, in its unit and order.

    Raises
    ------
    FileFormatError
        If the file is missing, has no faces, or faces of other than three corners.
    """
    path = Path(path)
    if not path.is_file():
        raise FileFormatError(f"{path} does not exist")
    try:
        vertices, uv, _, faces, uv_faces, _ = igl.readOBJ(str(path))
        if faces.ndim != 2 or faces.shape[1:] != (3,):
            raise FileFormatError(f"{path} has no triangles")
        if len(uv_faces) != len(faces):
            return TriangleMesh(vertices[:, :3], faces)
        return TriangleMesh(vertices[:, :3], faces, uv[:, :2], uv_faces)
    except (RuntimeError, ValueError, IndexError, MeshanimError) as error:
        if isinstance(error, FileFormatError):
            raise
        raise FileFormatError(f"{path} is no OBJ file of triangles: {error}") from error


def read_dropped(path: str | Path) -> Int[np.ndarray, " dropped"]:
    """Read the list of the 1,134 vertices of 7,306 that MeshTalk's topology leaves out.

    Parameters
    ----------
    path : str or Path
        .npy, .json, or text of integers with commas or blanks between them, brackets around them or not.

    Raises
    ------
    FileFormatError
        If the file is missing, or the list has another length, repeats or exceeds the vertices.
    """
    path = Path(path)
    try:
        if path.suffix == ".npy":
            indices = np.load(path, allow_pickle=False).ravel()
        elif path.suffix == ".json":
            indices = np.asarray(json.loads(path.read_text(encoding="utf-8")))
        else:
            text = path.read_text(encoding="utf-8").translate(str.maketrans("[]{}(),", " " * 7))
            indices = np.array(text.split(), np.int64)
    except OSError as error:
        raise FileFormatError(f"cannot read {path}: {error.strerror or error}") from error
    except (ValueError, EOFError) as error:
        raise FileFormatError(f"{path} is no list of vertices: {error}") from error
    if not np.issubdtype(indices.dtype, np.integer) or indices.ndim != 1:
        raise FileFormatError(f"{path} holds {indices.dtype} of shape {indices.shape}, expected integers")
    unique = np.unique(indices)
    if len(unique) != len(indices) or len(indices) != FULL - REDUCED:
        raise FileFormatError(
            f"{path} names {len(unique)} different vertices in {len(indices)} numbers, expected "
            f"{FULL - REDUCED}: {FULL} less {REDUCED}"
        )
    if unique[0] < 0 or unique[-1] >= FULL:
        raise FileFormatError(f"{path} names vertices {unique[0]} to {unique[-1]} of {FULL}")
    return unique.astype(np.int64)


def exact_vertices(
    full: Float[np.ndarray, "vertices 3"], reduced: Float[np.ndarray, "kept 3"], what: str
) -> Int[np.ndarray, " kept"]:
    """Which vertex of a mesh each vertex of a part of it is, by position.

    Both must be of the same pose and unit; a vertex is found if one lies within a hundred-thousandth of the
    mesh's size, which is what seven digits of text keep.

    Parameters
    ----------
    full, reduced : (V, 3), (K, 3)
        Positions.
    what : str
        The files, for the error.

    Raises
    ------
    FileFormatError
        If a vertex has no counterpart, or two have the same.
    """
    tolerance = 1e-5 * float(np.linalg.norm(np.ptp(full, axis=0)))
    distance, index = KDTree(full).query(reduced)
    lost = int((distance > tolerance).sum())
    if lost:
        raise FileFormatError(
            f"{what}: {lost} of {len(reduced)} vertices have no counterpart within {tolerance:.3g}, the "
            f"farthest is {distance.max():.3g} away; expected two meshes of the same pose and unit"
        )
    if len(np.unique(index)) != len(index):
        raise FileFormatError(
            f"{what}: {len(index) - len(np.unique(index))} vertices share a counterpart; expected one each"
        )
    return index.astype(np.int64)


def without_vertices(mesh: TriangleMesh, kept: Int[np.ndarray, " kept"]) -> TriangleMesh:
    """The faces of a mesh whose corners are all among the kept vertices, renumbered to their order."""
    number = np.full(mesh.n_vertices, -1)
    number[kept] = np.arange(len(kept))
    faces = number[mesh.faces]
    whole = (faces >= 0).all(1)
    if mesh.uv is None or mesh.uv_faces is None:
        return TriangleMesh(mesh.vertices[kept], faces[whole])
    used, uv_faces = np.unique(mesh.uv_faces[whole], return_inverse=True)
    return TriangleMesh(mesh.vertices[kept], faces[whole], mesh.uv[used], uv_faces.reshape(-1, 3))
