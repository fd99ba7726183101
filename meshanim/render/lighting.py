"""Lights, sky, background and how much work a frame gets."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from meshanim.errors import OptionError

__all__ = [
    "DRAFT",
    "FULL",
    "STUDIO",
    "Light",
    "Lighting",
    "Quality",
    "backdrop",
    "developed",
    "plain_background",
    "quality_named",
]

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Light:
    """A distant light.

    Parameters
    ----------
    direction : tuple of 3 floats
        Towards the light, world space; any length.
    color : tuple of 3 floats
        Linear.
    intensity : float
    """

    direction: Triple
    color: Triple
    intensity: float


@dataclass(frozen=True)
class Lighting:
    """The light of a picture; world space, y up, colours linear.

    Parameters
    ----------
    lights : tuple of Light
        At most eight; the first is the key light and casts the shadows.
    sky, ground : tuple of 3 floats
        Light from above and from below.
    catch_light : tuple of 3 floats
        Towards the soft box that eyes reflect.
    """

    lights: tuple[Light, ...]
    sky: Triple
    ground: Triple
    catch_light: Triple

    def __post_init__(self):
        if not 1 <= len(self.lights) <= 8:
            raise OptionError(f"1 to 8 lights, not {len(self.lights)}")

    @property
    def key_direction(self) -> Float[np.ndarray, " 3"]:
        """Towards the light that casts the shadows, unit."""
        direction = np.array(self.lights[0].direction, np.float64)
        return direction / np.linalg.norm(direction)

    def native(self):
        """The kernels' form of this."""
        from meshanim import _native

        direction = np.array([light.direction for light in self.lights], np.float32)
        color = np.array([np.multiply(light.color, light.intensity) for light in self.lights], np.float32)
        unit = np.array(self.catch_light, np.float32)
        return _native.Lighting(
            direction / np.linalg.norm(direction, axis=1, keepdims=True),
            color,
            0,
            np.array(self.sky, np.float32),
            np.array(self.ground, np.float32),
            unit / np.linalg.norm(unit),
        )


STUDIO = Lighting(
    lights=(
        Light((-0.62, 0.75, 1.0), (1.0, 0.945, 0.87), 2.2),
        Light((0.95, 0.10, 0.75), (0.80, 0.90, 1.06), 0.62),
        Light((0.75, 0.65, -0.85), (0.95, 0.98, 1.10), 1.5),
        Light((-0.90, 0.35, -0.75), (1.0, 0.95, 0.90), 0.6),
    ),
    sky=(0.50, 0.54, 0.60),
    ground=(0.26, 0.22, 0.20),
    catch_light=(-0.48, 0.13, 1.0),
)
"""A warm key from the upper left with shadows, a cool fill, and two rims from behind."""


@dataclass(frozen=True)
class Quality:
    """How much work a frame gets.

    Parameters
    ----------
    name : str
    samples : int
        Visibility samples a pixel side: 2 smooths edges, 1 does not.
    shadow_pixel : float
        Metres a pixel of the shadow map.
    shadow_taps, occlusion_taps : int
        Samples of the soft shadow and of screen-space occlusion (0: none).
    lobes : int
        Specular lobes: 1 or 2.
    scatter : bool
        Subsurface scattering.
    strands : tuple of str
        Kinds of strands that are drawn.
    strand_step : int
        Draw every so many strands of hair and beard, and those wider.
    texture_scale : float
        Texels wanted a pixel; more is sharper.
    """

    name: str
    samples: int = 2
    shadow_pixel: float = 0.00035
    shadow_taps: int = 16
    occlusion_taps: int = 8
    lobes: int = 2
    scatter: bool = True
    strands: tuple[str, ...] = field(default=("lash", "brow", "beard", "hair"))
    strand_step: int = 1
    texture_scale: float = 1.0

    def native(self, pixels_per_metre: float):
        """The kernels' form of this for a picture of that scale."""
        from meshanim import _native

        quality = _native.Quality()
        quality.samples = self.samples
        quality.shadow_taps = self.shadow_taps
        quality.occlusion_taps = self.occlusion_taps
        quality.lobes = self.lobes
        quality.scatter = self.scatter
        quality.pixels_per_metre = pixels_per_metre
        return quality


FULL = Quality("full")
DRAFT = Quality(
    "draft",
    samples=1,
    shadow_pixel=0.0012,
    shadow_taps=5,
    occlusion_taps=0,
    lobes=1,
    scatter=False,
    strand_step=10,
    texture_scale=0.8,
)


def quality_named(quality: "str | Quality") -> Quality:
    """The quality called "draft" or "full", or the given one.

    Raises
    ------
    OptionError
        If there is none of that name.
    """
    if isinstance(quality, Quality):
        return quality
    named = {"draft": DRAFT, "full": FULL}
    if quality not in named:
        raise OptionError(f"quality must be draft or full, not '{quality}'")
    return named[quality]


def developed(light: Float[np.ndarray, "*pixels 3"]) -> Float[np.ndarray, "*pixels 3"]:
    """The sRGB in [0, 1] that linear light gets in a picture: the tone curve of `develop`."""
    return np.minimum(_toned(light), 1.0) ** (1 / 2.2)


def _toned(light: np.ndarray) -> np.ndarray:
    return light * (1 + light / 9) / (1 + 0.62 * light) * 1.22


def plain_background(width: int, height: int, color: Triple) -> Float[np.ndarray, "height width 3"]:
    """Linear light that `developed` turns into one sRGB colour, in [0, 1]."""
    wanted = np.array(color, np.float64) ** 2.2
    light = np.linspace(0, 16, 1 << 20)
    light = np.interp(wanted, _toned(light), light)
    return np.broadcast_to(light.astype(np.float32), (height, width, 3)).copy()


def backdrop(
    width: int, height: int, top: Triple = (0.50, 0.53, 0.57), bottom: Triple = (0.30, 0.32, 0.36)
) -> Float[np.ndarray, "height width 3"]:
    """A vertical gradient with darker corners, linear light, from two sRGB colours in [0, 1]."""
    y = np.linspace(0, 1, height, dtype=np.float32)[:, None, None]
    x = np.linspace(-1, 1, width, dtype=np.float32)[None, :, None]
    color = np.array(top, np.float32) ** 2.2 * (1 - y) + np.array(bottom, np.float32) ** 2.2 * y
    return np.ascontiguousarray(color * (1.12 - 0.15 * (x**2 + (2 * y - 1) ** 2)), np.float32)
