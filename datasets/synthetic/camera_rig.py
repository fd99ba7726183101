"""Where the cameras of a synthetic capture stand: a rig like NeRSemble's, or anywhere before the face."""

import numpy as np
from jaxtyping import Float

from meshanim.errors import OptionError
from meshanim.render import Camera, look_at

__all__ = ["RIG_HEIGHT", "RIG_WIDTH", "front_of_rig", "orbit_camera", "random_direction", "rig_directions"]

RIG_WIDTH, RIG_HEIGHT = np.radians(90.0), np.radians(30.0)
RANDOM_AZIMUTH, RANDOM_ELEVATION = np.radians(48.0), np.radians(17.0)
FIELD_OF_VIEW = np.radians(26.0)


def rig_directions(count: int) -> Float[np.ndarray, "cameras 2"]:
    """Azimuth and elevation, radians, of cameras spread over 90 by 30 degrees in three staggered rows.

    Of 16, five stand above, seven in the middle, four below; the front camera is number 8, as in NeRSemble.

    Parameters
    ----------
    count : int
        Cameras; one stands in front.
    """
    if count < 1:
        raise OptionError(f"a rig has 1 camera or more, not {count}")
    rows = _rows(count)
    directions = []
    for number, height in zip(rows, (0.5, 0.0, -0.5)):
        # Rows of an odd number reach from edge to edge, even ones stand between.
        edge = 0.5 if number % 2 else 0.5 - 0.5 / number if number else 0.0
        for azimuth in np.linspace(-edge, edge, number) if number > 1 else [0.0] * number:
            directions.append((azimuth * RIG_WIDTH, height * RIG_HEIGHT))
    return np.array(directions)


def front_of_rig(count: int) -> int:
    """Index of the camera in front."""
    above, middle, _ = _rows(count)
    return above + middle // 2


def _rows(count: int) -> tuple[int, int, int]:
    middle = 2 * max(0, round((0.42 * count - 1) / 2)) + 1
    above = (count - middle + 1) // 2
    return above, middle, count - middle - above


def random_direction(generator: np.random.Generator) -> tuple[float, float]:
    """Azimuth within 48 degrees to each side and elevation within 17 up and down, uniform, radians."""
    azimuth, elevation = generator.uniform(-1, 1, size=2) * (RANDOM_AZIMUTH, RANDOM_ELEVATION)
    return float(azimuth), float(elevation)


def orbit_camera(
    target: Float[np.ndarray, "3"], distance: float, azimuth: float, elevation: float, size: int
) -> Camera:
    """A camera that looks at `target` (metres) from a direction; positive azimuth is towards +x.

    Parameters
    ----------
    distance : float
        Metres.
    azimuth, elevation : float
        Radians.
    size : int
        Pixels a side; the angle of view is 26 degrees.
    """
    direction = np.array(
        [np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)]
    )
    focal = 0.5 * size / np.tan(FIELD_OF_VIEW / 2)
    intrinsics = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    return Camera(look_at(target + distance * direction, target), intrinsics, size, size)
