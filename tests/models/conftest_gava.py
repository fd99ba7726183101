"""Small networks for the tests of this folder."""

import numpy as np
import torch
import trimesh

from meshanim.geometry import TriangleMesh
from meshanim.models.gava import Gava, GavaConfig


def sphere(subdivisions: int = 2, radius: float = 0.1) -> TriangleMesh:
    shape = trimesh.creation.icosphere(subdivisions, radius)
    return TriangleMesh(np.asarray(shape.vertices), np.asarray(shape.faces))


def small_config(**options) -> GavaConfig:
    defaults = {
        "feature_dim": 6,
        "width": 16,
        "heads": 2,
        "rank": 8,
        "channels": 8,
        "eigenfunctions": 12,
        "mel_bands": 5,
        "mel_frames": 8,
        "subjects": ("anna", "ben"),
        "emotions": ("neutral", "happy"),
    }
    return GavaConfig(**(defaults | options))


def awake(model: Gava, seed: int = 0) -> Gava:
    """The heads of a fresh model are zero; give them weights so that it moves."""
    generator = torch.Generator().manual_seed(seed)
    for layer in (model.decoder.displacement, model.decoder.pose):
        if layer is not None:
            with torch.no_grad():
                layer.weight.normal_(generator=generator)
    return model.eval()


def inputs(model: Gava, batch: int = 3, seed: int = 0):
    config, generator = model.config, torch.Generator().manual_seed(seed)
    window = torch.randn(batch, config.window, config.feature_dim, generator=generator)
    mel = torch.randn(batch, config.mel_frames, config.mel_bands, generator=generator) - 8
    embedding = model.embed(model.surface.template[None])
    return window, mel, embedding, model.style_of().expand(batch, -1)
