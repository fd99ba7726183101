"""Skin from a picture in MakeHuman's texture layout."""

from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image
from scipy.ndimage import map_coordinates

from meshanim.errors import FileFormatError
from meshanim.render.look.person import srgb_to_linear

__all__ = ["sample_skin_image"]

SMALLEST = 64


def sample_skin_image(path: str | Path, uv: Float[np.ndarray, "texels 2"]) -> Float[np.ndarray, "texels 3"]:
    """Linear albedo of a picture at texture coordinates (v up), bilinear.

    Parameters
    ----------
    path : path
        Any format that Pillow reads; a grey or transparent picture is taken as opaque colour.
    uv : (n, 2) float
        In MakeHuman's layout.

    Raises
    ------
    FileFormatError
        If the file is missing, no picture, not square or smaller than 64 x 64.
    """
    try:
        with Image.open(path) as opened:
            pixels = np.asarray(opened.convert("RGB"), np.float32) / 255
    except (OSError, Image.DecompressionBombError) as error:
        raise FileFormatError(f"cannot read the skin picture {path}: {error}") from error
    height, width = pixels.shape[:2]
    if height != width or width < SMALLEST:
        raise FileFormatError(
            f"{path} is {width} x {height}; a skin in MakeHuman's layout is square, 64 x 64 or larger"
        )
    at = np.stack([(1 - uv[:, 1]) * height - 0.5, uv[:, 0] * width - 0.5])
    linear = srgb_to_linear(pixels)
    channels = [map_coordinates(linear[..., k], at, order=1, mode="nearest") for k in range(3)]
    return np.clip(np.stack(channels, axis=1), 0.002, 0.95).astype(np.float32)
