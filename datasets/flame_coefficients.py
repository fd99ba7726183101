"""What data sets of FLAME coefficients share: vertices from a head, and people who are read late."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32

from meshanim.datasets.motion_dataset import DatasetOptions, Subject
from meshanim.errors import MeshanimError
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
    """Subjects whose names are known at once, and whose shape is read when they are first asked for.

    The shape is the mean over the frames of their first sequence that can be read, named in
    `attributes["shape_from"]`; where none can, that is empty and the shape is zero.

    Parameters
    ----------
    head : Head, optional
        Gives the template; without it a template has no vertices.
    sequences : sequence of (subject, sequence)
        Names, subjects in the published order.
    read : callable
        The shape (T, S) of a sequence; MeshanimError where it cannot be read.
    """

    def __init__(
        self,
        head: Head | None,
        sequences: Sequence[tuple[str, str]],
        read: Callable[[str], Float32[np.ndarray, "frames shape"]],
    ):
        self._head, self._read = head, read
        self._sequences: dict[str, list[str]] = {}
        for subject, name in sequences:
            self._sequences.setdefault(subject, []).append(name)
        self._subjects: dict[str, Subject] = {}

    def __getitem__(self, name: str) -> Subject:
        if name not in self._subjects:
            self._subjects[name] = self._subject(name, self._sequences[name])
        return self._subjects[name]

    def _subject(self, name: str, sequences: list[str]) -> Subject:
        for sequence in sequences:
            try:
                shape = self._read(sequence).mean(0)
            except MeshanimError:
                continue  # a defect of that sequence: reading it tells so
            template = flame_template(self._head, shape)
            return Subject(name, template, shape, {"shape_from": sequence})
        nothing = np.zeros(1, np.float32)
        return Subject(name, flame_template(self._head, nothing), nothing, {"shape_from": ""})

    def __contains__(self, name: object) -> bool:
        return name in self._sequences

    def __iter__(self) -> Iterator[str]:
        return iter(self._sequences)

    def __len__(self) -> int:
        return len(self._sequences)


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
