"""Which vertices of a mesh are skin, tongue, jaw and eyeballs, and where lips and lids are measured."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from meshanim.errors import FileFormatError, MeshError
from meshanim.files import written_whole
from meshanim.heads import Head
from meshanim.motion.lip_seal import head_lip_pairs

__all__ = ["LIP_POINTS", "FaceParts", "face_parts"]

LIP_POINTS = 5
"""Points along the lips that their distance and thickness are measured at (Audio2Face-3D, Eqs. 4 and 5)."""
PAIRS = ("lip_pairs", "upper_lip", "lower_lip", "lid_pairs")
Indices = Int[np.ndarray, " _"]


def _none() -> np.ndarray:
    return np.zeros(0, np.int64)


@dataclass(frozen=True)
class FaceParts:
    """Vertices by what they are for Audio2Face-3D; an empty array where a mesh has no such part.

    Parameters
    ----------
    skin : (S,) int
        What moves freely.
    tongue : (U,) int
        The tongue.
    jaw_points : (5,) int
        Vertices that move with the jaw bone: left back, right back, left front, right front, middle front.
    jaw_rigid : (J,) int
        Vertices carried along by the jaw's rigid motion: the lower teeth.
    right_eye, left_eye : int
        Eyeballs.
    upper_face : (W,) int
        Skin of forehead, brows and lids.
    lip_pairs : (5, 2) int
        Upper and lower vertex of five places along the lips' margins.
    upper_lip, lower_lip : (5, 2) int
        Top and bottom vertex of each lip at those places.
    lid_pairs : (L, 2) int
        Upper and lower vertex of lid margins.

    Raises
    ------
    MeshError
        If an array has another shape, or there is no skin.
    """

    skin: Indices
    tongue: Indices
    jaw_points: Indices
    jaw_rigid: Indices
    right_eye: Indices
    left_eye: Indices
    upper_face: Indices
    lip_pairs: Int[np.ndarray, "lips 2"]
    upper_lip: Int[np.ndarray, "upper 2"]
    lower_lip: Int[np.ndarray, "lower 2"]
    lid_pairs: Int[np.ndarray, "lids 2"]

    def __post_init__(self):
        for entry in fields(self):
            value = np.ascontiguousarray(getattr(self, entry.name), np.int64)
            width = 2 if entry.name in PAIRS else 1
            if value.ndim != width or (width == 2 and value.shape[1] != 2):
                raise MeshError(f"{entry.name} has shape {value.shape}; expected (n{', 2' * (width - 1)})")
            if value.size and value.min() < 0:
                raise MeshError(f"{entry.name} names vertex {value.min()}; expected indices from 0 on")
            object.__setattr__(self, entry.name, value)
        if not len(self.skin):
            raise MeshError("no vertex is skin")
        if len(self.jaw_points) not in (0, 5):
            raise MeshError(f"{len(self.jaw_points)} jaw points; expected 5, or none")

    @property
    def largest(self) -> int:
        """The highest vertex that is named."""
        return max(int(value.max()) for value in self.arrays().values() if value.size)

    def arrays(self) -> dict[str, np.ndarray]:
        """All of it by name."""
        return {entry.name: getattr(self, entry.name) for entry in fields(self)}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> "FaceParts":
        """What `arrays` gave; a part that is not there is empty.

        Raises
        ------
        MeshError
            If there is no skin, or an array has another shape.
        """
        empty = {
            name: np.zeros((0, 2) if name in PAIRS else 0, np.int64) for name in (f.name for f in fields(cls))
        }
        given = {name: value for name, value in arrays.items() if name in empty and np.size(value)}
        return cls(**(empty | given))

    def save(self, path: str | Path) -> None:
        """Write JSON: lists of vertices by the names above."""
        record = {name: value.tolist() for name, value in asdict(self).items()}
        with written_whole(path) as temporary:
            temporary.write_text(json.dumps(record) + "\n", encoding="utf-8")

    @classmethod
    def load(cls, path: str | Path) -> "FaceParts":
        """Read what `save` wrote, or anyone wrote by hand; parts that are left out are empty.

        Raises
        ------
        FileFormatError
            If it is missing, no such JSON, or names something else.
        """
        try:
            record = json.loads(Path(path).read_text(encoding="utf-8"))
            arrays = {name: np.asarray(value, np.int64) for name, value in record.items()}
            unknown = set(arrays) - {entry.name for entry in fields(cls)}
            if unknown:
                raise ValueError(f"no part {', '.join(sorted(unknown))}")
            return cls.from_arrays(arrays)
        except OSError as error:
            raise FileFormatError(f"cannot read {path}: {error.strerror}") from error
        except (ValueError, TypeError, AttributeError, OverflowError, MeshError) as error:
            raise FileFormatError(f"{path} does not name the parts of a face: {error}") from error


def face_parts(head: Head) -> FaceParts:
    """The parts of a head by its regions, joints and shapes.

    Jaw points are chosen among the lower teeth, or else in the jaw region away from the lips. Lip pairs are
    the head's own, or else the nearest vertices of what follows the jaw and what does not. Lid pairs meet
    when the head blinks (`eyeBlinkLeft` and `eyeBlinkRight`); heads without these shapes have none.
    """
    vertices, regions = head.mesh.vertices, head.regions
    others = np.concatenate([regions[name] for name in ("tongue", "eyes", "teeth")])
    skin = np.setdiff1d(np.arange(len(vertices)), others)
    follows = _jaw_travel(head)
    teeth = regions["teeth"]
    # Back teeth travel less than front ones where a shape opens the jaw; upper ones do not.
    lower_teeth = teeth[follows[teeth] > 0.25 * max(float(follows[teeth].max(initial=0)), 0.1)]
    candidates = lower_teeth
    if len(lower_teeth) < 5:
        candidates = np.setdiff1d(regions["jaw"], regions["lips"])
        # What moves with the bone and not with the cheeks.
        candidates = candidates[follows[candidates] >= 0.7 * follows[candidates].max(initial=0)]
    eyes = {
        side: regions.get(f"{side}_eye", regions["eyes"][sign * vertices[regions["eyes"], 0] > 0])
        for side, sign in (("left", 1), ("right", -1))
    }
    pairs = _lip_pairs(head, follows)
    upper, lower = _lip_thickness(head, pairs, follows)
    return FaceParts(
        skin=skin,
        tongue=regions["tongue"],
        jaw_points=_jaw_points(vertices, candidates),
        jaw_rigid=lower_teeth,
        right_eye=eyes["right"],
        left_eye=eyes["left"],
        upper_face=np.setdiff1d(regions["upper_face"], others),
        lip_pairs=pairs,
        upper_lip=upper,
        lower_lip=lower,
        lid_pairs=_lid_pairs(head),
    )


def _jaw_travel(head: Head) -> Float[np.ndarray, " vertices"]:
    """How much of the jaw's motion each vertex makes, 0 to 1: by skinning, or by the shape jawOpen."""
    weights = head.weights[:, 2].numpy().astype(np.float64)
    if weights.max() > 0.5:
        return weights
    if "jawOpen" not in head.expression_names:
        return np.zeros(head.n_vertices)
    travel = np.linalg.norm(_shape(head, "jawOpen"), axis=1)
    return travel / max(float(travel.max()), 1e-12)


