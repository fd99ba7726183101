"""Teeth for FLAME, in the layout that VHAP and GaussianAvatars share data in."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from meshanim.geometry import TriangleMesh, split_faces

__all__ = ["FlameArrays", "add_teeth", "offset_on_teeth", "split_teeth"]

# FLAME's outer lip rings from the subject's left corner to the right one, the same 15 columns in both.
UPPER_RING = (1713, 1715, 1716, 1735, 1696, 1694, 1657, 3543, 2774, 2811, 2813, 2850, 2833, 2832, 2830)
LOWER_RING = (1576, 1577, 1773, 1774, 1795, 1802, 1865, 3503, 2948, 2905, 2898, 2881, 2880, 2713, 2712)
COLUMNS = 15
# Height and depth of each row of 15 vertices over the middle of the lips, in mean distances between the
# rings. The order of the rows is that of the shared data.
ROWS = {
    "upper_root": (2.1, -1.5),
    "lower_root": (-2.1, -1.9),
    "upper_edge": (0.1, -1.5),
    "lower_edge": (-0.1, -1.9),
    "upper_root_back": (2.1, -2.5),
    "upper_edge_back": (0.1, -2.5),
    "lower_root_back": (-2.1, -2.9),
    "lower_edge_back": (-0.1, -2.9),
}
# Strips between two rows a and b: the two triangles of a column in the first half, then in the second half of
# the arch; capitals stand for the next column. Frames of Gaussians hang on this order of corners.
STRIPS = (
    ("upper_root", "upper_edge", ("aBb", "aAB"), ("aAb", "ABb")),
    ("upper_root_back", "upper_edge_back", ("abB", "aBA"), ("abA", "AbB")),
    ("upper_edge_back", "upper_edge", ("abA", "AbB"), ("abB", "aBA")),
    ("lower_edge", "lower_root", ("aAb", "ABb"), ("aBb", "aAB")),
    ("lower_root_back", "lower_edge_back", ("aBb", "aAB"), ("aAb", "ABb")),
    ("lower_edge_back", "lower_edge", ("aAb", "ABb"), ("aBb", "aAB")),
)
# One triangle of the shared topology leaves its strip; without it the split teeth would have two vertices
# less than the published 5,431.
STRAY = ((101, 116, 115), (101, 116, 114))


@dataclass(frozen=True)
class FlameArrays:
    """FLAME's numbers: (V, 3), (F, 3), (V, 3, 400), (V, 3, 36), (5, V) and (V, 5)."""

    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    shape_directions: Float[np.ndarray, "vertices 3 400"]
    pose_directions: Float[np.ndarray, "vertices 3 36"]
    joint_regressor: Float[np.ndarray, "5 vertices"]
    weights: Float[np.ndarray, "vertices 5"]


def teeth_faces() -> Int[np.ndarray, "168 3"]:
    """Triangles of the 120 vertices of the teeth."""
    start = {name: index * COLUMNS for index, name in enumerate(ROWS)}
    faces = []
    for row_a, row_b, first, second in STRIPS:
        a, b = start[row_a], start[row_b]
        for column in range(COLUMNS - 1):
            corner = {"a": a + column, "A": a + column + 1, "b": b + column, "B": b + column + 1}
            for triangle in first if column < COLUMNS // 2 else second:
                indices = tuple(corner[letter] for letter in triangle)
                faces.append(STRAY[1] if indices == STRAY[0] else indices)
    return np.array(faces)


def add_teeth(arrays: FlameArrays) -> FlameArrays:
    """Two arches of 60 vertices behind the lips: upper ones follow the neck joint, lower ones the jaw.

    Identity moves them with the mean of the two lip rings, expression and pose correctives not at all.
    """
    upper, lower = list(UPPER_RING), list(LOWER_RING)
    distance = np.linalg.norm(arrays.vertices[upper] - arrays.vertices[lower], axis=1).mean()
    middle = (arrays.vertices[upper] + arrays.vertices[lower]) / 2
    middle[:, 1] = middle[:, 1].mean()
    teeth = np.concatenate(
        [middle + distance * np.array([0, height, depth]) for height, depth in ROWS.values()]
    )
    count = len(teeth)
    shapes = np.zeros((count, 3, 400), np.float32)
    identity = (arrays.shape_directions[upper, :, :300] + arrays.shape_directions[lower, :, :300]) / 2
    shapes[:, :, :300] = np.tile(identity, (len(ROWS), 1, 1))
    weights = np.zeros((count, 5))
    is_upper = np.repeat([name.startswith("upper") for name in ROWS], COLUMNS)
    weights[is_upper, 1] = 1
    weights[~is_upper, 2] = 1
    return FlameArrays(
        np.concatenate([arrays.vertices, teeth]),
        np.concatenate([arrays.faces, teeth_faces() + len(arrays.vertices)]),
        np.concatenate([arrays.shape_directions, shapes]),
        np.concatenate([arrays.pose_directions, np.zeros((count, 3, 36), np.float32)]),
        np.concatenate([arrays.joint_regressor, np.zeros((5, count))], axis=1),
        np.concatenate([arrays.weights, weights]),
    )


def split_teeth(arrays: FlameArrays) -> FlameArrays:
    """Every triangle of the teeth in four (GaussianSpeech, Sec. 4.1), by the midpoints of its sides."""
    fine = _split(arrays.vertices, arrays.faces)
    operator, count = fine.operator, len(arrays.vertices)

    def carried(values: np.ndarray) -> np.ndarray:
        new = operator[count:] @ values.reshape(count, -1)
        return np.concatenate([values, new.reshape(-1, *values.shape[1:]).astype(values.dtype)])

    added = fine.mesh.n_vertices - count
    return FlameArrays(
        carried(arrays.vertices),
        fine.mesh.faces,
        carried(arrays.shape_directions),
        carried(arrays.pose_directions),
        np.concatenate([arrays.joint_regressor, np.zeros((5, added))], axis=1),
        carried(arrays.weights),
    )


def offset_on_teeth(
    offset: Float[np.ndarray, "shared 3"], mesh: TriangleMesh, head_vertices: int, head_faces: int
) -> Float[np.ndarray, "vertices 3"]:
    """Offsets that were shared for FLAME without teeth, with fewer or with other ones, on a head's vertices.

    Teeth that the offsets lack stay where they are (GaussianAvatars pads with zeros), those that the head
    lacks are left out, and split ones take the means of their sides.

    Parameters
    ----------
    offset : (W, 3)
        One a vertex of FLAME, then of teeth: 5,023, 5,083 or 5,143 rows.
    mesh : TriangleMesh
        The head.
    head_vertices, head_faces : int
        Of FLAME without teeth.
    """
    count, plain = mesh.n_vertices, head_vertices + len(ROWS) * COLUMNS
    padded = np.zeros((max(plain, len(offset)), 3), offset.dtype)
    padded[: len(offset)] = offset
    if count <= plain:
        return padded[:count]
    faces = np.concatenate([mesh.faces[:head_faces], teeth_faces() + head_vertices])
    operator = _split(mesh.vertices[:plain], faces).operator
    return (operator @ padded[:plain]).astype(offset.dtype)


def _split(vertices: np.ndarray, faces: np.ndarray):
    """A mesh whose last triangles, the teeth, are split in four."""
    teeth = np.arange(len(faces) - len(teeth_faces()), len(faces))
    return split_faces(TriangleMesh(vertices, faces), teeth)
