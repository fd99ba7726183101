"""Expression wrinkles: thirteen groups of folds as height maps, driven by ARKit expression weights."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from meshanim.render.look.atlas import Atlas
from meshanim.render.look.noise import value_noise
from meshanim.render.look.paint import smoothstep
from meshanim.render.look.person import PersonParameters

__all__ = [
    "WRINKLE_DRIVE",
    "WRINKLE_GROUPS",
    "WrinkleMap",
    "Wrinkles",
    "drive_matrix",
    "make_wrinkles",
    "wrinkle_height",
]

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

# Depth at full drive (millimetres; 1 mm on the forehead looks like corrugated plastic) and share of it that
# the face of an old person keeps at rest.
_DEPTH = {
    "forehead": (0.50, 0.65),
    "frown": (0.75, 0.50),
    "nose": (0.50, 0.10),
    "crow": (0.36, 0.95),
    "nasolabial": (1.70, 0.62),
    "dimple": (0.50, 0.25),
    "lips": (0.35, 0.60),
    "chin": (0.50, 0.10),
}


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


def make_wrinkles(atlas: Atlas, person: PersonParameters, expression_names: tuple[str, ...]) -> Wrinkles:
    """Draw a person's folds on the atlas.

    Parameters
    ----------
    atlas : Atlas
    person : PersonParameters
        `seed` moves the lines, `age` scales them.
    expression_names : tuple of str
        The head's expressions, the columns of the drive.
    """
    front = np.flatnonzero((atlas.island == 0) & (atlas.position[:, 2] > -0.03))
    rows, columns = np.nonzero(atlas.active)
    rows, columns = rows[front], columns[front]
    maps, rest = [], []
    for group, fold in _folds(atlas, person, front).items():
        depth, kept = _DEPTH[group.split("_")[0]]
        height = (fold * np.float32(depth * 1e-3)).astype(np.float32)
        used = np.abs(height) > 1e-7
        row, column = rows[used].min(), columns[used].min()
        crop = np.zeros((rows[used].max() - row + 1, columns[used].max() - column + 1), np.float32)
        crop[rows[used] - row, columns[used] - column] = height[used]
        maps.append(WrinkleMap(int(row), int(column), crop))
        rest.append(1.1 * kept * person.age**2)
    return Wrinkles(
        tuple(maps),
        drive_matrix(expression_names),
        np.array(rest, np.float32),
        0.45 + 0.75 * person.age,
    )


def _line(distance: np.ndarray, width: float) -> np.ndarray:
    """A valley with raised shoulders."""
    shoulders = np.exp(-(((np.abs(distance) - 2.1 * width) / (1.1 * width)) ** 2))
    return -np.exp(-((distance / width) ** 2)) + 0.45 * shoulders


def _folds(atlas: Atlas, person: PersonParameters, front: np.ndarray) -> dict[str, np.ndarray]:
    """Relief of unit depth of every group of `WRINKLE_GROUPS`, in its order, at the texels `front`."""
    points = atlas.position[front] * np.float32(1000)
    draws = np.random.default_rng([person.seed, 2])
    broad = value_noise(points, 16.7, person.seed * 64 + 22, 2)
    fine = value_noise(points, 6.25, person.seed * 64 + 23)
    forehead = _forehead(points, broad, fine, draws, person.seed * 64 + 30)
    x, y, z = points.T
    side = np.abs(x)
    window = smoothstep(56, 64, y) * smoothstep(106, 96, y)
    folds = {
        "forehead_middle": forehead * window * smoothstep(46, 28, side),
        "forehead_left": forehead * window * smoothstep(12, 30, x) * smoothstep(66, 50, x),
        "forehead_right": forehead * window * smoothstep(12, 30, -x) * smoothstep(66, 50, -x),
    }
    elevens = _line(side - (7.2 + 0.16 * (y - 47)) + 0.6 * broad, 1.1)
    elevens = elevens + 0.5 * _line(x + 0.8 * broad - 1, 0.9) * smoothstep(50, 55, y)
    folds["frown"] = elevens * smoothstep(40, 47, y) * smoothstep(71, 58, y)
    bridge = sum(_line(y + 0.25 * side - level + 0.7 * fine, 0.8) for level in (28.5, 32.5, 36.5))
    bridge = bridge * smoothstep(17, 10, side) * smoothstep(0.5, 4, side)
    folds["nose"] = bridge * smoothstep(22, 27, y) * smoothstep(43, 38, y)
    for name, shape in (("crow", _crow), ("nasolabial", _nasolabial), ("dimple", _dimple)):
        folds[f"{name}_left"] = shape(x, y, z, broad, fine)
        folds[f"{name}_right"] = shape(-x, y, z, broad, fine)
    angle, radius = np.arctan2(y + 39, x), np.hypot(0.75 * x, y + 39)
    ring = smoothstep(24, 17, radius) * smoothstep(6, 10, radius) * (z > 40)
    fan = np.clip(np.sin(46 * angle + 4 * broad), 0, 1) ** 2
    folds["lips"] = -fan * ring * (1 - 0.5 * atlas.masks["lips"][front])
    pits = np.clip(2.2 * value_noise(points, 3.85, person.seed * 64 + 40, 2), 0, 1)
    folds["chin"] = -pits * np.exp(-(((y + 66) / 8) ** 2) - (side / 16) ** 2)
    return folds


def _forehead(points, broad, fine, draws: np.random.Generator, seed: int) -> np.ndarray:
    """Four wavy lines, broken here and there."""
    side, y = np.abs(points[:, 0]), points[:, 1]
    total = np.zeros(len(points), np.float32)
    for k in range(4):
        bow = 1.44 * (1 - 0.05 * k) * np.cos(np.clip(side / 40, 0, 1) * np.pi)
        level = 68.5 + 8.8 * k + draws.normal(0, 1.2) + bow - 4.8e-3 * np.clip(side - 20, 0, None) ** 2
        broken = value_noise(points, 25, seed + k, 1, (1.0, 0.1, 0.2))
        depth = (0.25 + 0.75 * np.clip(2.2 * broken + 0.55, 0, 1)) * (1 - 0.10 * abs(k - 1.5))
        total += _line(y + 3.4 * broad + 1.2 * fine - level, 1.4) * depth
    return total


def _crow(x, y, z, broad, fine) -> np.ndarray:
    """Rays from the outer eye corner and two folds under the eye, on the side where x > 0."""
    across, up = x - 48.5, y - 31.5
    radius = np.hypot(across, up) + 1e-6
    angle = np.arctan2(up, across) + 0.09 * broad
    rays = np.zeros_like(x)
    for direction, length in ((0.62, 1.0), (0.30, 1.1), (-0.02, 1.1), (-0.34, 1.0), (-0.68, 0.8)):
        reach = smoothstep(4, 8.5, radius) * smoothstep(23.5 * length, 12 * length, radius)
        rays += _line((angle - direction) * np.maximum(radius, 4), 0.75) * reach
    lower = y - (22.5 - 0.10 * np.clip(36 - x, 0, None) + 3e-3 * (x - 34) ** 2)
    bags = sum(0.75 * _line(lower + step + 0.4 * fine, 0.7) for step in (0.0, 3.6))
    bags = bags * smoothstep(16, 22, x) * smoothstep(52, 44, x)
    return (rays * (across > 0) + bags) * (x > 0)


def _nasolabial(x, y, z, broad, fine) -> np.ndarray:
    """The fold from the wing of the nose to beside the mouth corner."""
    along = np.clip((-8 - y) / 45, -0.3, 1.2)
    curve = 20.5 + 17.5 * np.clip(along, 0, 2) ** 0.85 + 2.2 * np.sin(np.clip(along, 0, 1) * np.pi)
    distance = 0.85 * (x - curve)
    fold = -np.exp(-((distance / 2.2) ** 2)) + 0.55 * np.exp(-(((distance - 6.5) / 4.5) ** 2))
    fold = fold - 0.15 * np.exp(-(((distance + 4) / 3) ** 2))
    return fold * smoothstep(-0.12, 0.10, along) * smoothstep(1.02, 0.72, along) * (z > 20) * (x > 8)


def _dimple(x, y, z, broad, fine) -> np.ndarray:
    """The crease beside the mouth corner."""
    along = np.clip((-25 - y) / 32, -1, 2)
    curve = 38.5 + 3.5 * np.sin(np.clip(along, 0, 1) * np.pi)
    crease = _line(x - curve + 0.5 * broad, 1.6)
    return crease * smoothstep(-0.05, 0.3, along) * smoothstep(1.05, 0.7, along) * (z > 10)
