"""`Appearance`: everything the renderer needs to draw one person on the default head."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from meshanim.render.look.eyes import Eye
from meshanim.render.look.person import PersonParameters
from meshanim.render.look.strands import Strands
from meshanim.render.look.surface import Surface
from meshanim.render.look.teeth import Teeth
from meshanim.render.look.wrinkles import Wrinkles

__all__ = ["SKIN_CHANNELS", "Appearance"]

SKIN_CHANNELS = ("red", "green", "blue", "roughness", "specular", "mouth", "detail", "scatter")
"""Channels of the skin texture: linear albedo; GGX roughness; specular scale (1 is F0 = 0.028); share of
mouth lining (darkens with depth behind the lips); strength of the tiled micro detail; strength of the
subsurface blur."""


@dataclass(frozen=True)
class Appearance:
    """One person, ready to be drawn. Textures are C-contiguous float32, row 0 at v = 1.

    Parameters
    ----------
    person : PersonParameters
        What this was made from.
    shape : (n_shape,) float32
        Shape coefficients of the head.
    template : (V, 3) float32
        The person's resting head, rest expression included: the template to animate.
    surface, tongue : Surface
        Skin and tongue, subdivided; linear in the head's vertices.
    skin : (S, S, 8) float32
        `SKIN_CHANNELS`.
    height : (S, S) float32
        Skin relief at rest in metres (pores, lip lines), without the wrinkles of `wrinkles`.
    detail : (D, D, 2) float32
        Tiled slope of the micro relief (d/du, d/dv), repeated 22 times over the skin texture; only for
        pictures that resolve 1.2 pixels a millimetre or more.
    wrinkles : Wrinkles
        Expression wrinkles, added to `height`.
    tongue_texture : (T, T, 4) float32
        Linear albedo and roughness of the tongue.
    strands : tuple of Strands
        Hair, brows, beard and lashes.
    eyes : (Eye, Eye)
        Left (+x) and right.
    teeth : (Teeth, Teeth)
        Upper and lower jaw.
    sky : (N,) float32
        Share of the sky each skin surface vertex sees at rest, in [0, 1].
    mouth_front : float
        z of the closed lips, metres; the mouth's inside darkens behind it.
    neck_fade : (L, 2) float32
        (z, y) along the neck's cut edge, z ascending: the picture dissolves into the background over
        26 mm above it.
    """

    person: PersonParameters
    shape: Float[np.ndarray, " shape"]
    template: Float[np.ndarray, "head_vertices 3"]
    surface: Surface
    tongue: Surface
    skin: Float[np.ndarray, "size size channels"]
    height: Float[np.ndarray, "size size"]
    detail: Float[np.ndarray, "tile tile 2"]
    wrinkles: Wrinkles
    tongue_texture: Float[np.ndarray, "tongue_size tongue_size 4"]
    strands: tuple[Strands, ...]
    eyes: tuple[Eye, Eye]
    teeth: tuple[Teeth, Teeth]
    sky: Float[np.ndarray, " surface_vertices"]
    mouth_front: float
    neck_fade: Float[np.ndarray, "loop 2"]
