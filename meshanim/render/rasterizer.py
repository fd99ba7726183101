"""`rasterize`: which triangle each pixel sees, where in it, and how far away."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from meshanim.errors import BackendError, MeshError, OptionError, ShapeError
from meshanim.render.camera import Camera

__all__ = ["RasterBuffers", "native_available", "rasterize"]

SUBPIXEL = 1024


@dataclass(frozen=True)
class RasterBuffers:
    """What a camera sees of a mesh.

    Parameters
    ----------
    face : (H, W) int32
        Index of the nearest face, -1 where there is none.
    barycentric : (H, W, 3) float32
        Where in that face, perspective-correct; zeros where there is none.
    depth : (H, W) float32
        Metres along the viewing axis; infinite where there is none.
    """

    face: Int[np.ndarray, "height width"]
    barycentric: Float[np.ndarray, "height width 3"]
    depth: Float[np.ndarray, "height width"]

    @property
    def mask(self):
        """(H, W) bool: where there is a face."""
        return self.face >= 0

    def interpolate(self, values, faces) -> np.ndarray:
        """Per-vertex `values` (V, C) of the mesh `faces` (F, 3) at each pixel: (H, W, C), zeros outside."""
        corners = np.asarray(values)[np.asarray(faces)[np.maximum(self.face, 0)]]
        return (corners * self.barycentric[..., None]).sum(-2)


def native_available() -> bool:
    """Whether the compiled renderer is there."""
    try:
        from meshanim import _native
    except ImportError:
        return False
    return hasattr(_native, "rasterize")


def native_view(camera: Camera):
    from meshanim import _native

    c = camera
    return _native.View(c.world_to_camera, c.intrinsics, c.width, c.height, c.near, c.orthographic)


def rasterize(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    camera: Camera,
    *,
    cull_backfaces: bool = False,
    threads: int = 2,
    backend: str = "auto",
) -> RasterBuffers:
    """Z-buffer a triangle mesh.

    A pixel belongs to a triangle if its centre lies inside, by the top-left rule on coordinates rounded to
    1/1024 pixel: triangles that share an edge neither overlap nor leave a gap. Triangles are clipped at the
    near plane. Of equally near faces the one with the lower index wins. Faces with a vertex that is not
    finite are left out.

    Parameters
    ----------
    vertices : (V, 3) float
        World space, metres.
    faces : (F, 3) int
        Vertex indices, counter-clockwise seen from outside.
    camera : Camera
    cull_backfaces : bool
        Leave out faces seen from inside.
    threads : int
        For the native backend; the result does not depend on it.
    backend : str
        "native", "reference" (NumPy, slow) or "auto": native where it is built.

    Raises
    ------
    ShapeError, MeshError
        If an array has another shape, or a face names a vertex that does not exist.
    BackendError
        If "native" is asked for and not built.
    """
    vertices = np.ascontiguousarray(vertices, np.float32)
    faces = np.ascontiguousarray(faces, np.int32)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise ShapeError(f"vertices and faces must be (n, 3), not {vertices.shape} and {faces.shape}")
    if faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise MeshError(f"faces name vertices {faces.min()}..{faces.max()}, but there are {len(vertices)}")
    if threads < 1:
        raise OptionError(f"threads must be at least 1, not {threads}")
    if backend not in ("auto", "native", "reference"):
        raise OptionError(f"backend must be auto, native or reference, not '{backend}'")
    if backend == "auto":
        backend = "native" if native_available() else "reference"
    if backend == "native" and not native_available():
        raise BackendError("the native rasteriser is not built: reinstall meshanim with a C++17 compiler")
    if backend == "reference":
        from meshanim.render.reference import rasterize_reference

        return RasterBuffers(*rasterize_reference(vertices, faces, camera, cull_backfaces))
    from meshanim import _native

    shape = (camera.height, camera.width)
    buffers = RasterBuffers(
        np.empty(shape, np.int32), np.empty((*shape, 3), np.float32), np.empty(shape, np.float32)
    )
    _native.rasterize(
        vertices,
        faces,
        native_view(camera),
        cull_backfaces,
        buffers.face,
        buffers.depth,
        buffers.barycentric,
        threads,
    )
    return buffers
