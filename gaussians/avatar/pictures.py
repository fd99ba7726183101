"""The pictures that an avatar is fitted to, kept in memory as far as that goes."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from meshanim.datasets.capture import Capture
from meshanim.errors import OptionError
from meshanim.gaussians.cameras import Cameras

__all__ = ["PictureStore", "backdrop", "scene_radius"]

KEPT = 6 << 30
"""Bytes of decoded pictures that stay in memory."""
BACKDROPS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}


def backdrop(capture: Capture, wanted: str) -> tuple[tuple[float, float, float], bool]:
    """What is behind the head, and whether pictures must be put in front of it by their masks.

    Parameters
    ----------
    capture : Capture
        Whose.
    wanted : "auto", "white" or "black"
        auto: the capture's own where it is plain; else white where there are masks.

    Raises
    ------
    OptionError
        If there is neither a plain background nor masks.
    """
    if wanted == "auto" and capture.background is not None:
        return capture.background, False
    if wanted not in ("auto", *BACKDROPS):
        raise OptionError(f"no background '{wanted}'; there are auto, {', '.join(BACKDROPS)}")
    if capture[0].mask is None:
        raise OptionError(
            f"{capture.directory} has no masks, so the head cannot be told from what is behind it: "
            "add masks/, or state the colour of a plain background in capture.json"
        )
    return BACKDROPS["white" if wanted == "auto" else wanted], True


def scene_radius(capture: Capture) -> float:
    """1.1 times the largest distance of a camera from the mean of all, metres (3D Gaussian Splatting)."""
    poses = capture.cameras()[0]
    positions = -np.einsum("cji,cj->ci", poses[:, :3, :3], poses[:, :3, 3])
    return 1.1 * float(np.linalg.norm(positions - positions.mean(0), axis=1).max())


class PictureStore:
    """Pictures of a capture with their cameras, decoded once while memory lasts.

    Parameters
    ----------
    capture : Capture
        Whose.
    behind : (3,) float, optional
        Colour that pictures are put in front of by their masks; as they are if not given.
    """

    def __init__(self, capture: Capture, behind: tuple[float, float, float] | None = None):
        self.capture, self.behind = capture, behind
        self._kept: dict[tuple[int, bool], Tensor] = {}
        self._bytes = 0

    def image(self, index: int, half: bool = False) -> Float[Tensor, "height width 3"]:
        """The picture of `capture.views[index]`, sRGB in [0, 1]; at half its size if wanted."""
        image = self._kept.get((index, half))
        if image is None:
            image = self._decoded(index, half)
            if self._bytes + image.numel() <= KEPT:
                self._kept[index, half] = image
                self._bytes += image.numel()
        return image.float().div_(255)

    def cameras(self, index: int, half: bool = False) -> Cameras:
        """The camera of a picture."""
        view = self.capture.views[index]
        view = view.scaled(0.5) if half else view
        pose, intrinsics = (
            torch.from_numpy(m).float()[None] for m in (view.world_to_camera, view.intrinsics)
        )
        return Cameras(pose, intrinsics, view.width, view.height)

    def _decoded(self, index: int, half: bool) -> Tensor:
        picture = self.capture[index]
        if half:
            view = self.capture.views[index].scaled(0.5)
            picture = picture.scaled(view.width, view.height)
        image = torch.from_numpy(np.array(picture.image))
        if self.behind is None or picture.mask is None:
            return image
        share = torch.from_numpy(np.array(picture.mask))[..., None] / 255
        behind = 255 * torch.tensor(self.behind)
        return (image * share + behind * (1 - share)).round().to(torch.uint8)
