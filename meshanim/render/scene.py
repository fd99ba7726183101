"""`HeadScene`: one person's surfaces and materials, prepared once; `HeadStage`: a pose of them."""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int
from scipy.ndimage import gaussian_filter

from meshanim.render.frame import Geometry
from meshanim.render.lighting import Quality
from meshanim.render.look import Appearance, eye_mesh
from meshanim.render.look.eyes import similarity
from meshanim.render.look.paint import smoothstep

__all__ = ["PART_NAMES", "HeadScene", "HeadStage"]

PART_NAMES = ("skin", "tongue", "upper_teeth", "lower_teeth", "left_eye", "right_eye")
MOUTH_ISLAND, NECK_ISLAND = 1, 4
"""Pieces of the skin's texture layout, the face being 0; 2 and 3 line the eye sockets."""
SKIN, TONGUE, TEETH, EYES = 0, 1, (2, 3), (4, 5)

MOUTH_LINING = (1.0, 0.065, 0.30, 1.0)
TONGUE_DARKENING = (0.90, 0.055, 0.14, 1.0)
TEETH_DARKENING = (1.05, 0.040, 0.14, 1.2)
"""How light falls off behind the lips: start, length in metres, floor, power."""

DETAIL_TILES = 22
WIDEST_STRAND = 0.00125
"""Metres, of a strand that stands for its neighbours."""


class HeadScene:
    """Everything about a person that no pose changes, at one texture resolution.

    Parameters
    ----------
    appearance : Appearance
    pixels_per_metre : float
        Scale of the picture at the head; textures are reduced to fit it.
    quality : Quality
    """

    def __init__(self, appearance: Appearance, pixels_per_metre: float, quality: Quality):
        self.appearance = appearance
        surfaces = (appearance.surface, appearance.tongue)
        operator = sp.csr_array(sp.vstack([surface.operator for surface in surfaces]))
        self._operator = (
            operator.indptr.astype(np.int32),
            operator.indices.astype(np.int32),
            operator.data.astype(np.float32),
        )
        self.n_surface = operator.shape[0]
        self._eye_vertices, eye_faces = eye_mesh()
        counts = [surface.operator.shape[0] for surface in surfaces]
        counts += [len(jaw.vertices) for jaw in appearance.teeth] + 2 * [len(self._eye_vertices)]
        self.starts = np.concatenate([[0], np.cumsum(counts)])
        faces = [surface.faces for surface in surfaces] + [jaw.faces for jaw in appearance.teeth]
        faces += [eye_faces, eye_faces]
        corner_uv = [surface.corner_uv for surface in surfaces]
        corner_uv += [jaw.uv[jaw.faces] for jaw in appearance.teeth] + 2 * [np.zeros((len(eye_faces), 3, 2))]
        self.faces = np.concatenate([part + start for part, start in zip(faces, self.starts)])
        self.faces = np.ascontiguousarray(self.faces, np.int32)
        self.part = np.repeat(np.arange(6), [len(part) for part in faces]).astype(np.uint8)
        self.corner_uv = np.concatenate(corner_uv).astype(np.float32)
        rest = surfaces[0].vertices(appearance.template)
        self.sky = np.ones(self.starts[-1], np.float32)
        self.sky[: counts[0]] = _sky(appearance)
        self.fade = np.ones(self.starts[-1], np.float32)
        self.fade[: counts[0]] = _neck_opacity(rest, appearance.neck_fade)

        density = _texel_density(rest, appearance)
        level = np.log2(max(density / (pixels_per_metre * quality.texture_scale), 1e-6))
        self.level = int(np.clip(np.floor(level + 0.5), 0, 3))
        self.skin = _reduced(appearance.skin, self.level)
        self.relief = _reduced(_slopes(appearance.height), self.level)
        self.folds = [_fold(patch, len(appearance.height), self.level) for patch in appearance.wrinkles.maps]
        tile = appearance.detail.shape[0] * DETAIL_TILES / len(appearance.height)
        detail_level = np.log2(max(density * tile / pixels_per_metre, 1.0))
        self.detail = _reduced(appearance.detail, int(min(detail_level, 5)))
        self.detail_gain = float(np.clip((pixels_per_metre / 1000 - 1.2) / 2.5, 0, 1))
        self.lids = [_lids(appearance, side, rest) for side in (0, 1)]
        self.strands = _native_strands(appearance, quality.strand_step)

    def stage(self) -> "HeadStage":
        """A pose of this scene with buffers of its own, for one thread of frames."""
        return HeadStage(self)


