"""`PersonParameters`: everything that makes one person look like themself, as plain numbers."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields

import numpy as np
from jaxtyping import Float

from meshanim.errors import OptionError

__all__ = ["EYE_COLORS", "HAIR_STYLES", "PersonParameters", "skin_color", "srgb_to_linear"]

Color = tuple[float, float, float]

# Outer and inner (collarette) iris colours, sRGB in [0, 1].
EYE_COLORS: dict[str, tuple[Color, Color]] = {
    "brown": ((0.361, 0.204, 0.094), (0.204, 0.110, 0.055)),
    "dark": ((0.204, 0.118, 0.071), (0.110, 0.063, 0.039)),
    "hazel": ((0.502, 0.384, 0.188), (0.306, 0.329, 0.196)),
    "green": ((0.471, 0.455, 0.259), (0.329, 0.392, 0.306)),
    "blue": ((0.455, 0.545, 0.612), (0.345, 0.447, 0.541)),
    "grey": ((0.588, 0.620, 0.627), (0.376, 0.424, 0.455)),
}

HAIR_STYLES = ("none", "buzz", "crop", "parted", "curls", "bob", "long", "bun")

# Skin tone table: sRGB (0-255) at tone 0, 0.2, ... 1.
_TONE = np.array([0.0, 0.2, 0.4, 0.6, 0.8, 1.0])
_TONE_SRGB = np.array(
    [(238, 206, 184), (227, 185, 156), (206, 155, 121), (163, 114, 82), (112, 74, 53), (66, 44, 35)], float
)

_RANGES: dict[str, tuple[float, float]] = {
    "identity_strength": (0.0, 1.0),
    "tone": (0.0, 1.0),
    "undertone": (-1.0, 1.0),
    "blush": (0.0, 1.0),
    "age": (0.0, 1.0),
    "freckles": (0.0, 1.0),
    "moles": (0, 40),
    "oil": (0.0, 1.0),
    "masculinity": (0.0, 1.0),
    "lip_amount": (0.0, 1.0),
    "liner": (0.0, 1.0),
    "brow_density": (0.2, 1.6),
    "brow_thickness": (0.5, 1.6),
    "brow_arch": (0.5, 1.5),
    "hair_length": (0.002, 0.2),
    "hair_grey": (0.0, 1.0),
    "baldness": (0.0, 1.0),
    "part_side": (-0.05, 0.05),
    "fringe": (0.0, 1.0),
    "stubble": (0.0, 1.0),
    "beard_length": (0.0, 0.04),
    "tooth_yellow": (0.0, 1.0),
}


@dataclass(frozen=True)
class PersonParameters:
    """The look of one person. Colours are sRGB in [0, 1]; lengths are metres; everything else is unit-free.

    Parameters
    ----------
    name : str
        What the person is called in sheets and on the command line.
    seed : int
        Draws pores, veins, strands, freckles, teeth: the same seed gives the same arrays bit by bit.
    identity : str
        A named identity of the default head; empty for the mean shape (`shape` is then used as given).
    identity_strength : float
        How far from the mean head towards the named identity, 0 to 1.
    shape : tuple of float
        Shape coefficients of the default head, used where `identity` is empty; missing ones are zero.
    rest_expression : mapping of str to float
        Expression weights of the resting face, added to the neutral: softens lids and brows.
    tone : float
        Skin tone, 0 (fairest) to 1 (darkest). Below 0.05 the skin burns out under the key light.
    undertone : float
        -1 (cool) to 1 (warm): takes up to 10 % off the blue.
    blush : float
        Blood in cheeks, nose and chin, 0 to 1: 0.2 suits dark skin, 0.95 a red-head.
    age : float
        0 (teenager) to 1 (about 80): resting wrinkles grow with its square, expression wrinkles linearly.
    freckles : float
        0 to 1; 1 is 2,600 spots.
    moles : int
        How many.
    oil : float
        Shine of forehead, nose and chin, 0 to 1.
    masculinity : float
        0 to 1, of the look alone (lashes, sideburns); the shape has its own coefficients.
    lip_color, lip_amount : tuple of float, float
        A lip colour and how much of it covers the natural one, 0 to 1.
    liner : float
        Dark line along the lash roots, 0 to 1.
    brow_density, brow_thickness, brow_arch : float
        1 is average; see the range checks for the limits.
    brow_color : tuple of float or None
        The hair colour, darkened, where None.
    hair : str
        One of `HAIR_STYLES`.
    hair_color : tuple of float
    hair_length : float
        Metres: 0.004-0.008 reads as a buzz cut, 0.02-0.05 as a crop, 0.12 and more as a bob or long hair.
    hair_grey : float
        Share of grey strands in hair, brows and beard, 0 to 1.
    baldness : float
        Recession of the hairline, 0 to 1.
    part_side : float
        Where the parting lies, metres to the subject's left (+) or right (-) of the middle.
    fringe : float
        Share of the hair over the forehead that falls onto it, 0 to 1 (bob and long hair).
    stubble : float
        Density of beard hair and of its shadow in the skin, 0 to 1.
    beard_length : float
        Metres; 0.002 is stubble, 0.01 and more a beard.
    eye_color : str
        One of `EYE_COLORS`.
    tooth_yellow : float
        0 (bright) to 1 (yellow).

    Raises
    ------
    OptionError
        If a value is outside its range, or a style or eye colour does not exist.
    """

    name: str = ""
    seed: int = 0
    identity: str = ""
    identity_strength: float = 1.0
    shape: tuple[float, ...] = ()
    rest_expression: Mapping[str, float] = field(default_factory=dict)
    tone: float = 0.25
    undertone: float = 0.0
    blush: float = 0.5
    age: float = 0.3
    freckles: float = 0.0
    moles: int = 4
    oil: float = 0.5
    masculinity: float = 0.5
    lip_color: Color = (0.7, 0.3, 0.32)
    lip_amount: float = 0.0
    liner: float = 0.0
    brow_density: float = 1.0
    brow_thickness: float = 1.0
    brow_arch: float = 1.0
    brow_color: Color | None = None
    hair: str = "buzz"
    hair_color: Color = (0.235, 0.165, 0.118)
    hair_length: float = 0.006
    hair_grey: float = 0.0
    baldness: float = 0.0
    part_side: float = 0.02
    fringe: float = 0.0
    stubble: float = 0.0
    beard_length: float = 0.0
    eye_color: str = "brown"
    tooth_yellow: float = 0.2

    def __post_init__(self) -> None:
        for key, (low, high) in _RANGES.items():
            value = getattr(self, key)
            if not low <= value <= high:
                raise OptionError(f"{key} must lie in [{low:g}, {high:g}], not {value:g}")
        for item in fields(self):
            color = getattr(self, item.name)
            if not item.name.endswith("_color") or not isinstance(color, tuple):
                continue
            if len(color) != 3 or not all(0 <= channel <= 1 for channel in color):
                raise OptionError(f"{item.name} must be three sRGB numbers in [0, 1], not {color}")
        if self.hair not in HAIR_STYLES:
            raise OptionError(f"hair must be one of {', '.join(HAIR_STYLES)}, not '{self.hair}'")
        if self.eye_color not in EYE_COLORS:
            raise OptionError(f"eye_color must be one of {', '.join(EYE_COLORS)}, not '{self.eye_color}'")
        if self.seed < 0:
            raise OptionError(f"seed must be 0 or more, not {self.seed}")


def srgb_to_linear(color) -> Float[np.ndarray, "*shape"]:
    """Display colour in [0, 1] to linear light, with the plain 2.2 power that the renderer inverts."""
    return np.asarray(color, float) ** 2.2


def skin_color(tone: float, undertone: float = 0.0) -> Float[np.ndarray, " 3"]:
    """Linear albedo of untinted skin at a tone in [0, 1], interpolated in a table measured by eye."""
    srgb = np.array([np.interp(tone, _TONE, _TONE_SRGB[:, channel]) for channel in range(3)])
    return srgb_to_linear(srgb / 255) * (1 + undertone * np.array([0.02, 0.0, -0.10]))
