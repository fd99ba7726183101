"""`Atlas`: for each texel of the skin texture, where on the head it lies; painting is a function of that."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt

from meshanim.geometry import TriangleMesh, rasterize_uv
from meshanim.render.look.surface import Surface, vertex_normals

__all__ = ["Atlas", "atlas_positions", "build_atlas", "corner_values"]

PADDING = 4
"""Texels painted beyond each island's edge, so that bilinear look-ups never reach an unpainted one."""


@dataclass(frozen=True)
class Atlas:
    """The painted texels of an S x S skin texture; n of them are active.

    Positions are those of the mean shape at rest: textures are painted in this canonical space and follow
    every identity and expression through the mesh.

    Parameters
    ----------
    size : int
        S.
    active : (S, S) bool
        Texels within `PADDING` of the layout.
    triangle : (n,) int32
        Triangle of the skin surface under each active texel (row by row).
    barycentric : (n, 3) float32
    position : (n, 3) float32
        Metres.
    normal : (n, 3) float32
    island : (n,) int32
    masks : dict of str to (n,) float32
        `lips`, `eyelids`, `ears`, `mouth` (the inside), in [0, 1].
    """

    size: int
    active: Bool[np.ndarray, "size size"]
    triangle: Int[np.ndarray, " texels"]
    barycentric: Float[np.ndarray, "texels 3"]
    position: Float[np.ndarray, "texels 3"]
    normal: Float[np.ndarray, "texels 3"]
    island: Int[np.ndarray, " texels"]
    masks: dict[str, Float[np.ndarray, " texels"]]

    def image(self, values: np.ndarray, fill: float = 0.0) -> Float[np.ndarray, "size size *channels"]:
        """Put one row a texel into a float32 texture."""
        texture = np.full((self.size, self.size, *np.shape(values)[1:]), fill, np.float32)
        texture[self.active] = values
        return texture


def atlas_positions(
    surface: Surface, size: int
) -> tuple[Bool[np.ndarray, "size size"], Int[np.ndarray, " texels"], Float[np.ndarray, "texels 3"]]:
    """Active texels of a surface's layout, and the triangle and barycentric weights of each.

    Texels of the padding take those of the nearest covered one.
    """
    n_faces = len(surface.faces)
    layout = TriangleMesh(
        np.zeros((int(surface.faces.max()) + 1, 3)),
        surface.faces,
        surface.corner_uv.reshape(-1, 2),
        np.arange(3 * n_faces).reshape(-1, 3),
    )
    face, weights = rasterize_uv(layout, size)
    distance, nearest = distance_transform_edt(face < 0, return_indices=True)
    active = distance < PADDING
    row, column = nearest[0][active], nearest[1][active]
    return active, face[row, column].astype(np.int32), weights[row, column].astype(np.float32)


def corner_values(values: np.ndarray, corners: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Interpolate vertex values (N, ...) at points given by corner indices (n, 3) and weights (n, 3)."""
    return np.einsum("nk...,nk->n...", values[corners], weights)


def build_atlas(
    surface: Surface,
    head_vertices: Float[np.ndarray, "head_vertices 3"],
    masks: dict[str, Float[np.ndarray, " head_vertices"]],
    size: int = 1024,
) -> Atlas:
    """Find the point of the resting mean head under every texel.

    Parameters
    ----------
    surface : Surface
        The skin.
    head_vertices : (V, 3) float
        The mean shape at rest, metres.
    masks : dict of str to (V,) float
        Weights in [0, 1] on the head's vertices.
    size : int
        Texels along one side of the texture.
    """
    active, triangle, weights = atlas_positions(surface, size)
    vertices = surface.vertices(head_vertices)
    corners = surface.faces[triangle]
    normal = corner_values(vertex_normals(vertices, surface.faces).astype(np.float32), corners, weights)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return Atlas(
        size,
        active,
        triangle,
        weights,
        corner_values(vertices, corners, weights),
        normal,
        surface.island[triangle],
        {
            name: corner_values(surface.operator @ np.asarray(mask, np.float32), corners, weights)
            for name, mask in masks.items()
        },
    )