class HeadStage:
    """Posed geometry and materials of a scene; `pose` before each picture."""

    def __init__(self, scene: HeadScene):
        from meshanim import _native

        self.scene = scene
        self.geometry = Geometry(
            scene.faces, int(scene.starts[-1]), scene.part, scene.corner_uv, scene.sky, scene.fade
        )
        appearance = scene.appearance
        self._relief = scene.relief.copy()
        skin = _native.Part(2, True, 0.5, 1.0)
        tongue = _native.Part(2, True, 0.4, 1.0)
        for part, darkening in ((skin, MOUTH_LINING), (tongue, TONGUE_DARKENING)):
            part.set_texture(scene.skin)
            part.set_slopes(self._relief)
            part.set_detail(scene.detail, scene.detail_gain)
            part.set_mouth(*darkening)
        self.parts = [skin, tongue]
        for jaw in appearance.teeth:
            part = _native.Part(1, False, 0.2, 1.3)
            part.set_texture(np.ascontiguousarray(jaw.texture, np.float32))
            part.set_mouth(*TEETH_DARKENING)
            self.parts.append(part)
        for eye in appearance.eyes:
            part = _native.Part(3, False, eye.material.roughness, 1.0)
            part.set_eye(eye.material.iris, eye.material.sclera)
            self.parts.append(part)
        self.mouth_plane = np.zeros(4, np.float32)

    def pose(
        self,
        head_vertices: Float[np.ndarray, "head_vertices 3"],
        expression: Float[np.ndarray, " expressions"] | None = None,
        threads: int = 1,
    ) -> None:
        """Move everything to the head's vertices (metres); `expression` weights drive the wrinkles."""
        from meshanim import _native

        scene, appearance = self.scene, self.scene.appearance
        head_vertices = np.ascontiguousarray(head_vertices, np.float32)
        vertices = self.geometry.vertices
        _native.apply_operator(*scene._operator, head_vertices, vertices[: scene.n_surface], threads)
        for part, jaw in zip(TEETH, appearance.teeth):
            scale, rotation, translation = similarity(jaw.rest, head_vertices[jaw.anchors])
            turned = jaw.vertices @ (scale * rotation.T).astype(np.float32)
            vertices[scene.starts[part] : scene.starts[part + 1]] = turned + translation.astype(np.float32)
            if part == TEETH[0]:
                # The upper jaw moves with the skull: it tells how far behind the lips a point lies.
                forward = rotation[:, 2] / scale
                self.mouth_plane[:3] = -forward
                self.mouth_plane[3] = appearance.mouth_front + translation @ forward
        for side, part in enumerate(EYES):
            eye = appearance.eyes[side]
            scale, rotation, translation = similarity(eye.rest, head_vertices[eye.anchors])
            center = (scale * rotation @ eye.center + translation).astype(np.float32)
            turn, radius = rotation.astype(np.float32), np.float32(scale * eye.radius)
            turned = scene._eye_vertices @ (radius * turn.T)
            vertices[scene.starts[part] : scene.starts[part + 1]] = turned + center
            self.parts[part].set_pose(center, float(radius), np.ascontiguousarray(turn))
            upper, lower = (lid.points(vertices) for lid in scene.lids[side])
            self.parts[part].set_lids(upper, lower)
        self.geometry.update_normals(threads)
        self._fold(expression)

    def _fold(self, expression) -> None:
        from meshanim import _native

        wrinkles = self.scene.appearance.wrinkles
        if expression is None:
            expression = np.zeros(wrinkles.drive.shape[1], np.float32)
        np.copyto(self._relief, self.scene.relief)
        for fold, amplitude in zip(self.scene.folds, wrinkles.amplitudes(expression)):
            if abs(amplitude) > 1e-3:
                _native.add_patch(self._relief, fold.slopes, fold.row, fold.column, float(amplitude))


@dataclass(frozen=True)
class _Fold:
    row: int
    column: int
    slopes: np.ndarray


@dataclass(frozen=True)
class _Lid:
    """Points along a lid's margin, on triangles of the skin."""

    corners: Int[np.ndarray, "points 3"]
    weights: Float[np.ndarray, "points 3"]

    def points(self, vertices: np.ndarray) -> Float[np.ndarray, "points 3"]:
        return np.ascontiguousarray(np.einsum("nkd,nk->nd", vertices[self.corners], self.weights))


def _sky(appearance: Appearance) -> np.ndarray:
    """Ambient share a vertex: the mouth's lining is darkened by depth instead."""
    surface = appearance.surface
    open_sky = 0.10 + 0.90 * np.clip(1.12 * appearance.sky, 0, 1) ** 1.15
    cavity = np.zeros(len(open_sky), bool)
    cavity[surface.faces[surface.island == MOUTH_ISLAND]] = True
    cavity[surface.faces[surface.island != MOUTH_ISLAND]] = False
    return np.where(cavity, 1.0, open_sky).astype(np.float32)


