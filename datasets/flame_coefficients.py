"""What data sets of FLAME coefficients share: vertices from a head, and people who are read late."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32

from meshanim.datasets.motion_dataset import DatasetOptions, Subject
from meshanim.heads import Head, HeadParameters, load_head

__all__ = ["CoefficientOptions", "LateSubjects", "flame_template", "flame_vertices", "optional_head"]

BATCH = 256


@dataclass(frozen=True)
class CoefficientOptions(DatasetOptions):
    """How to read coefficients of FLAME.

    Parameters
    ----------
    head : str
        What `meshanim.heads.load_head` understands, "flame:generic_model.pkl": vertices are computed, in the
        zero pose. Without it there are coefficients alone, and no vertices.
    """

    head: str = ""


class LateSubjects(Mapping[str, Subject]):
    """Subjects whose names are known at once and who are read when first asked for.

    Parameters
    ----------
    names : sequence of str
        In the published order.
    read : callable
        Makes the subject of a name.
    """

    def __init__(self, names: Sequence[str], read: Callable[[str], Subject]):
        self._names = dict.fromkeys(names)
        self._read = read
        self._subjects: dict[str, Subject] = {}

    def __getitem__(self, name: str) -> Subject:
        if name not in self._names:
            raise KeyError(name)
        if name not in self._subjects:
            self._subjects[name] = self._read(name)
        return self._subjects[name]

    def __contains__(self, name: object) -> bool:
        return name in self._names

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def optional_head(name: str) -> Head | None:
    """The head of an option; None where it is empty."""
    return load_head(name) if name else None


def flame_vertices(
    head: Head | None,
    shape: Float32[np.ndarray, "frames shape"],
    expression: Float32[np.ndarray, "frames expression"],
    jaw: Float32[np.ndarray, "frames 3"],
) -> Float32[np.ndarray, "frames vertices 3"]:
    """Vertices in the zero pose, metres; none at all, (T, 0, 3), without a head."""
    if head is None:
        return np.zeros((len(shape), 0, 3), np.float32)
    vertices = np.empty((len(shape), head.n_vertices, 3), np.float32)
    with torch.no_grad():
        for first in range(0, len(shape), BATCH):
            part = slice(first, first + BATCH)
            coefficients = (
                torch.from_numpy(np.array(array[part], np.float32)) for array in (shape, expression, jaw)
            )
            frame_shape, frame_expression, frame_jaw = coefficients
            params = HeadParameters(shape=frame_shape, expression=frame_expression, jaw=frame_jaw)
            vertices[part] = head(params).numpy()
    return vertices


def flame_template(
    head: Head | None, shape: Float32[np.ndarray, " shape"]
) -> Float32[np.ndarray, "vertices 3"]:
    """The neutral face of an identity, metres; no vertices without a head."""
    if head is None:
        return np.zeros((0, 3), np.float32)
    with torch.no_grad():
        return head.template(torch.from_numpy(np.array(shape, np.float32))[None])[0].numpy().copy()
