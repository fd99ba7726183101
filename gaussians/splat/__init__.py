"""Gaussian splatting: one interface, three backends, gsplat 1.5's pixels."""

from meshanim.gaussians.splat.functional import BACKENDS, rasterize
from meshanim.gaussians.splat.rendering import Rendering

__all__ = ["BACKENDS", "Rendering", "rasterize"]
