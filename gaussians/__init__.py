"""Gaussians on meshes."""

from meshanim.gaussians.binding import Binding, bind
from meshanim.gaussians.cameras import Cameras
from meshanim.gaussians.gaussians import Gaussians
from meshanim.gaussians.splat import Rendering, rasterize

__all__ = ["Binding", "Cameras", "Gaussians", "Rendering", "bind", "rasterize"]
