"""The one interface of every head: identity, expression, joints and named regions."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
import roma
import torch
from jaxtyping import Float
from torch import Tensor, nn

from meshanim.errors import OptionError, ShapeError
from meshanim.geometry import TriangleMesh
from meshanim.heads.skinning import linear_blend_skinning

__all__ = ["JOINT_NAMES", "JOINT_PARENTS", "REGION_NAMES", "Head", "HeadParameters"]

REGION_NAMES = (
    "lips",
    "upper_face",
    "eyelids",
    "eyes",
    "jaw",
    "teeth",
    "tongue",
    "nose",
    "ears",
    "neck",
    "scalp",
    "face",
)
JOINT_NAMES = ("root", "neck", "jaw", "left_eye", "right_eye")
JOINT_PARENTS = (-1, 0, 1, 1, 1)


@dataclass(frozen=True)
class HeadParameters:
    """What poses a head; all optional, batch first, None means zero.

    A batch of 1 is repeated to the largest batch given. `shape` and `expression` may be narrower than the
    head's own: the missing coefficients are zero.

    Parameters
    ----------
    shape : (B, S), optional
        Identity coefficients, in standard deviations.
    expression : (B, E), optional
        Weights of the head's expressions (`Head.expression_names`).
    rotation, neck, jaw : (B, 3), optional
        Axis-angle, radians: the whole head about its root; the neck; the jaw (positive x opens).
    eyes : (B, 6), optional
        Axis-angle of the left eye, then of the right one.
    translation : (B, 3), optional
        Metres, added last.
    """

    shape: Float[Tensor, "batch shape"] | None = None
    expression: Float[Tensor, "batch2 expression"] | None = None
    rotation: Float[Tensor, "batch3 3"] | None = None
    neck: Float[Tensor, "batch4 3"] | None = None
    jaw: Float[Tensor, "batch5 3"] | None = None
    eyes: Float[Tensor, "batch6 6"] | None = None
    translation: Float[Tensor, "batch7 3"] | None = None

    @property
    def batch(self) -> int:
        """The common batch size.

        Raises
        ------
        ShapeError
            If two parameters have different batch sizes above 1.
        """
        sizes = {
            field.name: value.shape[0]
            for field in fields(self)
            if (value := getattr(self, field.name)) is not None
        }
        largest = max(sizes.values(), default=1)
        if any(size not in (1, largest) for size in sizes.values()):
            raise ShapeError(f"parameters have different batch sizes: {sizes}")
        return largest


class Head(nn.Module):
    """A parametric head: linear identity and expression, pose correctives, five joints, skinning.

    Parameters
    ----------
    mesh : TriangleMesh
        The template: all parameters zero.
    shape_directions : (V, 3, S)
        Metres for each standard deviation.
    expression_directions : (V, 3, E)
        Metres for each unit of weight.
    shape_names, expression_names : sequence of str
        Names of the S and E columns.
    joints : (5, 3)
        Rest joints of the template, in the order of `JOINT_NAMES`, metres.
    joint_shape_directions : (5, 3, S)
        How the joints follow identity.
    weights : (V, 5)
        Skinning weights.
    regions : mapping of str to index array
        Vertex indices of every name in `REGION_NAMES`; empty where the head has no such part.
    pose_directions : (V, 3, 36), optional
        Pose correctives, columns: rotation matrix minus identity of joints 1 to 4, row by row (FLAME).
    joint_expression_directions : (5, 3, E), optional
        How the joints follow expression (FLAME regresses joints from the expressive mesh).
    """

    joint_names = JOINT_NAMES

    def __init__(
        self,
        mesh: TriangleMesh,
        shape_directions: np.ndarray,
        expression_directions: np.ndarray,
        shape_names: Sequence[str],
        expression_names: Sequence[str],
        joints: np.ndarray,
        joint_shape_directions: np.ndarray,
        weights: np.ndarray,
        regions: Mapping[str, np.ndarray],
        pose_directions: np.ndarray | None = None,
        joint_expression_directions: np.ndarray | None = None,
    ):
        super().__init__()
        self.mesh = mesh
        self.shape_names = tuple(shape_names)
        self.expression_names = tuple(expression_names)
        missing = set(REGION_NAMES) - set(regions)
        if missing:
            raise OptionError(f"regions lack {sorted(missing)}; give an empty array where a head has none")
        self.regions: dict[str, np.ndarray] = {
            name: np.asarray(regions[name], np.int64) for name in (*REGION_NAMES, *regions)
        }
        n, s, e = mesh.n_vertices, len(self.shape_names), len(self.expression_names)
        self.template_vertices: Tensor
        self.shape_directions: Tensor
        self.expression_directions: Tensor
        self.pose_directions: Tensor | None
        self.rest_joints: Tensor
        self.joint_shape_directions: Tensor
        self.joint_expression_directions: Tensor | None
        self.weights: Tensor
        # Directions are kept as (coefficients, 3 V): one matrix product a batch.
        self._buffer("template_vertices", mesh.vertices, (n, 3))
        self._directions("shape_directions", shape_directions, n, s)
        self._directions("expression_directions", expression_directions, n, e)
        self._directions("pose_directions", pose_directions, n, 36)
        self._buffer("rest_joints", joints, (5, 3))
        self._directions("joint_shape_directions", joint_shape_directions, 5, s)
        self._directions("joint_expression_directions", joint_expression_directions, 5, e)
        self._buffer("weights", weights, (n, 5))

    def _buffer(self, name: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
        if np.shape(array) != shape:
            raise ShapeError(f"{name} must have shape {shape}, not {np.shape(array)}")
        self.register_buffer(name, torch.from_numpy(np.array(array, np.float32)), persistent=False)

    def _directions(self, name: str, array: np.ndarray | None, rows: int, columns: int) -> None:
        if array is None:
            self.register_buffer(name, None, persistent=False)
            return
        if np.shape(array) != (rows, 3, columns):
            raise ShapeError(f"{name} must have shape {(rows, 3, columns)}, not {np.shape(array)}")
        flat = np.ascontiguousarray(np.asarray(array, np.float32).reshape(rows * 3, columns).T)
        self.register_buffer(name, torch.from_numpy(flat), persistent=False)

    @property
    def n_vertices(self) -> int:
        return self.mesh.n_vertices

    def expression(self, weights: Mapping[str, float | Tensor]) -> Float[Tensor, "batch expression"]:
        """Expression coefficients from named weights.

        Parameters
        ----------
        weights : mapping of str to float or (B,) tensor
            Weights by name; the others are zero.

        Returns
        -------
        (B, E)

        Raises
        ------
        OptionError
            If a name is not one of `expression_names`.
        """
        unknown = [name for name in weights if name not in self.expression_names]
        if unknown:
            raise OptionError(
                f"no expression named {', '.join(unknown)}; there are {', '.join(self.expression_names)}"
            )
        values = {
            name: torch.as_tensor(weight).to(self.template_vertices) for name, weight in weights.items()
        }
        batch = max((value.numel() for value in values.values() if value.ndim), default=1)
        columns = [
            values[name].expand(batch) if name in values else self.template_vertices.new_zeros(batch)
            for name in self.expression_names
        ]
        return torch.stack(columns, dim=1) if columns else self.template_vertices.new_zeros(batch, 0)

    def template(
        self, shape: Float[Tensor, "batch shape"] | None = None
    ) -> Float[Tensor, "batch vertices 3"]:
        """Neutral vertices of each identity, metres."""
        if shape is None:
            return self.template_vertices[None]
        return self.template_vertices + self._blend(shape, self.shape_directions, "shape")

    def with_offset(self, offset: Float[Tensor, "vertices 3"]) -> "Head":
        """The same head with a personal template: what identity coefficients do not hold.

        Parameters
        ----------
        offset : (V, 3)
            Metres, added to the vertices before any joint is turned (VHAP's `static_offset`).

        Raises
        ------
        ShapeError
            If there is not one row a vertex.
        """
        if offset.shape != self.template_vertices.shape:
            raise ShapeError(
                f"offset must be {tuple(self.template_vertices.shape)}, not {tuple(offset.shape)}"
            )
        head = copy.deepcopy(self)
        head.template_vertices = self.template_vertices + offset.to(self.template_vertices)
        head.mesh = self.mesh.with_vertices(head.template_vertices.double().cpu().numpy())
        return head

    def joints(
        self,
        shape: Float[Tensor, "batch shape"] | None = None,
        expression: Float[Tensor, "batch2 expression"] | None = None,
    ) -> Float[Tensor, "batch3 5 3"]:
        """Rest joints of each identity, metres, in the order of `joint_names`."""
        joints = self.rest_joints[None]
        if shape is not None:
            joints = joints + self._blend(shape, self.joint_shape_directions, "shape")
        if expression is not None and self.joint_expression_directions is not None:
            joints = joints + self._blend(expression, self.joint_expression_directions, "expression")
        return joints

    def deform(
        self,
        shape: Float[Tensor, "batch shape"] | None = None,
        expression: Float[Tensor, "batch2 expression"] | None = None,
    ) -> Float[Tensor, "batch3 vertices 3"]:
        """Vertices with identity and expression but no joint turned, metres."""
        vertices = self.template(shape)
        if expression is not None:
            vertices = vertices + self._blend(expression, self.expression_directions, "expression")
        return vertices

    def forward(self, params: HeadParameters | None = None) -> Float[Tensor, "batch vertices 3"]:
        """Posed vertices, metres.

        Raises
        ------
        ShapeError
            If a parameter has more columns than the head has, or batch sizes differ.
        """
        params = HeadParameters() if params is None else params
        batch = params.batch
        vertices = self.deform(params.shape, params.expression)
        pose = [params.rotation, params.neck, params.jaw, params.eyes]
        if any(value is not None for value in pose):
            widths = (3, 3, 3, 6)
            turns = torch.cat(
                [
                    self.template_vertices.new_zeros(batch, width)
                    if value is None
                    else value.expand(batch, width)
                    for value, width in zip(pose, widths)
                ],
                dim=1,
            ).unflatten(1, (5, 3))
            vertices = vertices.expand(batch, -1, -1)
            if self.pose_directions is not None:
                feature = roma.rotvec_to_rotmat(turns[:, 1:]) - torch.eye(3).to(turns)
                vertices = vertices + self._blend(feature.flatten(1), self.pose_directions, "pose")
            joints = self.joints(params.shape, params.expression).expand(batch, -1, -1)
            vertices = linear_blend_skinning(vertices, joints, turns, JOINT_PARENTS, self.weights)
        if params.translation is not None:
            vertices = vertices + params.translation[:, None]
        return vertices.expand(batch, -1, -1)

    def pose(
        self,
        vertices: Float[Tensor, "batch vertices 3"],
        rotation: Float[Tensor, "batch 3"],
        shape: Float[Tensor, "batch2 shape"] | None = None,
    ) -> Float[Tensor, "batch vertices 3"]:
        """Turn zero-pose vertices by a head rotation about the neck joint (GAVA's T_p, Sec. 3.2).

        The same as turning only the neck in `forward`, without pose correctives: it takes vertices that a
        network predicted, not coefficients.

        Parameters
        ----------
        vertices : (B, V, 3)
            Zero-pose vertices, metres.
        rotation : (B, 3)
            Axis-angle, radians.
        shape : (B, S) or (1, S), optional
            Identity, which places the neck joint.
        """
        neck = self.joints(shape)[:, 1:2]
        turned = (vertices - neck) @ roma.rotvec_to_rotmat(rotation).mT + neck
        # Jaw and eyes hang on the neck.
        follow = self.weights[:, 1:].sum(1)[:, None]
        return vertices + follow * (turned - vertices)

    def _blend(self, coefficients: Tensor, directions: Tensor, name: str) -> Tensor:
        given, available = coefficients.shape[1], directions.shape[0]
        if given > available:
            raise ShapeError(f"{name} has {given} columns, this head has {available}")
        return (coefficients @ directions[:given]).unflatten(1, (-1, 3))

    def extra_repr(self) -> str:
        return (
            f"{self.n_vertices} vertices, {self.mesh.n_faces} faces, {len(self.shape_names)} shape, "
            f"{len(self.expression_names)} expression"
        )