def _shape(head: Head, name: str) -> Float[np.ndarray, "vertices 3"]:
    row = head.expression_names.index(name)
    return head.expression_directions[row].unflatten(0, (-1, 3)).numpy().astype(np.float64)


def _jaw_points(vertices: Float[np.ndarray, "vertices 3"], candidates: Indices) -> Indices:
    """Five candidates that lie as far apart as an arch of teeth does."""
    if len(candidates) < 5:
        return _none()
    x, _, z = ((vertices[candidates] - vertices[candidates].mean(0)) / np.ptp(vertices[candidates], 0)).T
    chosen: list[int] = []
    for score in (x - z, -x - z, x + z, -x + z, z - 2 * np.abs(x)):
        order = np.argsort(-score, kind="stable")
        chosen.append(next(int(k) for k in order if int(k) not in chosen))
    return candidates[chosen]


def _lip_pairs(head: Head, follows: Float[np.ndarray, " vertices"]) -> Int[np.ndarray, "lips 2"]:
    """Five pairs of the margins, from the wearer's right to the left."""
    vertices, lips = head.mesh.vertices, head.regions["lips"]
    pairs = head_lip_pairs(head)
    if pairs is None:
        if len(lips) < 2 * LIP_POINTS or np.ptp(follows[lips]) < 1e-3:
            return np.zeros((0, 2), np.int64)
        middle = 0.5 * (follows[lips].min() + follows[lips].max())
        upper, lower = lips[follows[lips] < middle], lips[follows[lips] >= middle]
        distance, partner = cKDTree(vertices[lower]).query(vertices[upper])
        # At each of many places, the pair that is closest: the margins, not the red of the lips.
        edges = np.linspace(vertices[lips, 0].min(), vertices[lips, 0].max(), 4 * LIP_POINTS + 1)
        bins = np.digitize(vertices[upper, 0], edges)
        best = [
            members[np.argmin(distance[members])]
            for k in np.unique(bins)
            if len(members := np.flatnonzero(bins == k))
        ]
        pairs = np.stack([upper[best], lower[partner[best]]], axis=1)
    centre = vertices[pairs].mean(1)[:, 0]
    first, last = np.quantile(centre, [0.15, 0.85]).tolist()
    middle_half = np.linspace(first, last, LIP_POINTS)
    return pairs[[int(np.argmin(np.abs(centre - place))) for place in middle_half]]


