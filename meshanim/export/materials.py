"""A person's look as glTF materials: painted skin, eyes with irises, teeth, tongue."""

import io

import numpy as np
from jaxtyping import Float
from PIL import Image

from meshanim.export.gltf import GltfMaterial
from meshanim.heads import DefaultHead
from meshanim.render.look import Appearance, Eye
from meshanim.render.look.eyes import IRIS_ANGLE, SCLERA_ANGLE
from meshanim.render.look.paint import smoothstep

__all__ = ["eye_texture", "eye_uv", "gltf_materials"]

TOOTH, TONGUE = (0.75, 0.68, 0.56, 1.0), (0.45, 0.13, 0.12, 1.0)


def gltf_materials(head: DefaultHead, appearance: Appearance, size: int = 1024) -> list[GltfMaterial]:
    """One material a part; lashes are left out, which only strands can draw.

    Parameters
    ----------
    head : DefaultHead
    appearance : Appearance
        Of the person.
    size : int
        Pixels along one side of the skin's texture, at most that of the appearance.
    """
    albedo = Image.fromarray(_srgb(appearance.skin[..., :3])).resize((size, size), Image.Resampling.LANCZOS)
    skin = GltfMaterial("skin", _faces(head, "skin"), (1, 1, 1, 1), _jpeg(albedo), 0.55)
    eyes = [
        GltfMaterial(
            name,
            _faces(head, name),
            (1, 1, 1, 1),
            _jpeg(Image.fromarray(eye_texture(eye))),
            0.1,
            eye_uv(eye, head.n_vertices),
        )
        for name, eye in zip(("left_eye", "right_eye"), appearance.eyes)
    ]
    teeth = np.concatenate([_faces(head, "upper_teeth"), _faces(head, "lower_teeth")])
    return [
        skin,
        *eyes,
        GltfMaterial("teeth", teeth, TOOTH, roughness=0.2),
        GltfMaterial("tongue", _faces(head, "tongue"), TONGUE, roughness=0.35),
    ]


def eye_uv(eye: Eye, n_vertices: int) -> Float[np.ndarray, "vertices 2"]:
    """Texture coordinates of an eyeball: equidistant around the gaze, the far pole at distance one half."""
    direction = (eye.rest - eye.center) / np.linalg.norm(eye.rest - eye.center, axis=1, keepdims=True)
    theta = np.arccos(np.clip(direction[:, 2], -1, 1))
    phi = np.arctan2(direction[:, 1], direction[:, 0])
    uv = np.zeros((n_vertices, 2))
    uv[eye.anchors] = 0.5 + 0.5 * (theta / np.pi)[:, None] * np.stack([np.cos(phi), np.sin(phi)], 1)
    return uv


def eye_texture(eye: Eye, size: int = 512) -> np.ndarray:
    """Iris and sclera in the layout of `eye_uv`, (S, S, 3) uint8 sRGB, row 0 at v = 1."""
    axis = (np.arange(size) + 0.5) / size * 2 - 1
    x, y = np.meshgrid(axis, -axis)
    theta = np.pi * np.hypot(x, y)
    turn = (np.arctan2(y, x) + np.pi) / (2 * np.pi)
    iris = _polar(eye.material.iris, np.sin(np.minimum(theta, np.pi / 2)) / np.sin(IRIS_ANGLE), turn)
    sclera = _polar(eye.material.sclera, theta / SCLERA_ANGLE, turn)
    outside = smoothstep(0.90, 1.10, theta / IRIS_ANGLE)[..., None]
    return _srgb(iris * (1 - outside) + sclera * outside)


def _polar(texture: np.ndarray, radius: np.ndarray, turn: np.ndarray) -> np.ndarray:
    rows = np.clip((radius * len(texture)).astype(int), 0, len(texture) - 1)
    columns = (turn * texture.shape[1]).astype(int) % texture.shape[1]
    return texture[rows, columns]


def _faces(head: DefaultHead, part: str) -> np.ndarray:
    return np.arange(head.mesh.n_faces)[head.parts[part].faces]


def _srgb(linear: np.ndarray) -> np.ndarray:
    return np.round(255 * np.clip(linear, 0, 1) ** (1 / 2.2)).astype(np.uint8)


def _jpeg(image: Image.Image) -> bytes:
    file = io.BytesIO()
    image.save(file, "JPEG", quality=90)
    return file.getvalue()
