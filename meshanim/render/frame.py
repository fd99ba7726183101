"""The stages that turn posed geometry with materials into a picture, in the compiled kernels."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, Integer

from meshanim.errors import BackendError
from meshanim.render.camera import Camera, orthographic_camera
from meshanim.render.lighting import Lighting, Quality
from meshanim.render.rasterizer import native_available, native_view

__all__ = ["Canvas", "Geometry", "paint", "require_native", "strand_cover"]

WIDE_SHARE = 0.4
SCATTER_METRES = np.array([[0.0019, 0.0008, 0.0005], [0.0006, 0.0003, 0.0002]])
"""Standard deviations of the wide and narrow blur for red, green and blue."""


def require_native() -> None:
    """BackendError with what to do if the compiled renderer is missing."""
    if not native_available():
        raise BackendError(
            "rendering needs the compiled extension: reinstall meshanim where a C++17 compiler is"
        )


class Geometry:
    """Vertices and normals of everything in the picture, written in place frame by frame.

    Parameters
    ----------
    faces : (F, 3) int
    n_vertices : int
    part : (F,) int
        Which material each face has.
    corner_uv : (F, 3, 2) float32, optional
    sky : (V,) float32, optional
        Share of the sky that each vertex sees.
    fade : (V,) float32, optional
        Opacity.
    colors : (V, 3) float32, optional
        Linear albedo of parts with vertex colours.
    """

    def __init__(
        self,
        faces: Int[np.ndarray, "faces 3"],
        n_vertices: int,
        part: Integer[np.ndarray, " faces"] | None = None,
        corner_uv: Float[np.ndarray, "faces 3 2"] | None = None,
        sky: Float[np.ndarray, " vertices"] | None = None,
        fade: Float[np.ndarray, " vertices"] | None = None,
        colors: Float[np.ndarray, "vertices 3"] | None = None,
    ):
        from meshanim import _native

        count = len(faces)
        ones = np.ones(n_vertices, np.float32)
        self.faces = np.ascontiguousarray(faces, np.int32)
        self.vertices = np.zeros((n_vertices, 3), np.float32)
        self.normals = np.zeros((n_vertices, 3), np.float32)
        self.part = np.zeros(count, np.uint8) if part is None else np.ascontiguousarray(part, np.uint8)
        order = np.argsort(self.faces.ravel(), kind="stable")
        self._incident = np.ascontiguousarray(order // 3, np.int32)
        counts = np.bincount(self.faces.ravel(), minlength=n_vertices)
        self._incident_start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
        self._face_normals = np.zeros((count, 3), np.float32)
        self.native = _native.RenderMesh(
            self.vertices,
            self.normals,
            self.faces,
            self.part,
            np.zeros((count, 3, 2), np.float32) if corner_uv is None else np.ascontiguousarray(corner_uv),
            ones if sky is None else np.ascontiguousarray(sky, np.float32),
            ones if fade is None else np.ascontiguousarray(fade, np.float32),
            None if colors is None else np.ascontiguousarray(colors, np.float32),
        )

    def update_normals(self, threads: int) -> None:
        """Area-weighted normals of the vertices as they now stand."""
        from meshanim import _native

        _native.vertex_normals(
            self.vertices,
            self.faces,
            self._incident_start,
            self._incident,
            self._face_normals,
            self.normals,
            threads,
        )


class Canvas:
    """Buffers of one picture size, used again for each frame; not for two threads at a time."""

    def __init__(self, width: int, height: int, quality: Quality):
        visible = (height * quality.samples, width * quality.samples)
        self.face = np.empty(visible, np.int32)
        self.depth = np.empty(visible, np.float32)
        self.planes = np.empty((11, height, width), np.float32)
        self.near = np.empty((height, width), np.float32)
        self.scratch = np.empty((4, height, width), np.float32)
        self._shadow = np.empty(0, np.float32)
        self._shadow_face = np.empty(0, np.int32)

    def shadow_buffers(self, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
        """Face and depth buffers of a shadow map."""
        if self._shadow.size < height * width:
            self._shadow = np.empty(height * width, np.float32)
            self._shadow_face = np.empty(height * width, np.int32)
        shape = (height, width)
        return (
            self._shadow_face[: height * width].reshape(shape),
            self._shadow[: height * width].reshape(shape),
        )

    @property
    def opacity(self) -> Float[np.ndarray, "height width"]:
        """How much of each pixel is covered, of the last frame."""
        return np.clip(self.planes[10], 0, 1)


@dataclass(frozen=True)
class _Shadow:
    camera: Camera
    map: np.ndarray


def _shadow_map(
    canvas: Canvas, geometry: Geometry, lighting: Lighting, pixel: float, threads: int
) -> _Shadow:
    from meshanim import _native

    camera = orthographic_camera(geometry.vertices, lighting.key_direction, pixel)
    face, depth = canvas.shadow_buffers(camera.height, camera.width)
    _native.rasterize(
        geometry.vertices, geometry.faces, native_view(camera), False, face, depth, None, threads
    )
    return _Shadow(camera, depth)


def paint(
    canvas: Canvas,
    geometry: Geometry,
    parts: Sequence,
    camera: Camera,
    lighting: Lighting,
    quality: Quality,
    background: Float[np.ndarray, "height width 3"],
    strands: Sequence = (),
    mouth_plane: Float[np.ndarray, " 4"] | None = None,
    cull_backfaces: bool = True,
    threads: int = 2,
) -> np.ndarray:
    """Visibility, shadow map, shading, scattering, strands, tone curve: an image (H, W, 3) uint8.

    Parameters
    ----------
    canvas : Canvas
        Of the camera's size and the same quality.
    geometry : Geometry
        Posed; normals up to date.
    parts : sequence of meshanim._native.Part
        Materials in the order of `Geometry.part`.
    background : (H, W, 3) float32
        Linear light.
    strands : sequence of meshanim._native.Strands
        Drawn one after the other.
    mouth_plane : (4,) float32, optional
        Gives metres behind the closed lips for a point (x, y, z, 1).
    cull_backfaces : bool
        Leave out what is seen from inside; drawn dark otherwise.
    """
    from meshanim import _native

    fine = camera.scaled(quality.samples) if quality.samples > 1 else camera
    _native.rasterize(
        geometry.vertices,
        geometry.faces,
        native_view(fine),
        cull_backfaces,
        canvas.face,
        canvas.depth,
        None,
        threads,
    )
    shadow = _shadow_map(canvas, geometry, lighting, quality.shadow_pixel, threads)
    scale = camera.intrinsics[1, 1] / _distance(canvas.depth)
    settings = quality.native(scale)
    if mouth_plane is not None:
        settings.set_mouth_plane(np.ascontiguousarray(mouth_plane, np.float32))
    view, light, lamp = native_view(camera), native_view(shadow.camera), lighting.native()
    _native.shade(
        geometry.native,
        list(parts),
        view,
        lamp,
        settings,
        canvas.face,
        canvas.depth,
        light,
        shadow.map,
        canvas.planes,
        canvas.near,
        threads,
    )
    if quality.scatter:
        sigma = np.ascontiguousarray(SCATTER_METRES * scale, np.float32)
        _native.scatter(canvas.planes, canvas.near, sigma, WIDE_SHARE, canvas.scratch, threads)
    for group in strands:
        _native.draw_strands(
            geometry.native,
            group,
            view,
            lamp,
            light,
            shadow.map,
            canvas.depth,
            quality.samples,
            canvas.planes,
            threads,
        )
    image = np.empty((camera.height, camera.width, 3), np.uint8)
    _native.develop(canvas.planes, background, image, threads)
    return image


def strand_cover(
    canvas: Canvas,
    geometry: Geometry,
    camera: Camera,
    lighting: Lighting,
    quality: Quality,
    strands: Sequence,
    threads: int = 2,
) -> Float[np.ndarray, "height width"]:
    """How much of each pixel of the picture last painted on `canvas` some strands cover, in [0, 1]."""
    from meshanim import _native

    view, lamp = native_view(camera), lighting.native()
    planes = np.zeros_like(canvas.planes)
    for group in strands:
        _native.draw_strands(
            geometry.native, group, view, lamp, view, None, canvas.depth, quality.samples, planes, threads
        )
    return np.clip(planes[10], 0, 1)


def _distance(depth: np.ndarray) -> float:
    """Median distance of what is seen, from every fourth row and column."""
    some = depth[::4, ::4]
    some = some[np.isfinite(some)]
    return float(np.median(some)) if some.size else 1.0
