"""What goes into a rasteriser besides the scene, and what comes out of it."""

from dataclasses import dataclass
from typing import Literal

from jaxtyping import Float, Int
from torch import Tensor

from meshanim.errors import OptionError

__all__ = ["DepthMode", "RasterOptions", "Rendering"]

DepthMode = Literal["expected", "accumulated"]


@dataclass(frozen=True)
class RasterOptions:
    """The numbers that decide pixels; `rasterize` explains them."""

    near: float
    far: float
    eps2d: float
    antialiased: bool
    max_alpha: float
    depth: DepthMode | None

    def __post_init__(self):
        if not 0 < self.near < self.far:
            raise OptionError(f"near and far must be 0 < near < far, not {self.near} and {self.far}")
        if not self.eps2d >= 0:
            raise OptionError(f"eps2d must not be negative, and is {self.eps2d}")
        if not 0 < self.max_alpha < 1:
            raise OptionError(f"max_alpha must lie between 0 and 1, and is {self.max_alpha}")
        if self.depth not in (None, "expected", "accumulated"):
            raise OptionError(f"depth must be 'expected', 'accumulated' or None, not {self.depth!r}")


@dataclass(frozen=True)
class Rendering:
    """Images of Gaussians.

    Parameters
    ----------
    rgb : (..., C, H, W, D)
        Colours (or whatever channels the Gaussians have) over the background.
    alpha : (..., C, H, W)
        Opacity in [0, 1].
    depth : (..., C, H, W), optional
        Metres along the viewing axis: the mean over what the pixel shows, weighted by its share ("expected";
        0 where nothing is seen), or the weighted sum ("accumulated").
    screen_offsets : (..., C, N, 2), optional
        Zeros that were added to the Gaussians' positions in the image; after backward their `.grad` is the
        gradient of the loss to the positions, a pixel. What densification looks at.
    radii : (..., C, N, 2) int
        Half the box in which a Gaussian can be seen, pixels along x and y; 0 where it was culled.
    """

    rgb: Float[Tensor, "*batch cameras height width channels"]
    alpha: Float[Tensor, "*batch cameras height width"]
    depth: Float[Tensor, "*batch cameras height width"] | None
    screen_offsets: Float[Tensor, "*batch cameras n 2"] | None
    radii: Int[Tensor, "*batch cameras n 2"]
