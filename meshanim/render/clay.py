"""`render_mesh`: any triangle mesh as shaded clay, or with a colour a vertex."""

import numpy as np
from jaxtyping import Float, UInt8

from meshanim.errors import OptionError, ShapeError
from meshanim.geometry import TriangleMesh
from meshanim.render.camera import Camera, portrait_camera
from meshanim.render.frame import Canvas, Geometry, paint, require_native
from meshanim.render.lighting import STUDIO, Lighting, Quality, backdrop, quality_named

__all__ = ["render_mesh"]

CLAY = (0.56, 0.55, 0.54)


def render_mesh(
    vertices: Float[np.ndarray, "vertices 3"],
    mesh: TriangleMesh,
    camera: Camera | None = None,
    colors: Float[np.ndarray, "colored 3"] | None = None,
    *,
    quality: str | Quality = "full",
    lighting: Lighting = STUDIO,
    background: Float[np.ndarray, "height width 3"] | None = None,
    roughness: float = 0.5,
    threads: int = 2,
) -> UInt8[np.ndarray, "height width 3"]:
    """Draw a mesh with smooth normals, studio light, soft shadows and anti-aliased edges.

    Parameters
    ----------
    vertices : (V, 3) float
        Metres. Shadows and contact darkening are sized for heads.
    mesh : TriangleMesh
        The topology; its own vertices are not used.
    camera : Camera, optional
        512 x 512 around `vertices`, from the front, if not given.
    colors : (V, 3) float, optional
        sRGB in [0, 1] a vertex; grey clay if not given.
    quality : str or Quality
        "draft" or "full".
    lighting : Lighting
    background : (H, W, 3) float32, optional
        Linear light; a grey gradient if not given.
    roughness : float
        0.1 (polished) to 1 (chalk).
    threads : int
        The picture does not depend on it.

    Returns
    -------
    (H, W, 3) uint8, sRGB.

    Raises
    ------
    ShapeError
        If `vertices`, `colors` or `background` does not fit the mesh or the camera.
    BackendError
        If the extension is not built.
    """
    require_native()
    from meshanim import _native

    if vertices.shape != (mesh.n_vertices, 3) or not np.isfinite(vertices).all():
        raise ShapeError(f"vertices must be finite, ({mesh.n_vertices}, 3), not {vertices.shape}")
    if colors is not None and colors.shape != vertices.shape:
        raise ShapeError(f"colors must have shape {vertices.shape}, not {colors.shape}")
    if not 0.05 <= roughness <= 1:
        raise OptionError(f"roughness must lie in [0.05, 1], not {roughness}")
    camera = camera or portrait_camera(vertices)
    if camera.orthographic:
        raise OptionError("render_mesh needs a perspective camera")
    if background is None:
        background = backdrop(camera.width, camera.height)
    if background.shape != (camera.height, camera.width, 3):
        raise ShapeError(f"background must be ({camera.height}, {camera.width}, 3), not {background.shape}")
    chosen = quality_named(quality)
    srgb = np.broadcast_to(np.array(CLAY, np.float32), vertices.shape) if colors is None else colors
    albedo = np.clip(srgb, 0, 1).astype(np.float32) ** np.float32(2.2)
    geometry = Geometry(mesh.faces, mesh.n_vertices, colors=albedo)
    geometry.vertices[:] = vertices
    geometry.update_normals(threads)
    part = _native.Part(0, False, roughness, 1.0)
    return paint(
        Canvas(camera.width, camera.height, chosen),
        geometry,
        [part],
        camera,
        lighting,
        chosen,
        np.ascontiguousarray(background, np.float32),
        cull_backfaces=False,
        threads=threads,
    )
