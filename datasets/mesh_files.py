"""Arrays and meshes from files of other programs."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32

from meshanim.errors import FileFormatError
from meshanim.geometry import TriangleMesh

__all__ = ["as_float32", "load_mesh", "read_npy"]


def load_mesh(path: str | Path, vertices: int | None = None, scale: float = 1.0) -> TriangleMesh:
    """A mesh with its vertices in the order of the file.

    Parameters
    ----------
    path : path
        Any format that trimesh reads: obj, ply, stl, off, glb.
    vertices : int, optional
        How many there must be.
    scale : float
        Multiplies the vertices.

    Raises
    ------
    FileFormatError
        If the file is missing, damaged, holds no triangles, or another number of vertices.
    """
    path = Path(path)
    if not path.is_file():
        raise FileFormatError(f"{path} is no file; expected a mesh")
    import trimesh  # slow to load, and few need it

    try:
        loaded = trimesh.load(path, process=False, maintain_order=True, force="mesh", skip_materials=True)
    except Exception as error:  # trimesh's readers raise whatever their parsers do
        reason = str(error) or type(error).__name__
        raise FileFormatError(f"{path} cannot be read as a mesh: {reason}") from error
    points = np.asarray(getattr(loaded, "vertices", ()), np.float64).reshape(-1, 3)
    faces = np.asarray(getattr(loaded, "faces", ()), np.int64).reshape(-1, 3)
    if len(points) == 0 or len(faces) == 0:
        raise FileFormatError(f"{path} holds no triangle mesh")
    if vertices is not None and len(points) != vertices:
        raise FileFormatError(f"{path} has {len(points)} vertices, expected {vertices}")
    return TriangleMesh(points * scale, faces)


def read_npy(path: Path) -> np.ndarray:
    """An array, memory-mapped.

    Raises
    ------
    FileFormatError
        If it is missing, damaged, cut short, or holds anything but numbers.
    """
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except OSError as error:
        raise FileFormatError(f"cannot read {path}: {error.strerror or error}") from error
    except (ValueError, EOFError) as error:
        raise FileFormatError(f"{path} is damaged or cut short: {error}") from error
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
        raise FileFormatError(f"{path} is no .npy file of numbers")
    return array


def as_float32(array: np.ndarray, scale: float = 1.0) -> Float32[np.ndarray, "..."]:
    """The array itself where it is float32 and unscaled, a converted copy otherwise."""
    result = np.asanyarray(array, np.float32)
    return result if scale == 1 else result * np.float32(scale)
