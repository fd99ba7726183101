"""Mesh rendering on the CPU and the procedural look of the default head."""

from meshanim.render.camera import Camera, look_at, orthographic_camera, portrait_camera
from meshanim.render.clay import render_mesh
from meshanim.render.lighting import DRAFT, FULL, STUDIO, Light, Lighting, Quality
from meshanim.render.rasterizer import RasterBuffers, rasterize
from meshanim.render.renderer import Renderer, RenderMaps, head_camera
from meshanim.render.sequence import render_sequence

__all__ = [
    "DRAFT",
    "FULL",
    "STUDIO",
    "Camera",
    "Light",
    "Lighting",
    "Quality",
    "RasterBuffers",
    "RenderMaps",
    "Renderer",
    "head_camera",
    "look_at",
    "orthographic_camera",
    "portrait_camera",
    "rasterize",
    "render_mesh",
    "render_sequence",
]
