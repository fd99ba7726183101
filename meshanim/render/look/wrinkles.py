"""Expression wrinkles: thirteen groups of folds as height maps, driven by ARKit expression weights."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

__all__ = ["WRINKLE_DRIVE", "WRINKLE_GROUPS", "WrinkleMap", "Wrinkles", "wrinkle_height"]

WRINKLE_DRIVE: dict[str, dict[str, float]] = {
    "forehead_middle": {"browInnerUp": 1.0, "browOuterUpLeft": 0.35, "browOuterUpRight": 0.35},
    "forehead_left": {"browOuterUpLeft": 1.0, "browInnerUp": 0.25},
    "forehead_right": {"browOuterUpRight": 1.0, "browInnerUp": 0.25},
    "frown": {"browDownLeft": 0.5, "browDownRight": 0.5},
    "nose": {"noseSneerLeft": 0.5, "noseSneerRight": 0.5, "browDownLeft": 0.2, "browDownRight": 0.2},
    "crow_left": {"eyeSquintLeft": 0.6, "cheekSquintLeft": 0.8, "mouthSmileLeft": 0.35, "eyeBlinkLeft": 0.25},
    "crow_right": {
        "eyeSquintRight": 0.6,
        "cheekSquintRight": 0.8,
        "mouthSmileRight": 0.35,
        "eyeBlinkRight": 0.25,
    },
    "nasolabial_left": {
        "mouthSmileLeft": 0.85,
        "noseSneerLeft": 0.7,
        "mouthUpperUpLeft": 0.3,
        "mouthStretchLeft": 0.3,
        "cheekSquintLeft": 0.3,
    },
    "nasolabial_right": {
        "mouthSmileRight": 0.85,
        "noseSneerRight": 0.7,
        "mouthUpperUpRight": 0.3,
        "mouthStretchRight": 0.3,
        "cheekSquintRight": 0.3,
    },
    "dimple_left": {"mouthSmileLeft": 0.7, "mouthDimpleLeft": 1.0},
    "dimple_right": {"mouthSmileRight": 0.7, "mouthDimpleRight": 1.0},
    "lips": {"mouthPucker": 1.0, "mouthFunnel": 0.5},
    "chin": {
        "mouthShrugLower": 1.0,
        "mouthFrownLeft": 0.35,
        "mouthFrownRight": 0.35,
        "mouthPressLeft": 0.15,
        "mouthPressRight": 0.15,
    },
}
"""How much each expression weight adds to each group."""

WRINKLE_GROUPS = tuple(WRINKLE_DRIVE)


@dataclass(frozen=True)
class WrinkleMap:
    """Height of one group at full strength, cropped out of the S x S texture.

    Parameters
    ----------
    row, column : int
        Where the crop's first texel lies.
    height : (h, w) float32
        Metres; valleys are negative.
    """

    row: int
    column: int
    height: Float[np.ndarray, "rows columns"]


@dataclass(frozen=True)
class Wrinkles:
    """The folds of one person.

    Parameters
    ----------
    maps : tuple of WrinkleMap
        One a group of `WRINKLE_GROUPS`.
    drive : (13, E) float32
        Times the head's expression weights (E,) gives the raw drive of each group.
    rest : (13,) float32
        Amplitude at the neutral face (grows with age).
    gain : float
        Amplitude a unit of soft-clipped drive (grows with age).
    """

    maps: tuple[WrinkleMap, ...]
    drive: Float[np.ndarray, "groups expressions"]
    rest: Float[np.ndarray, " groups"]
    gain: float

    def amplitudes(self, expression: Float[np.ndarray, " expressions"]) -> Float[np.ndarray, " groups"]:
        """Amplitude of each map: rest + gain * 1.25 tanh(max(drive @ expression, 0) / 1.25)."""
        raw = np.maximum(self.drive @ np.asarray(expression, np.float32), 0)
        return self.rest + np.float32(self.gain * 1.25) * np.tanh(raw / np.float32(1.25))


def wrinkle_height(
    wrinkles: Wrinkles, expression: Float[np.ndarray, " expressions"], size: int
) -> Float[np.ndarray, "size size"]:
    """The wrinkles' height map for one frame, metres: the reference for the renderer's native sum."""
    total = np.zeros((size, size), np.float32)
    for patch, amplitude in zip(wrinkles.maps, wrinkles.amplitudes(expression)):
        rows, columns = patch.height.shape
        total[patch.row : patch.row + rows, patch.column : patch.column + columns] += amplitude * patch.height
    return total


def drive_matrix(expression_names: tuple[str, ...]) -> Float[np.ndarray, "groups expressions"]:
    """`WRINKLE_DRIVE` as a matrix over a head's expression names; names it lacks add nothing."""
    matrix = np.zeros((len(WRINKLE_GROUPS), len(expression_names)), np.float32)
    column = {name: index for index, name in enumerate(expression_names)}
    for row, group in enumerate(WRINKLE_GROUPS):
        for name, weight in WRINKLE_DRIVE[group].items():
            if name in column:
                matrix[row, column[name]] = weight
    return matrix
