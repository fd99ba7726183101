"""`Renderer`: pictures of one person, frame after frame."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from meshanim.errors import OptionError, ShapeError
from meshanim.heads import DefaultHead
from meshanim.render.camera import Camera, portrait_camera
from meshanim.render.frame import Canvas, paint, require_native, strand_cover
from meshanim.render.lighting import STUDIO, Lighting, Quality, backdrop, quality_named
from meshanim.render.look import Appearance, strand_points
from meshanim.render.rasterizer import rasterize
from meshanim.render.scene import MOUTH_ISLAND, PART_NAMES, HeadScene

__all__ = ["RenderMaps", "Renderer", "head_camera", "head_points"]


@dataclass(frozen=True)
class RenderMaps:
    """What a picture shows, pixel by pixel.

    Parameters
    ----------
    mask : (H, W) bool
        Where the head is (without hair strands).
    depth : (H, W) float32
        Metres along the viewing axis, infinite where nothing is.
    normal : (H, W, 3) float32
        Unit surface normals in world space, zeros where nothing is.
    region : (H, W) int32
        Index into `region_names`, -1 where nothing is.
    region_names : tuple of str
    """

    mask: Bool[np.ndarray, "height width"]
    depth: Float[np.ndarray, "height width"]
    normal: Float[np.ndarray, "height width 3"]
    region: Int[np.ndarray, "height width"]
    region_names: tuple[str, ...]


class Renderer:
    """Draws one person on the default head.

    Parameters
    ----------
    head : DefaultHead
    appearance : Appearance
        From `meshanim.render.look.make_appearance`.
    width, height : int
        Pixels; ignored where a camera is given.
    quality : str or Quality
        "draft" (soft light, shadows, fewer and wider hairs) or "full" (anti-aliasing, subsurface scattering,
        hair, contact shadows).
    camera : Camera, optional
        Frames the resting head from the front, if not given.
    lighting : Lighting
    background : (H, W, 3) float32, optional
        Linear light; a grey gradient if not given.
    threads : int
        The picture does not depend on it.

    Raises
    ------
    BackendError
        If the extension is not built.
    ShapeError
        If the background does not fit the camera.
    """

    def __init__(
        self,
        head: DefaultHead,
        appearance: Appearance,
        width: int = 512,
        height: int = 512,
        quality: str | Quality = "full",
        *,
        camera: Camera | None = None,
        lighting: Lighting = STUDIO,
        background: Float[np.ndarray, "height width 3"] | None = None,
        threads: int = 2,
    ):
        require_native()
        if threads < 1:
            raise OptionError(f"threads must be at least 1, not {threads}")
        self.head = head
        self.quality = quality_named(quality)
        self.camera = camera or head_camera(appearance, width, height)
        if self.camera.orthographic:
            raise OptionError("Renderer needs a perspective camera")
        size = (self.camera.height, self.camera.width, 3)
        if background is None:
            background = backdrop(self.camera.width, self.camera.height)
        if background.shape != size:
            raise ShapeError(f"background must be {size}, not {background.shape}")
        self.background = np.ascontiguousarray(background, np.float32)
        self.lighting = lighting
        self.threads = threads
        distance = float(self.camera.to_camera(appearance.template.mean(0)[None])[0, 2])
        scale = self.camera.intrinsics[1, 1] / max(distance, self.camera.near)
        self.scene = HeadScene(appearance, scale, self.quality)
        self._stage = self.scene.stage()
        self._canvas = Canvas(self.camera.width, self.camera.height, self.quality)
        self._regions: tuple[np.ndarray, tuple[str, ...]] | None = None

    def worker(self, threads: int = 1) -> "Renderer":
        """Another renderer of the same scene with buffers of its own, for use in another thread."""
        twin = object.__new__(Renderer)
        twin.__dict__.update(self.__dict__)
        twin.threads = threads
        twin._stage = self.scene.stage()
        twin._canvas = Canvas(self.camera.width, self.camera.height, self.quality)
        return twin

    def seen_from(self, camera: Camera) -> "Renderer":
        """The same scene and buffers with another camera of the same picture size.

        Textures stay as fine as the first camera needs them.

        Raises
        ------
        OptionError
            If the camera is orthographic.
        ShapeError
            If its picture has another size.
        """
        if camera.orthographic:
            raise OptionError("Renderer needs a perspective camera")
        if (camera.width, camera.height) != (self.camera.width, self.camera.height):
            raise ShapeError(
                f"the renderer draws {self.camera.width} x {self.camera.height} pixels, the camera "
                f"{camera.width} x {camera.height}"
            )
        other = object.__new__(Renderer)
        other.__dict__.update(self.__dict__)
        other.camera = camera
        return other

    def frame(
        self,
        vertices: Float[np.ndarray, "vertices 3"],
        expression: Float[np.ndarray, " expressions"] | None = None,
    ) -> UInt8[np.ndarray, "height width 3"]:
        """Draw the head.

        Parameters
        ----------
        vertices : (V, 3) float
            Of the head, posed, metres.
        expression : (E,) float, optional
            Expression weights that drive the wrinkles (`head.expression_names`); resting wrinkles alone
            if not given.

        Returns
        -------
        (H, W, 3) uint8, sRGB.

        Raises
        ------
        ShapeError
            If an array does not fit the head or is not finite.
        """
        self._pose(vertices, expression)
        groups = (self.scene.strands.get(kind, []) for kind in self.quality.strands)
        return paint(
            self._canvas,
            self._stage.geometry,
            self._stage.parts,
            self.camera,
            self.lighting,
            self.quality,
            self.background,
            strands=[strands for group in groups for strands in group],
            mouth_plane=self._stage.mouth_plane,
            threads=self.threads,
        )

    @property
    def opacity(self) -> Float[np.ndarray, "height width"]:
        """How much of each pixel of the last frame is head or hair, in [0, 1]."""
        return self._canvas.opacity

    def strand_cover(self, kind: str = "hair") -> Float[np.ndarray, "height width"]:
        """How much of each pixel of the last frame strands of a kind cover, over skin too, in [0, 1]."""
        return strand_cover(
            self._canvas,
            self._stage.geometry,
            self.camera,
            self.lighting,
            self.quality,
            self.scene.strands.get(kind, []),
            self.threads,
        )

    def frame_regions(self) -> tuple[Int[np.ndarray, "height width"], tuple[str, ...]]:
        """What most samples of each pixel of the last frame show, hair left out.

        Returns
        -------
        region : (H, W) int
            Index into the names, -1 where nothing is.
        names : tuple of str
            As in `RenderMaps`.
        """
        labels, names = self._region_labels()
        labels = np.append(labels, -1)  # a face of -1 is none
        samples, (height, width) = self.quality.samples, self.background.shape[:2]
        face = self._canvas.face.reshape(height, samples, width, samples)
        shown = labels[face].transpose(1, 3, 0, 2).reshape(-1, height, width)
        votes = (shown[:, None] == shown[None]).sum(1)
        winner = votes.argmax(0)
        return np.take_along_axis(shown, winner[None], axis=0)[0], names

    def maps(self, vertices: Float[np.ndarray, "vertices 3"]) -> RenderMaps:
        """Mask, depth, normals and regions of the head at pixel centres, without hair and neck fade."""
        self._pose(vertices, None)
        geometry = self._stage.geometry
        buffers = rasterize(
            geometry.vertices, geometry.faces, self.camera, cull_backfaces=True, threads=self.threads
        )
        normal = buffers.interpolate(geometry.normals, geometry.faces).astype(np.float32)
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
        labels, names = self._region_labels()
        region = np.where(buffers.mask, labels[np.maximum(buffers.face, 0)], -1).astype(np.int32)
        return RenderMaps(buffers.mask, buffers.depth, normal, region, names)

    def _region_labels(self) -> tuple[np.ndarray, tuple[str, ...]]:
        if self._regions is None:
            self._regions = _face_regions(self.head, self.scene)
        return self._regions

    def _pose(self, vertices: np.ndarray, expression: np.ndarray | None) -> None:
        count, names = self.head.mesh.n_vertices, self.head.expression_names
        if vertices.shape != (count, 3) or not np.isfinite(vertices).all():
            raise ShapeError(f"vertices must be finite, ({count}, 3), not {vertices.shape}")
        if expression is not None and expression.shape != (len(names),):
            raise ShapeError(f"expression must be ({len(names)},), not {expression.shape}")
        self._stage.pose(vertices, expression, self.threads)


def head_camera(
    appearance: Appearance,
    width: int = 512,
    height: int = 512,
    azimuth: float = 0.0,
    elevation: float = 0.0,
) -> Camera:
    """A camera that frames a person's head, hair included, and cuts the neck where it fades.

    Parameters
    ----------
    appearance : Appearance
    width, height : int
        Pixels.
    azimuth, elevation : float
        Radians; positive azimuth moves the camera towards +x, positive elevation up.
    """
    return portrait_camera(head_points(appearance), width, height, azimuth, elevation, margin=0.03)


def head_points(appearance: Appearance) -> Float[np.ndarray, "points 3"]:
    """Points of the resting skin above the fading neck, and the tips of hair and beard, metres."""
    skin = appearance.surface.vertices(appearance.template)
    points = [skin[skin[:, 1] > appearance.neck_fade[:, 1].max() + 0.02]]
    for strands in appearance.strands:
        if strands.kind in ("hair", "beard") and len(strands):
            points.append(strand_points(strands, skin, appearance.surface.faces)[:, -1])
    return np.concatenate(points)


def _face_regions(head: DefaultHead, scene: HeadScene) -> tuple[np.ndarray, tuple[str, ...]]:
    """Label (F,) of each drawn face and the labels' names: the head's own regions, each vertex in one."""
    order = ("face", "jaw", "upper_face", "scalp", "neck", "nose", "ears", "eyelids", "lips")
    names = (*order, "mouth_lining", *PART_NAMES[1:])
    of_vertex = np.zeros(head.mesh.n_vertices, np.int64)
    for index, name in enumerate(order):
        of_vertex[head.regions[name]] = index
    operator = scene.appearance.surface.operator
    heaviest = np.array(
        [
            operator.indices[a:b][np.argmax(operator.data[a:b])]
            for a, b in zip(operator.indptr[:-1], operator.indptr[1:])
        ]
    )
    skin = of_vertex[heaviest][scene.appearance.surface.faces]
    labels = scene.part.astype(np.int64) + len(order)
    # A face takes the region that most of its corners have.
    labels[: len(skin)] = np.where(skin[:, 1] == skin[:, 2], skin[:, 1], skin[:, 0])
    labels[: len(skin)][scene.appearance.surface.island == MOUTH_ISLAND] = len(order)
    return labels, names
