"""What the look needs of the default head, computed once: surfaces, atlas, sky visibility, lash lines."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from meshanim.heads import DefaultHead
from meshanim.render.look.atlas import Atlas, build_atlas
from meshanim.render.look.groom import Ground
from meshanim.render.look.lashes import LashGuide, lash_guide
from meshanim.render.look.surface import Surface, sky_visibility, subdivided_surface

__all__ = ["LookAssets", "look_assets"]


@dataclass(frozen=True)
class LookAssets:
    """The default head as the look sees it; the same for every person.

    Parameters
    ----------
    vertices : (V, 3) float32
        The mean head at rest, metres.
    skin, tongue : Surface
        Both lie in one texture layout.
    atlas, tongue_atlas : Atlas
        Of the skin and of the tongue, in the same texture.
    sky : (N,) float32
        Sky visibility of the skin's vertices with nothing but the head in the way.
    ground : Ground
        What hair grows on.
    lashes : tuple of LashGuide
        The four lids.
    makehuman_uv : (n, 2) float32
        Place of each active texel of the skin's atlas in MakeHuman's own texture layout.
    """

    vertices: Float[np.ndarray, "head_vertices 3"]
    skin: Surface
    tongue: Surface
    atlas: Atlas
    tongue_atlas: Atlas
    sky: Float[np.ndarray, " surface_vertices"]
    ground: Ground
    lashes: tuple[LashGuide, ...]
    makehuman_uv: Float[np.ndarray, "texels 2"]


def look_assets(head: DefaultHead, size: int = 1024) -> LookAssets:
    """Prepare the default head for painting.

    Parameters
    ----------
    head : DefaultHead
    size : int
        Texels along one side of the skin texture.
    """
    vertices = head.mesh.vertices.astype(np.float32)
    skin, tongue = (_part_surface(head, name, head.atlas_uv) for name in ("skin", "tongue"))
    original = _part_surface(head, "skin", head.uv).corner_uv
    masks = {"mouth" if name == "inside-mouth" else name: mask for name, mask in head.masks.items()}
    atlas = build_atlas(skin, vertices, masks, size)
    on_skin = skin.vertices(vertices)
    lashes = tuple(
        lash_guide(
            vertices[head.parts[f"{name}_{lid}_lashes"].vertices],
            vertices[head.parts[f"{name}_eye"].vertices],
            side,
            lid == "upper",
        )
        for name, side in (("left", 1), ("right", -1))
        for lid in ("upper", "lower")
    )
    return LookAssets(
        vertices,
        skin,
        tongue,
        atlas,
        build_atlas(tongue, vertices, {}, size),
        sky_visibility(on_skin, skin.faces),
        Ground(atlas, skin, on_skin, skin.operator @ masks["ears"]),
        lashes,
        np.einsum("nkd,nk->nd", original[atlas.triangle], atlas.barycentric),
    )


def _part_surface(head: DefaultHead, name: str, uv: np.ndarray) -> Surface:
    part = head.parts[name]
    rows, uv_quads = np.unique(part.uv_quads, return_inverse=True)
    return subdivided_surface(part.quads, uv[rows].astype(float), uv_quads.reshape(-1, 4), head.n_vertices)
