"""`Rig`: a neutral mesh and its named blendshapes, as read from a file."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from meshanim.errors import FileFormatError

__all__ = ["Rig"]


@dataclass(frozen=True)
class Rig:
    """A neutral mesh and its blendshapes.

    Parameters
    ----------
    neutral : (V, 3) float
        Metres.
    faces : (F, 3) int
    names : (E,) str
        Names of the shapes.
    deltas : (E, V, 3) float
        What each adds to the neutral at weight 1, metres.
    uv : (U, 2) float, optional
    uv_faces : (F, 3) int, optional
    regions : dict of str to index array
        Named vertex sets that the file brings.

    Raises
    ------
    FileFormatError
        If the arrays do not fit together, a number is not finite or a name comes twice.
    """

    neutral: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    names: tuple[str, ...]
    deltas: Float[np.ndarray, "shapes vertices2 3"]
    uv: Float[np.ndarray, "uv 2"] | None = None
    uv_faces: Int[np.ndarray, "faces 3"] | None = None
    regions: Mapping[str, Int[np.ndarray, " _"]] = field(default_factory=dict)

    def __post_init__(self):
        if self.deltas.shape != (len(self.names), len(self.neutral), 3):
            raise FileFormatError(
                f"{len(self.names)} shape names and {len(self.neutral)} vertices, but deltas of shape "
                f"{self.deltas.shape}"
            )
        if not (np.isfinite(self.neutral).all() and np.isfinite(self.deltas).all()):
            raise FileFormatError("the rig holds numbers that are NaN or infinite")
        if len(set(self.names)) != len(self.names):
            twice = sorted({name for name in self.names if self.names.count(name) > 1})
            raise FileFormatError(f"shapes named twice: {', '.join(twice)}")
        for name, indices in self.regions.items():
            if indices.size and not 0 <= indices.min() <= indices.max() < len(self.neutral):
                raise FileFormatError(f"region {name} names vertices outside 0..{len(self.neutral) - 1}")
