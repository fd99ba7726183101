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
LOOKED_AT, SHARE_AROUND, TOLERANCE = 3, 0.02, 3
"""To find a plain background: pictures, share of pixels that is not the head, levels of 255 of noise."""
BACKDROPS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}


def backdrop(
    capture: Capture, wanted: str | tuple[float, float, float]
) -> tuple[tuple[float, float, float], bool]:
    """What is behind the head, and whether pictures must be put in front of it by their masks.

    Parameters
    ----------
    capture : Capture
        Whose.
    wanted : "auto", "white", "black" or (3,) float
        auto: the capture's own where it is plain, as stated or as seen around the masks (VHAP and NeRSemble
        have put their pictures on a colour; doing so again would thin their edges); else white where there
        are masks. A colour: that of an avatar.

    Raises
    ------
    OptionError
        If there is neither a plain background nor masks.
    """
    if isinstance(wanted, str) and wanted not in ("auto", *BACKDROPS):
        raise OptionError(f"no background '{wanted}'; there are auto, {', '.join(BACKDROPS)}")
    plain = capture.background or _plain(capture)
    color = wanted if isinstance(wanted, tuple) else BACKDROPS.get(wanted)
    if plain is not None and (color is None or np.allclose(plain, color, atol=1.01 / 255)):
        return plain, False
    if capture[0].mask is None:
        raise OptionError(
            f"{capture.directory} has no masks, so the head cannot be told from what is behind it: "
            "add masks/, or state the colour of a plain background in capture.json"
        )
    return BACKDROPS["white"] if color is None else color, True


def _plain(capture: Capture) -> tuple[float, float, float] | None:
    """The one colour that some pictures have wherever their masks are empty; None if there is none."""
    found = []
    for index in np.linspace(0, len(capture) - 1, LOOKED_AT).astype(int).tolist():
        picture = capture[index]
        around = None if picture.mask is None else picture.image[picture.mask == 0].astype(int)
        if around is None or len(around) < SHARE_AROUND * picture.image.shape[0] * picture.image.shape[1]:
            return None
        color = np.median(around, axis=0)
        if (np.abs(around - color).max(1) > TOLERANCE).mean() > 0.01:
            return None
        found.append(color)
    if np.ptp(found, axis=0).max() > 1:
        return None
    red, green, blue = (float(channel) / 255 for channel in np.median(found, axis=0))
    return red, green, blue


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
        self._cameras: dict[tuple[int, bool], Cameras] = {}
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
        if (index, half) not in self._cameras:
            view = self.capture.views[index]
            view = view.scaled(0.5) if half else view
            pose, intrinsics = (
                torch.from_numpy(m).float()[None] for m in (view.world_to_camera, view.intrinsics)
            )
            self._cameras[index, half] = Cameras(pose, intrinsics, view.width, view.height)
        return self._cameras[index, half]

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
