"""`Appearance`: everything the renderer needs to draw one person on the default head."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from meshanim.errors import OptionError
from meshanim.heads import DefaultHead, HeadParameters
from meshanim.render.look.assets import LookAssets, look_assets
from meshanim.render.look.ears import clear_ears
from meshanim.render.look.eyes import Eye, make_eye, make_eye_material
from meshanim.render.look.groom import skin_shade
from meshanim.render.look.hair import grow_hair
from meshanim.render.look.person import PersonParameters
from meshanim.render.look.scalp import falls_over_ears
from meshanim.render.look.skin import micro_detail, paint_skin, paint_tongue
from meshanim.render.look.skin_image import sample_skin_image
from meshanim.render.look.strands import Strands
from meshanim.render.look.surface import Surface, vertex_normals
from meshanim.render.look.teeth import Teeth, make_teeth
from meshanim.render.look.wrinkles import Wrinkles, make_wrinkles

__all__ = ["SKIN_CHANNELS", "Appearance", "make_appearance"]

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
        Skin and tongue, subdivided; linear in the head's vertices. Both use `skin` and `height`.
    skin : (S, S, 8) float32
        `SKIN_CHANNELS`.
    height : (S, S) float32
        Skin relief at rest in metres (pores, lip lines), without the wrinkles of `wrinkles`.
    detail : (D, D, 2) float32
        Tiled slope of the micro relief (d/du, d/dv), repeated 22 times over the skin texture; only for
        pictures that resolve 1.2 pixels a millimetre or more.
    wrinkles : Wrinkles
        Expression wrinkles, added to `height`.
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
    strands: tuple[Strands, ...]
    eyes: tuple[Eye, Eye]
    teeth: tuple[Teeth, Teeth]
    sky: Float[np.ndarray, " surface_vertices"]
    mouth_front: float
    neck_fade: Float[np.ndarray, "loop 2"]


def make_appearance(
    head: DefaultHead,
    person: PersonParameters,
    size: int = 1024,
    assets: LookAssets | None = None,
    skin_image: str | Path | None = None,
) -> Appearance:
    """Paint, groom and equip one person; the same arguments give the same arrays bit by bit.

    Parameters
    ----------
    head : DefaultHead
    person : PersonParameters
    size : int
        Texels along one side of the skin texture.
    assets : LookAssets, optional
        From `look_assets(head, size)`, to make several people without preparing the head again.

    skin_image : path, optional
        A square picture in MakeHuman's texture layout, used in place of the painted albedo.

    Raises
    ------
    FileFormatError
        If `skin_image` is missing, no picture, or not square.
    OptionError
        If the head knows no such identity, or the person has more shape coefficients than the head.
    """
    assets = look_assets(head, size) if assets is None else assets
    shape, template = person_face(head, person)
    on_skin = assets.skin.vertices(template)
    paint = paint_skin(assets.atlas, person)
    if skin_image is not None:
        paint.skin[assets.atlas.active, :3] = sample_skin_image(skin_image, assets.makehuman_uv)
    paint_tongue(assets.tongue_atlas, person, paint)
    strands, shade = grow_hair(assets.ground, paint, assets.lashes, person)
    if falls_over_ears(person.hair):
        strands = tuple(
            clear_ears(group, on_skin, assets.skin.faces, assets.ground.ears)
            if group.kind == "hair"
            else group
            for group in strands
        )
    sky = assets.sky
    if shade is not None:
        rest = assets.ground.vertices
        under = skin_shade(shade, rest * 1000.0, vertex_normals(rest, assets.skin.faces))
        sky = (sky * (0.25 + 0.75 * under)).astype(np.float32)
    eyes = tuple(
        make_eye(head.parts[name].vertices, template, make_eye_material(person, side))
        for side, name in enumerate(("left_eye", "right_eye"))
    )
    teeth = tuple(
        make_teeth(jaw, head.parts[f"{jaw}_teeth"].vertices, assets.vertices, template, person)
        for jaw in ("upper", "lower")
    )
    loop = template[head.neck_loop][:, [2, 1]]
    loop = loop[np.argsort(loop[:, 0], kind="stable")]
    return Appearance(
        person,
        shape,
        template,
        assets.skin,
        assets.tongue,
        paint.skin,
        paint.height,
        micro_detail(),
        make_wrinkles(assets.atlas, person, head.expression_names),
        strands,
        (eyes[0], eyes[1]),
        (teeth[0], teeth[1]),
        sky,
        _mouth_front(on_skin),
        np.ascontiguousarray(loop, np.float32),
    )


def person_face(
    head: DefaultHead, person: PersonParameters
) -> tuple[Float[np.ndarray, " shape"], Float[np.ndarray, "head_vertices 3"]]:
    """A person's shape coefficients, all the head has, and resting vertices in metres, without the look.

    Raises
    ------
    OptionError
        If the head knows no such identity, or the person has more shape coefficients than the head.
    """
    shape = _shape(head, person)
    return shape, _template(head, person, shape)


def _shape(head: DefaultHead, person: PersonParameters) -> Float[np.ndarray, " shape"]:
    """Shape coefficients, padded with zeros to the head's number."""
    if person.identity:
        whole = head.person(person.identity)[0].numpy().astype(np.float32)
        return whole * np.float32(person.identity_strength)
    shape = np.zeros(len(head.shape_names), np.float32)
    if len(person.shape) > len(shape):
        raise OptionError(f"person has {len(person.shape)} shape coefficients, the head {len(shape)}")
    shape[: len(person.shape)] = person.shape
    return shape


def _template(
    head: DefaultHead, person: PersonParameters, shape: np.ndarray
) -> Float[np.ndarray, "head_vertices 3"]:
    parameters = HeadParameters(
        shape=torch.from_numpy(shape)[None], expression=head.expression(person.rest_expression)
    )
    with torch.no_grad():
        return head(parameters)[0].numpy()


def _mouth_front(on_skin: np.ndarray) -> float:
    """z of the lips' inner front at the middle of the face, metres."""
    near = (np.abs(on_skin[:, 0]) < 0.002) & (on_skin[:, 2] > 0.01) & (np.abs(on_skin[:, 1] + 0.04) < 0.006)
    return float(np.quantile(on_skin[near, 2], 0.7))
