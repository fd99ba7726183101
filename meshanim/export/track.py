"""Blendshape weights as files by their ending: tables, and meshes that the weights move."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from meshanim.errors import OptionError
from meshanim.export.blendshape_motion import BlendshapeMotion
from meshanim.export.gltf import GltfMaterial, write_blendshape_glb
from meshanim.export.usd import USD_ENDINGS, write_usd
from meshanim.heads import Head
from meshanim.motion.blendshape_csv import CsvForm
from meshanim.motion.blendshape_track import BlendshapeTrack

__all__ = ["TRACK_ENDINGS", "write_track"]

TRACK_ENDINGS = (".csv", ".npz", ".glb", *USD_ENDINGS)


def write_track(
    path: str | Path,
    track: BlendshapeTrack,
    head: Head,
    neutral: Float[np.ndarray, "vertices 3"] | None = None,
    pivot: Float[np.ndarray, " 3"] | None = None,
    csv: CsvForm = "audio2face",
    materials: list[GltfMaterial] | None = None,
) -> None:
    """Write weights by the ending of the path.

    Parameters
    ----------
    path : str or Path
        .csv and .npz hold the weights (`BlendshapeTrack.save`); .glb, .usda, .usdc and .usd the face, its
        shapes by name, the weights and the turn of the head.
    track : BlendshapeTrack
    head : Head
        Whose shapes.
    neutral, pivot
        As of `BlendshapeMotion.of`.
    csv : CsvForm
        As of `BlendshapeTrack.save`.
    materials : list of GltfMaterial, optional
        Of a .glb.

    Raises
    ------
    OptionError
        If the path ends otherwise, or a shape is not the head's or not the table's.
    DependencyError
        For USD without the extra `usd`.
    """
    ending = Path(path).suffix.lower()
    if ending not in TRACK_ENDINGS:
        raise OptionError(f"weights are written as {', '.join(TRACK_ENDINGS)}, not {path}")
    if ending in (".csv", ".npz"):
        track.save(path, csv)
        return
    motion = BlendshapeMotion.of(track, head, neutral, pivot)
    if ending == ".glb":
        write_blendshape_glb(path, motion, materials)
    else:
        write_usd(path, motion)
