"""An avatar that plays an animation: pictures frame by frame."""

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from meshanim.errors import ShapeError
from meshanim.gaussians.avatar.model import Avatar
from meshanim.gaussians.cameras import Cameras
from meshanim.geometry import surface_correspondence
from meshanim.heads import HeadParameters
from meshanim.motion import MeshSequence
from meshanim.motion.blendshape_solver import BlendshapeSolver

__all__ = ["AT_ONCE", "avatar_template", "on_avatar", "play"]

AT_ONCE = 4
"""Frames that are posed and drawn together."""


def avatar_template(avatar: Avatar) -> Float[np.ndarray, "vertices 3"]:
    """Vertices of the avatar's head with its own identity, as its face rests, metres."""
    rest = avatar.head.expression(avatar.config.rest) if avatar.config.rest else None
    return _vertices(avatar, rest)


def _vertices(avatar: Avatar, expression: Tensor | None = None) -> Float[np.ndarray, "vertices 3"]:
    with torch.no_grad():
        posed = avatar.head(HeadParameters(shape=avatar.shape, expression=expression))
    return posed[0].cpu().numpy()


def on_avatar(avatar: Avatar, sequence: MeshSequence) -> Float[np.ndarray, "frames vertices 3"]:
    """An animation's zero-pose vertices on the avatar's head: its moves from rest, added to its face.

    Of another topology, the moves are carried over by surface correspondence.
    """
    template = avatar_template(avatar)
    mesh = avatar.head.mesh.with_vertices(template)
    if np.array_equal(sequence.mesh.faces, mesh.faces) and sequence.mesh.n_vertices == mesh.n_vertices:
        moves = sequence.vertices - sequence.mesh.vertices.astype(np.float32)
        return template + moves
    return surface_correspondence(sequence.mesh, mesh).carry_displacements(sequence.vertices)


def play(
    avatar: Avatar,
    sequence: MeshSequence,
    cameras: Cameras,
    background: Sequence[float] | Float[np.ndarray, "height width 3"] | None = None,
) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """Draw an animation frame by frame, head pose included.

    On heads with ARKit's shapes, colours that follow the expression get its weights, solved from the
    vertices; on others, whose jaw is a joint that vertices do not name, they stay neutral.

    Parameters
    ----------
    avatar : Avatar
        Who.
    sequence : MeshSequence
        What is played; of any identity, and any topology.
    cameras : Cameras
        (T, 1, 4, 4): one a frame.
    background : (3,) or (H, W, 3), optional
        A colour or a picture, sRGB in [0, 1]; what the avatar was fitted in front of, if not given.

    Yields
    ------
    (H, W, 3) uint8, sRGB.

    Raises
    ------
    ShapeError
        If there are not as many cameras as frames, or the background has another size.
    """
    size = (cameras.height, cameras.width, 3)
    if background is not None and np.shape(background) not in ((3,), size):
        raise ShapeError(f"background must be a colour or a picture {size}, not {np.shape(background)}")
    if cameras.world_to_camera.shape[:-2] != (len(sequence), 1):
        raise ShapeError(
            f"cameras must be ({len(sequence)}, 1, 4, 4), one a frame, not "
            f"{tuple(cameras.world_to_camera.shape)}"
        )
    return _draw(avatar, sequence, cameras, background)


def _draw(
    avatar: Avatar,
    sequence: MeshSequence,
    cameras: Cameras,
    background: Sequence[float] | Float[np.ndarray, "height width 3"] | None,
) -> Iterator[np.ndarray]:
    like = avatar.means
    behind = None
    if isinstance(background, np.ndarray) and background.ndim == 3:
        behind, background = torch.as_tensor(background).to(like), (0.0, 0.0, 0.0)
    cameras = cameras.to(like.device).to(like.dtype)
    vertices = on_avatar(avatar, sequence)
    solve = None
    if avatar.colors is not None and "jawOpen" in avatar.head.expression_names:
        solve = BlendshapeSolver.from_head(avatar.head, neutral=_vertices(avatar)).stream()
    for start in range(0, len(sequence), AT_ONCE):
        part = slice(start, start + AT_ONCE)
        parameters = None
        if solve is not None:
            parameters = HeadParameters(expression=torch.from_numpy(solve.push(vertices[part])).to(like))
        seen = Cameras(cameras.world_to_camera[part], cameras.intrinsics[part], cameras.width, cameras.height)
        with torch.no_grad():
            posed = avatar.head.pose(
                torch.from_numpy(vertices[part]).to(like),
                torch.from_numpy(sequence.pose[part]).to(like),
                avatar.shape,
            )
            drawn = avatar(posed, seen, background, parameters, depth=None)
            pictures = drawn.rgb[:, 0]
            if behind is not None:
                pictures = pictures + (1 - drawn.alpha[:, 0, ..., None]) * behind
        yield from (255 * pictures.clamp(0, 1)).round().to(torch.uint8).cpu().numpy()
