"""Gaussians on meshes."""

from meshanim.gaussians.cameras import Cameras
from meshanim.gaussians.gaussians import Gaussians

__all__ = ["Cameras", "Gaussians"]
