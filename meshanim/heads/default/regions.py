"""The named regions of the default head, from its masks, parts, skinning weights and shapes."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Int

__all__ = ["default_regions"]

UPPER_FACE_SHAPES = [
    "browInnerUp",
    "browDownLeft",
    "browDownRight",
    "browOuterUpLeft",
    "browOuterUpRight",
    "eyeBlinkLeft",
    "eyeBlinkRight",
    "eyeSquintLeft",
    "eyeSquintRight",
    "eyeWideLeft",
    "eyeWideRight",
]


def default_regions(
    vertices: Float[np.ndarray, "vertices 3"],
    parts: Mapping[str, Int[np.ndarray, " _"]],
    masks: Mapping[str, Float[np.ndarray, " vertices"]],
    weights: Float[np.ndarray, "vertices 5"],
    shapes: Mapping[str, Float[np.ndarray, "vertices 3"]],
) -> dict[str, Int[np.ndarray, " _"]]:
    """Vertex indices of every region; skin regions hold skin only, and not the inside of the mouth."""
    x, y, z = vertices.T
    skin = np.zeros(len(vertices), bool)
    skin[parts["skin"]] = True
    outer = skin & (masks["inside-mouth"] < 0.5)
    travel = np.max([np.linalg.norm(shapes[name], axis=1) for name in UPPER_FACE_SHAPES], axis=0)
    blink = np.max([np.linalg.norm(shapes[f"eyeBlink{side}"], axis=1) for side in ("Left", "Right")], axis=0)
    ears = outer & (masks["ears"] > 0.5)
    face = outer & (masks["face"] > 0.5)
    neck = outer & (y < -0.06) & ~face & ~ears
    nose = face & (np.abs(x) < 0.021) & (y > -0.021) & (y < 0.03) & (z > 0.062 + 0.4 * np.abs(x))
    by_mask = {
        "lips": outer & (masks["lips"] > 0.5),
        "upper_face": outer & ((travel > 0.0007) | (masks["eyelids"] > 0.5)) & (y > 0.012) & ~nose & ~ears,
        "eyelids": outer & ((masks["eyelids"] > 0.5) | (blink > 0.0015)),
        "jaw": outer & (weights[:, 2] > 0.5),
        "nose": nose,
        "ears": ears,
        "neck": neck,
        "scalp": outer & ~face & ~ears & ~neck,
        "face": face,
    }
    by_part = {
        "eyes": ("left_eye", "right_eye"),
        "teeth": ("upper_teeth", "lower_teeth"),
        "tongue": ("tongue",),
    }
    regions = {name: np.flatnonzero(mask) for name, mask in by_mask.items()}
    regions |= {name: np.concatenate([parts[part] for part in members]) for name, members in by_part.items()}
    return regions