def _neck_opacity(rest: np.ndarray, loop: np.ndarray) -> np.ndarray:
    """1 on the head, falling to 0 over 26 mm above the neck's cut."""
    height = np.maximum.accumulate(loop[::-1, 1])[::-1]
    above = rest[:, 1] - np.interp(rest[:, 2], loop[:, 0], height)
    return smoothstep(0.0, 0.026, above).astype(np.float32)


def _texel_density(rest: np.ndarray, appearance: Appearance) -> float:
    """Texels a metre on the front of the face."""
    surface = appearance.surface
    corners = rest[surface.faces]
    front = (surface.island == 0) & (corners[:, :, 2].mean(1) > 0.02)
    uv = surface.corner_uv[front] * len(appearance.height)
    flat = np.abs(np.linalg.det(np.stack([uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]], 1)))
    edges = corners[front, 1:] - corners[front, :1]
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    return float(np.sqrt(flat.sum() / max(area.sum(), 1e-12)))


def _reduced(texture: np.ndarray, level: int) -> np.ndarray:
    """Averaged over squares of 2^level texels."""
    texture = np.asarray(texture, np.float32)
    for _ in range(level):
        texture = 0.25 * (texture[::2, ::2] + texture[1::2, ::2] + texture[::2, 1::2] + texture[1::2, 1::2])
    return np.ascontiguousarray(texture)


def _slopes(height: np.ndarray, size: int | None = None, cavity: bool = False) -> np.ndarray:
    """(d/du, d/dv, how far below its surroundings, 0) of a height map in metres; row 0 is v = 1."""
    size = size or height.shape[0]
    down, right = np.gradient(height)
    hollow = gaussian_filter(height, 2.0) - height if cavity else np.zeros_like(height)
    return np.stack([right * size, -down * size, hollow, np.zeros_like(height)], axis=-1).astype(np.float32)


def _fold(patch, size: int, level: int) -> _Fold:
    """Slopes of a wrinkle group, with a border for the gradient, aligned to the reduced texture."""
    step, border = 1 << level, 10
    rows, columns = patch.height.shape
    top, left = (max(0, start - border) // step * step for start in (patch.row, patch.column))
    bottom, right = (
        min(size, -(-(start + length + border) // step) * step)
        for start, length in ((patch.row, rows), (patch.column, columns))
    )
    height = np.zeros((bottom - top, right - left), np.float32)
    height[patch.row - top : patch.row - top + rows, patch.column - left : patch.column - left + columns] = (
        patch.height
    )
    return _Fold(top // step, left // step, _reduced(_slopes(height, size, cavity=True), level))


def _lids(appearance: Appearance, side: int, rest: np.ndarray, count: int = 20) -> tuple[_Lid, _Lid]:
    """Margins of the upper and lower lid of one eye: where the lashes are rooted."""
    sign = np.sign(appearance.eyes[side].center[0])
    lids = []
    for lashes in (group for group in appearance.strands if group.kind == "lash" and len(group)):
        corners = appearance.surface.faces[lashes.triangle]
        root = np.einsum("nkd,nk->nd", rest[corners], lashes.barycentric)
        if np.sign(root[:, 0].mean()) != sign:
            continue
        order = np.argsort(root[:, 0], kind="stable")
        chosen = order[np.unique(np.linspace(0, len(order) - 1, count).round().astype(int))]
        lids.append((root[:, 1].mean(), _Lid(corners[chosen], lashes.barycentric[chosen])))
    if len(lids) != 2:
        nothing = _Lid(np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32))
        return nothing, nothing
    lids.sort(key=lambda pair: pair[0], reverse=True)
    return lids[0][1], lids[1][1]


def _native_strands(appearance: Appearance, step: int) -> dict[str, list]:
    """The kernels' form of the strands, by kind; every `step`-th hair stands for its neighbours."""
    from meshanim import _native

    groups: dict[str, list] = {}
    for strands in appearance.strands:
        every = step if strands.kind in ("hair", "beard") else 1
        arrays = {
            name: getattr(strands, name)[::every]
            for name in ("triangle", "barycentric", "offsets", "normals", "occlusion", "width", "color")
        }
        if every > 1:  # wider ones cost more than they cover
            arrays["width"] = np.minimum(arrays["width"] * every**0.8, WIDEST_STRAND)
        if not len(arrays["width"]):
            continue
        native = _native.Strands(
            *(
                np.ascontiguousarray(array, np.int32 if name == "triangle" else np.float32)
                for name, array in arrays.items()
            )
        )
        groups.setdefault(strands.kind, []).append(native)
    return groups
