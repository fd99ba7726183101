"""The library's regions on FLAME: from FLAME_masks.pkl, or carried over from the default head."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Int
from scipy.spatial import cKDTree

from meshanim.errors import FileFormatError
from meshanim.heads.default import load_default_head
from meshanim.heads.flame_teeth import FlameArrays
from meshanim.heads.head import REGION_NAMES

__all__ = ["flame_regions", "regions_from_default"]

# Region -> the masks it is made of. The upper face is the one that FDD is measured on (827 vertices).
MASKS_OF = {
    "lips": ("lips",),
    "upper_face": ("forehead", "eye_region"),
    "nose": ("nose",),
    "ears": ("left_ear", "right_ear"),
    "neck": ("neck",),
    "scalp": ("scalp",),
    "face": ("face",),
}
EYE_JOINTS = (3, 4)
# A lid lies within this many radii of its eyeball.
LID_REACH = 1.35


def _skinned(arrays: FlameArrays) -> dict[str, Int[np.ndarray, " _"]]:
    """What the skinning weights tell: eyeballs turn with their joints alone."""
    weights = arrays.weights
    eyes = [np.flatnonzero(weights[:, joint] > 0.99) for joint in EYE_JOINTS]
    jaw = np.setdiff1d(np.flatnonzero(weights[:, 2] > 0.5), np.concatenate(eyes))
    return {
        "left_eye": eyes[0],
        "right_eye": eyes[1],
        "eyes": np.concatenate(eyes),
        "jaw": jaw,
        "teeth": np.zeros(0, np.int64),
        "tongue": np.zeros(0, np.int64),
    }


def flame_regions(
    arrays: FlameArrays, masks: Mapping[str, Int[np.ndarray, " _"]]
) -> dict[str, Int[np.ndarray, " _"]]:
    """Regions from FLAME's masks; eyes and jaw by skinning weights, lids by their distance to the eyes."""
    missing = {name for names in MASKS_OF.values() for name in names} - set(masks)
    if missing:
        raise FileFormatError(f"FLAME_masks.pkl lacks {', '.join(sorted(missing))}")
    regions = _skinned(arrays)
    regions |= {
        region: np.unique(np.concatenate([masks[name] for name in names]))
        for region, names in MASKS_OF.items()
    }
    around = np.setdiff1d(masks["eye_region"], regions["eyes"])
    lids = []
    for name in ("left_eye", "right_eye"):
        ball = arrays.vertices[regions[name]]
        if len(ball) == 0:
            continue
        centre = ball.mean(0)
        radius = np.linalg.norm(ball - centre, axis=1).mean()
        lids.append(around[np.linalg.norm(arrays.vertices[around] - centre, axis=1) < LID_REACH * radius])
    regions["eyelids"] = np.unique(np.concatenate(lids)) if lids else np.zeros(0, np.int64)
    return {name: regions[name] for name in REGION_NAMES}


def regions_from_default(arrays: FlameArrays) -> dict[str, Int[np.ndarray, " _"]]:
    """Regions of the nearest vertex of the default head, the two brought together at the eyes."""
    default = load_default_head()
    regions = _skinned(arrays)
    eyes = arrays.joint_regressor[list(EYE_JOINTS)] @ arrays.vertices
    own = default.rest_joints[list(EYE_JOINTS)].numpy()
    scale = np.linalg.norm(own[0] - own[1]) / max(float(np.linalg.norm(eyes[0] - eyes[1])), 1e-9)
    moved = (arrays.vertices - eyes.mean(0)) * scale + own.mean(0)
    skin = default.parts["skin"].vertices
    outer = skin[default.masks["inside-mouth"][skin] < 0.5]
    nearest = outer[cKDTree(default.mesh.vertices[outer]).query(moved)[1]]
    ball = np.zeros(len(moved), bool)
    ball[regions["eyes"]] = True
    for name in (*MASKS_OF, "eyelids"):
        regions[name] = np.flatnonzero(np.isin(nearest, default.regions[name]) & ~ball)
    return {name: regions[name] for name in REGION_NAMES}