def _lip_thickness(
    head: Head, pairs: Int[np.ndarray, "lips 2"], follows: Float[np.ndarray, " vertices"]
) -> tuple[Int[np.ndarray, "lips 2"], Int[np.ndarray, "lips 2"]]:
    """Top and bottom of the upper lip and of the lower one at each pair."""
    vertices, lips = head.mesh.vertices, head.regions["lips"]
    upper, lower = pairs.copy(), pairs.copy()
    width = np.ptp(vertices[lips, 0]) / 12 if len(lips) else 0.0
    for row, (high, low) in enumerate(pairs):
        near = lips[np.abs(vertices[lips, 0] - vertices[high, 0]) < width]
        upper[row] = near[np.argmax(vertices[near, 1])], high
        lower[row] = low, near[np.argmin(vertices[near, 1])]
    return upper, lower


def _lid_pairs(head: Head) -> Int[np.ndarray, "lids 2"]:
    """Vertices of the upper lids and those of the lower lids that they meet in a blink."""
    pairs = []
    vertices, lids = head.mesh.vertices, head.regions["eyelids"]
    for side in ("Left", "Right"):
        name = f"eyeBlink{side}"
        if name not in head.expression_names or not len(lids):
            continue
        shape = _shape(head, name)[lids]
        travel = -shape[:, 1]
        moving = np.flatnonzero(travel > 0.8 * travel.max())
        resting = np.flatnonzero((travel < 0.3 * travel.max()) & (np.linalg.norm(shape, axis=1) > 0))
        if not len(moving) or not len(resting):
            continue
        closed = vertices[lids] + shape
        meeting, partner = cKDTree(closed[resting]).query(closed[moving])
        found = np.stack([lids[moving], lids[resting[partner]]], axis=1)
        # The margins meet; the skin of the lid above them does not.
        share = meeting / np.linalg.norm(np.diff(vertices[found], axis=1)[:, 0], axis=1).clip(1e-9)
        pairs.append(found[np.argsort(share)[: max(4, int((share < 0.2).sum()))]])
    return np.concatenate(pairs) if pairs else np.zeros((0, 2), np.int64)
