"""Gaussians on meshes."""

from meshanim.gaussians.binding import Binding, bind
from meshanim.gaussians.cameras import Cameras
from meshanim.gaussians.files import read_gaussians, write_gaussians
from meshanim.gaussians.gaussians import Gaussians
from meshanim.gaussians.splat import Rendering, rasterize

__all__ = [
    "Binding",
    "Cameras",
    "Gaussians",
    "Rendering",
    "bind",
    "rasterize",
    "read_gaussians",
    "write_gaussians",
]
