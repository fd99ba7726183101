"""Which vertices of a head a blendshape solve looks at, and how much each of them counts."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from meshanim.errors import OptionError, ShapeError
from meshanim.heads import Head

__all__ = ["IMPORTANCE", "VertexSampling", "nasolabial_folds", "sample_vertices"]

IMPORTANCE: Mapping[str, float] = {
    "lips": 6.0,
    "eyelids": 4.0,
    "nasolabial_folds": 3.0,
    "teeth": 0.25,
    "tongue": 0.25,
    "neck": 0.0,
    "scalp": 0.0,
    "ears": 0.0,
}
"""How much an area of skin counts by region, beside 1 elsewhere."""
MOVED = 1e-3
"""A vertex takes part if a shape moves it by more than this share of the shape's largest move."""
FOLD = 0.4
"""Half the width of the folds, as a share of their length."""


@dataclass(frozen=True)
class VertexSampling:
    """The selector M of the solve, with weights.

    Parameters
    ----------
    vertices : (S,) int
        Indices, each once.
    weights : (S,) float
        Not negative; only their ratios matter.
    """

    vertices: Int[np.ndarray, " samples"]
    weights: Float[np.ndarray, " samples"]

    def __post_init__(self):
        if len(self.vertices) == 0 or self.weights.shape != self.vertices.shape:
            raise ShapeError(
                f"a sampling needs vertices and a weight each, not {len(self.vertices)} and "
                f"{len(self.weights)}"
            )
        if len(np.unique(self.vertices)) != len(self.vertices) or self.vertices.min() < 0:
            raise ShapeError("sampled vertices must be indices that are all different")
        if not (np.isfinite(self.weights).all() and (self.weights >= 0).all() and self.weights.any()):
            raise ShapeError("sampling weights must be finite and not negative, and not all zero")


def sample_vertices(
    head: Head, count: int | None = None, importance: Mapping[str, float] = IMPORTANCE
) -> VertexSampling:
    """Choose vertices for the solve: denser where a face is read (Audio2Face-3D, Sec. 6, vertex sampling).

    Every vertex that a shape moves has a measure: its area times the importance of its region. Vertices are
    taken furthest first, distances being stretched by the root of the importance, and each stands for the
    measure of the vertices nearest to it. So the solve depends little on `count` and not on how finely an
    artist has meshed which part.

    Parameters
    ----------
    head : Head
        Shapes and regions.
    count : int, optional
        How many; all that count, if not given or if there are fewer.
    importance : mapping of region name to float
        The last region that holds a vertex decides; "nasolabial_folds" is known beside the head's own.

    Raises
    ------
    OptionError
        If a region does not exist, an importance is negative, the count is not positive, or no shape moves
        a vertex that counts.
    """
    if count is not None and count < 1:
        raise OptionError(f"the number of sampled vertices must be positive, not {count}")
    travel = np.linalg.norm(_deltas(head), axis=2)
    value = (travel > MOVED * np.maximum(travel.max(1, keepdims=True, initial=0), 1e-30)).any(0).astype(float)
    for region, by in importance.items():
        if region != "nasolabial_folds" and region not in head.regions:
            raise OptionError(f"the head has no region {region}; there are {', '.join(head.regions)}")
        if by < 0:
            raise OptionError(f"the importance of {region} must not be negative, but is {by}")
        members = nasolabial_folds(head) if region == "nasolabial_folds" else head.regions[region]
        value[members] = np.where(value[members] > 0, by, 0.0)
    measure = value * head.mesh.mass.diagonal()
    chosen = np.flatnonzero(measure > 0)
    if not len(chosen):
        raise OptionError("no shape of this head moves a vertex that counts")
    if count is None or count >= len(chosen):
        return VertexSampling(chosen, measure[chosen])
    taken, owner = _furthest_first(head.mesh.vertices[chosen], np.sqrt(value[chosen]), count)
    weights = np.bincount(owner, measure[chosen], minlength=count)
    order = np.argsort(taken)
    return VertexSampling(chosen[taken[order]], weights[order])


def nasolabial_folds(head: Head) -> Int[np.ndarray, " vertices"]:
    """Skin around the lines from the wings of the nose to the corners of the mouth.

    Empty on heads without nose, lips or face.
    """
    nose, lips, face = (head.regions[name] for name in ("nose", "lips", "face"))
    if not (len(nose) and len(lips) and len(face)):
        return np.zeros(0, np.int64)
    points = head.mesh.vertices
    near = np.zeros(len(face), bool)
    for side in (-1, 1):
        wing, corner = (points[part[(side * points[part, 0]).argmax()]] for part in (nose, lips))
        line = corner - wing
        along = ((points[face] - wing) @ line / (line @ line)).clip(0, 1)
        distance = np.linalg.norm(points[face] - wing - along[:, None] * line, axis=1)
        near |= distance < FOLD * np.linalg.norm(line)
    others = [head.regions[name] for name in ("lips", "nose", "teeth", "tongue", "eyes", "eyelids")]
    return np.setdiff1d(face[near], np.concatenate(others))


def _deltas(head: Head) -> Float[np.ndarray, "shapes vertices 3"]:
    return head.expression_directions.detach().cpu().unflatten(1, (-1, 3)).numpy()


def _furthest_first(points: np.ndarray, stretch: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Indices of `count` points, and for every point which of them is nearest."""
    taken = np.empty(count, np.int64)
    owner = np.zeros(len(points), np.int64)
    nearest = np.full(len(points), np.inf)
    following = int(stretch.argmax())
    for k in range(count):
        taken[k] = following
        distance = ((points - points[following]) ** 2).sum(1)
        closer = distance < nearest
        owner[closer] = k
        nearest[closer] = distance[closer]
        nearest[following] = -1.0
        following = int((nearest * stretch**2).argmax())
    return taken, owner
