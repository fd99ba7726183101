"""`DefaultHead`: the packed head with its parts, masks, people and lip seal."""

from dataclasses import dataclass
from importlib.resources import files

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from meshanim.errors import FileFormatError, OptionError
from meshanim.geometry import TriangleMesh
from meshanim.heads.default.regions import default_regions
from meshanim.heads.head import Head

__all__ = ["SEAL_NAME", "DefaultHead", "HeadPart", "load_default_head"]

SEAL_NAME = "lipSeal"


@dataclass(frozen=True)
class HeadPart:
    """One part of the head as quads; all indices are into the whole head's arrays.

    Parameters
    ----------
    vertices : (n,) int
        The part's vertices, consecutive.
    quads : (Q, 4) int
        Faces, indices into the head's vertices.
    uv_quads : (Q, 4) int
        The same corners in `DefaultHead.uv` and `DefaultHead.atlas_uv`.
    faces : slice
        The part's triangles in `head.mesh.faces`: two a quad, (0, 1, 2) and (0, 2, 3).
    """

    vertices: Int[np.ndarray, " vertices"]
    quads: Int[np.ndarray, "quads 4"]
    uv_quads: Int[np.ndarray, "quads 4"]
    faces: slice


class DefaultHead(Head):
    """The head that ships with the library; made by `load_head("default")`.

    The mesh's texture coordinates are `atlas_uv`: every part in one atlas without overlap, the middle of the
    face magnified. The teeth already sit 2.4 mm (upper) and 1.2 mm (lower) further forward than MakeHuman's.

    Its last expression is `lipSeal`, whose delta depends on the identity. To close the lips of any person
    while the jaw is open by j, set jawOpen = j, mouthClose = j, lipSeal = 1; scale the last two to open.

    Attributes
    ----------
    parts : dict of str to HeadPart
        skin, left_eye, right_eye, upper_teeth, lower_teeth, tongue and four strips of lashes.
    uv, atlas_uv : (U, 2)
        MakeHuman's own layout, and the packed one.
    masks : dict of str to (V,) array
        MakeHuman's painted masks at the vertices, in [0, 1]: lips, eyelids, ears, inside-mouth, face.
    lip_pairs : (P, 2)
        Upper and lower vertices of the middle of the mouth.
    neck_loop : (42,)
        The vertices of the cut, in order.
    people : dict of str to (S,) array
        Shape coefficients of a few people who differ at a glance.
    """

    def __init__(self, arrays: dict[str, np.ndarray]):
        quads = arrays["quads"].astype(np.int64)
        uv_quads = arrays["uv_quads"].astype(np.int64)
        faces = quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
        uv_faces = uv_quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
        mesh = TriangleMesh(arrays["vertices"], faces, arrays["atlas_uv"], uv_faces)
        names = [str(name) for name in arrays["part_names"]]
        stops = arrays["vertex_stops"].tolist(), arrays["quad_stops"].tolist()
        parts = {}
        for index, name in enumerate(names):
            (low, high), (first, last) = ((stop[index], stop[index + 1]) for stop in stops)
            parts[name] = HeadPart(
                np.arange(low, high), quads[first:last], uv_quads[first:last], slice(2 * first, 2 * last)
            )
        masks = {}
        for name, values in zip(arrays["mask_names"], arrays["masks"]):
            masks[str(name)] = np.zeros(mesh.n_vertices, np.float32)
            masks[str(name)][: values.shape[0]] = values / np.float32(255)
        expressions = arrays["expressions"] * np.float32(arrays["expression_step"])
        expression_names = [str(name) for name in arrays["expression_names"]]
        step = np.float32(arrays["shape_step"])
        seal = arrays["seal"] * step
        template_seal = np.zeros((1, mesh.n_vertices, 3), np.float32)
        template_seal[0, arrays["seal_vertices"]] = seal[0]
        weights = arrays["weights"].astype(np.float32)
        weights /= weights.sum(1, keepdims=True)
        super().__init__(
            mesh,
            np.moveaxis(arrays["shapes"] * step, 0, -1),
            np.moveaxis(np.concatenate([expressions, template_seal]), 0, -1),
            [f"identity_{index:02d}" for index in range(len(arrays["shapes"]))],
            [*expression_names, SEAL_NAME],
            arrays["joints"],
            np.moveaxis(arrays["joint_shapes"], 1, 2),
            weights,
            default_regions(
                mesh.vertices,
                {name: part.vertices for name, part in parts.items()},
                masks,
                weights,
                dict(zip(expression_names, expressions)),
            ),
        )
        self.parts = parts
        self.masks = masks
        self.uv = arrays["uv"]
        self.atlas_uv = arrays["atlas_uv"]
        self.lip_pairs = arrays["lip_pairs"].astype(np.int64)
        self.neck_loop = arrays["neck_loop"].astype(np.int64)
        self.people = {str(name): row for name, row in zip(arrays["people_names"], arrays["people_shapes"])}
        self.shape_mean: Tensor
        self.register_buffer("shape_mean", torch.from_numpy(arrays["shape_mean"]), persistent=False)
        self.seal_vertices: Tensor
        self.seal_directions: Tensor
        self.register_buffer(
            "seal_vertices", torch.from_numpy(arrays["seal_vertices"].astype(np.int64)), persistent=False
        )
        self.register_buffer(
            "seal_directions", torch.from_numpy(seal[1:].reshape(len(seal) - 1, -1)), persistent=False
        )

    def sample_shapes(
        self, count: int, generator: torch.Generator | None = None
    ) -> Float[Tensor, "count shape"]:
        """Random adults: shape coefficients, independent and normal about the mean adult.

        The template (all coefficients zero) is MakeHuman's average adult, 2.4 mm rms from the mean of the
        sampled ones.
        """
        drawn = torch.randn(count, len(self.shape_names), generator=generator)
        return drawn.to(self.shape_mean) + self.shape_mean

    def person(self, name: str) -> Float[Tensor, "1 shape"]:
        """Shape coefficients of one of `people`.

        Raises
        ------
        OptionError
            If there is no such person.
        """
        if name not in self.people:
            raise OptionError(f"no person named {name}; there are {', '.join(self.people)}")
        return torch.from_numpy(self.people[name])[None].to(self.template_vertices)

    def seal(self, shape: Float[Tensor, "batch shape"] | None = None) -> Float[Tensor, "batch vertices 3"]:
        """The delta of `lipSeal` = 1 for each identity, metres: what closes the lips from the neutral."""
        row = self.expression_names.index(SEAL_NAME)
        delta = self.expression_directions[row].unflatten(0, (-1, 3))[None]
        if shape is None:
            return delta
        return delta.repeat(len(shape), 1, 1).index_add(1, self.seal_vertices, self._seal_change(shape))

    def _seal_change(self, shape: Tensor) -> Tensor:
        return (shape @ self.seal_directions[: shape.shape[1]]).unflatten(1, (-1, 3))

    def deform(
        self,
        shape: Float[Tensor, "batch shape"] | None = None,
        expression: Float[Tensor, "batch2 expression"] | None = None,
    ) -> Float[Tensor, "batch3 vertices 3"]:
        """Vertices with identity and expression, the identity's own lip seal included, metres."""
        vertices = super().deform(shape, expression)
        row = self.expression_names.index(SEAL_NAME)
        if shape is None or expression is None or expression.shape[1] <= row:
            return vertices
        change = expression[:, row, None, None] * self._seal_change(shape)
        return vertices.index_add(1, self.seal_vertices, change)


def load_default_head() -> DefaultHead:
    """The packed head of the installation.

    Raises
    ------
    FileFormatError
        If the installation lacks it.
    """
    source = files("meshanim.heads.default") / "head.npz"
    if not source.is_file():
        raise FileFormatError(f"{source} is missing: python -m meshanim.heads.default.build makes it")
    with source.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
        return DefaultHead({name: archive[name] for name in archive.files})
