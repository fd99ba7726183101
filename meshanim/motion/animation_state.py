"""Audio2Face-3D's animation state: a face in 169 numbers, and back to vertices."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import roma
import torch
from jaxtyping import Float, Int
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from meshanim.errors import FileFormatError, MeshError, ShapeError
from meshanim.files import written_whole
from meshanim.geometry.alignment import Similarity, align
from meshanim.motion.face_parts import FaceParts

__all__ = [
    "Actors",
    "FacePose",
    "StateBasis",
    "eye_angles",
    "eye_rotation",
    "face_pose",
    "posed_face",
    "read_actors",
    "write_actors",
]

JAW, EYES = 15, 4


class FacePose(NamedTuple):
    """What a state says, as displacements from the neutral face in metres.

    `eyes` are pitch (about x, positive down) and yaw (about y, positive to the wearer's left) of the right
    eye, then of the left one, radians.
    """

    skin: Float[Tensor, "*frames skin 3"]
    tongue: Float[Tensor, "*frames tongue 3"]
    jaw: Float[Tensor, "*frames 5 3"]
    eyes: Float[Tensor, "*frames 2 2"]


def eye_rotation(angles: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 3 3"]:
    """R = R_y(yaw) R_x(pitch) of angles (pitch, yaw), radians."""
    pitch, yaw = angles[..., 0], angles[..., 1]
    zero = torch.zeros_like(pitch)
    about_x = roma.rotvec_to_rotmat(torch.stack([pitch, zero, zero], -1))
    about_y = roma.rotvec_to_rotmat(torch.stack([zero, yaw, zero], -1))
    return about_y @ about_x


def eye_angles(rotation: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 2"]:
    """Pitch and yaw of where a rotation turns the gaze +z, radians; torsion is dropped."""
    gaze = rotation[..., :, 2]
    pitch = torch.asin((-gaze[..., 1]).clamp(-1, 1))
    return torch.stack([pitch, torch.atan2(gaze[..., 0], gaze[..., 2])], dim=-1)


def face_pose(
    parts: FaceParts, vertices: Float[Tensor, "frames vertices 3"], template: Float[Tensor, "vertices 3"]
) -> FacePose:
    """What vertices in the zero pose say: the displacements of each part, and how the eyeballs are turned.

    Raises
    ------
    ShapeError
        If the mesh has too few vertices.
    """
    if vertices.shape[1] <= parts.largest or vertices.shape[1:] != template.shape:
        raise ShapeError(
            f"frames have {vertices.shape[1]} vertices and the template {len(template)}; the face's parts "
            f"name vertex {parts.largest}"
        )
    moved = vertices - template
    jaw = moved.new_zeros(len(moved), 5, 3)
    if len(parts.jaw_points):
        jaw = moved[:, parts.jaw_points]
    eyes = moved.new_zeros(len(moved), 2, 2)
    for side, ball in enumerate((parts.right_eye, parts.left_eye)):
        if len(ball) and len(moved):
            eyes[:, side] = eye_angles(_rotation(template[ball], vertices[:, ball]))
    return FacePose(moved[:, parts.skin], moved[:, parts.tongue], jaw, eyes)


def posed_face(
    parts: FaceParts, pose: FacePose, template: Float[Tensor, "vertices 3"]
) -> Float[Tensor, "frames vertices 3"]:
    """Vertices of a pose: skin and tongue moved, lower teeth and eyeballs carried rigidly."""
    out = template.repeat(len(pose.skin), 1, 1)
    if not len(out):
        return out
    out[:, parts.skin] += pose.skin
    out[:, parts.tongue] += pose.tongue
    if len(parts.jaw_points) and len(parts.jaw_rigid):
        carried = template[parts.jaw_rigid].expand(len(out), -1, 3)
        out[:, parts.jaw_rigid] = _jaw_transform(parts, pose.jaw, template).apply(carried)
    for side, ball in enumerate((parts.right_eye, parts.left_eye)):
        if len(ball):
            centre = template[ball].mean(0)
            rotation = eye_rotation(pose.eyes[:, side])
            out[:, ball] = (template[ball] - centre) @ rotation.mT + centre
    return out


@dataclass(frozen=True)
class StateBasis:
    """How faces of one topology become states: [skin K | tongue L | jaw 15 | eyes 4].

    The paper (Sec. 3.1) has K = 140 (272 for one actor), L = 10: 169 numbers. Parts that a mesh lacks have no
    columns. Lengths are in metres, angles in radians.

    Parameters
    ----------
    parts : FaceParts
        Vertices of skin, tongue, jaw and eyes.
    skin_mean : (S, 3)
        Mean displacement from the neutral.
    skin_components : (K, S, 3)
        Orthonormal over all S x 3 numbers.
    tongue_mean, tongue_components : (U, 3), (L, U, 3)
        The same of the tongue.
    eyes : bool
        Whether states hold eye angles.

    Raises
    ------
    ShapeError
        If the arrays do not fit the parts.
    """

    parts: FaceParts
    skin_mean: Float[Tensor, "skin 3"]
    skin_components: Float[Tensor, "components skin 3"]
    tongue_mean: Float[Tensor, "tongue 3"]
    tongue_components: Float[Tensor, "tongue_components tongue 3"]
    eyes: bool

    def __post_init__(self):
        for name, mean, components in (
            ("skin", self.skin_mean, self.skin_components),
            ("tongue", self.tongue_mean, self.tongue_components),
        ):
            count = len(getattr(self.parts, name))
            if mean.shape != (count, 3) or components.shape[1:] != (count, 3):
                raise ShapeError(
                    f"{name} has {count} vertices, its mean shape {tuple(mean.shape)} and its components "
                    f"{tuple(components.shape)}"
                )

    @property
    def sizes(self) -> dict[str, int]:
        """Numbers of skin, tongue, jaw and eyes, in their order."""
        return {
            "skin": len(self.skin_components),
            "tongue": len(self.tongue_components),
            "jaw": JAW if len(self.parts.jaw_points) else 0,
            "eyes": EYES * self.eyes,
        }

    @property
    def width(self) -> int:
        """Numbers of a state; 169 as published."""
        return sum(self.sizes.values())

    @property
    def columns(self) -> dict[str, slice]:
        """Where each part is in a state."""
        ends = np.cumsum(list(self.sizes.values())).tolist()
        return {name: slice(end - size, end) for (name, size), end in zip(self.sizes.items(), ends)}

    def encode(
        self,
        vertices: Float[Tensor, "frames vertices 3"],
        template: Float[Tensor, "vertices 3"],
        eyes: Float[Tensor, "frames 2 2"] | None = None,
    ) -> Float[Tensor, "frames state"]:
        """States of frames.

        Parameters
        ----------
        vertices : (T, V, 3)
            Zero head pose, metres.
        template : (V, 3)
            The subject's neutral face.
        eyes : (T, 2, 2), optional
            Angles as in `FacePose`, where they are tracked; those that turn the eyeballs best if not given.

        Raises
        ------
        ShapeError
            If the mesh has too few vertices, or no eyeballs where angles are to be found.
        """
        if vertices.shape[1] <= self.parts.largest or vertices.shape[1:] != template.shape:
            raise ShapeError(
                f"frames have {vertices.shape[1]} vertices and the template {len(template)}; this basis "
                f"names vertex {self.parts.largest}"
            )
        moved = vertices - template
        columns = [
            torch.einsum("tvc,kvc->tk", moved[:, self.parts.skin] - self.skin_mean, self.skin_components),
            torch.einsum(
                "tvc,kvc->tk", moved[:, self.parts.tongue] - self.tongue_mean, self.tongue_components
            ),
        ]
        if self.sizes["jaw"]:
            columns.append(moved[:, self.parts.jaw_points].flatten(1))
        if self.sizes["eyes"]:
            if eyes is None:
                balls = (self.parts.right_eye, self.parts.left_eye)
                if not all(len(ball) for ball in balls):
                    raise ShapeError("this mesh has no eyeballs: give the eyes' angles")
                turned = [_rotation(template[ball], vertices[:, ball]) for ball in balls]
                eyes = torch.stack([eye_angles(rotation) for rotation in turned], dim=1)
            columns.append(eyes.flatten(1))
        return torch.cat(columns, dim=1)

    def decode(self, states: Float[Tensor, "*frames state"]) -> FacePose:
        """Displacements of skin, tongue and jaw points, and eye angles; zero for parts without columns."""
        if states.shape[-1] != self.width:
            raise ShapeError(f"states have {states.shape[-1]} numbers, this basis {self.width}")
        at = self.columns
        skin, tongue = (
            mean + torch.einsum("...k,kvc->...vc", states[..., at[name]], components)
            for name, mean, components in (
                ("skin", self.skin_mean, self.skin_components),
                ("tongue", self.tongue_mean, self.tongue_components),
            )
        )
        lead = states.shape[:-1]
        jaw = states[..., at["jaw"]] if self.sizes["jaw"] else states.new_zeros(*lead, JAW)
        eyes = states[..., at["eyes"]] if self.sizes["eyes"] else states.new_zeros(*lead, EYES)
        return FacePose(skin, tongue, jaw.unflatten(-1, (5, 3)), eyes.unflatten(-1, (2, 2)))

    def jaw_transform(
        self, jaw: Float[Tensor, "frames 5 3"], template: Float[Tensor, "vertices 3"]
    ) -> Similarity:
        """The rigid motion of the jaw that fits its five points best (Procrustes; Sec. 3.1).

        Raises
        ------
        MeshError
            If the mesh has no jaw points.
        """
        if not self.sizes["jaw"]:
            raise MeshError("this mesh has no jaw points, so its jaw has no rigid motion")
        return _jaw_transform(self.parts, jaw, template)

    def vertices(
        self, states: Float[Tensor, "frames state"], template: Float[Tensor, "vertices 3"]
    ) -> Float[Tensor, "frames vertices 3"]:
        """The whole face of a subject: skin and tongue moved, lower teeth and eyeballs carried rigidly."""
        return self.posed(self.decode(states), template)

    def posed(
        self, pose: FacePose, template: Float[Tensor, "vertices 3"]
    ) -> Float[Tensor, "frames vertices 3"]:
        """As `vertices`, from what `decode` gives, or a network."""
        return posed_face(self.parts, pose, template)

    def to(self, *args) -> "StateBasis":
        """On another device or in another precision."""
        return StateBasis(
            self.parts,
            self.skin_mean.to(*args),
            self.skin_components.to(*args),
            self.tongue_mean.to(*args),
            self.tongue_components.to(*args),
            self.eyes,
        )

    def tensors(self) -> dict[str, Tensor]:
        """All of it by name, for files."""
        named = {f"parts.{name}": torch.from_numpy(value) for name, value in self.parts.arrays().items()}
        for name in ("skin_mean", "skin_components", "tongue_mean", "tongue_components"):
            named[name] = getattr(self, name).contiguous()
        named["eyes"] = torch.tensor([self.eyes])
        return named

    @classmethod
    def from_tensors(cls, tensors: dict[str, Tensor]) -> "StateBasis":
        """What `tensors` gave; KeyError if one is missing."""
        prefix = "parts."
        parts = {n.removeprefix(prefix): t.numpy() for n, t in tensors.items() if n.startswith(prefix)}
        return cls(
            FaceParts.from_arrays(parts),
            tensors["skin_mean"],
            tensors["skin_components"],
            tensors["tongue_mean"],
            tensors["tongue_components"],
            bool(tensors["eyes"]),
        )


class Actors(NamedTuple):
    """A basis, the neutral faces of those who share it, metres, and their faces (empty where unknown)."""

    basis: StateBasis
    templates: Mapping[str, Float[Tensor, "vertices 3"]]
    faces: Int[np.ndarray, "faces 3"]


def write_actors(path: str | Path, actors: Actors) -> None:
    """Write a safetensors file."""
    tensors = actors.basis.tensors() | {"faces": torch.from_numpy(np.ascontiguousarray(actors.faces))}
    tensors |= {f"templates.{name}": value.contiguous() for name, value in actors.templates.items()}
    with written_whole(path) as temporary:
        save_file(tensors, temporary)


def read_actors(path: str | Path) -> Actors:
    """Read what `write_actors` wrote.

    Raises
    ------
    FileFormatError
        If it is missing, damaged or something else.
    """
    try:
        tensors = load_file(path)
        prefix = "templates."
        templates = {n.removeprefix(prefix): t for n, t in tensors.items() if n.startswith(prefix)}
        basis = StateBasis.from_tensors(tensors)
        return Actors(basis, dict(sorted(templates.items())), tensors["faces"].numpy())
    except (OSError, SafetensorError, KeyError, ShapeError, MeshError) as error:
        raise FileFormatError(f"{path} is no basis of animation states: {error}") from error


def _jaw_transform(
    parts: FaceParts, jaw: Float[Tensor, "frames 5 3"], template: Float[Tensor, "vertices 3"]
) -> Similarity:
    neutral = template[parts.jaw_points].expand(len(jaw), 5, 3)
    return align(neutral, neutral + jaw)


def _rotation(
    source: Float[Tensor, "points 3"], target: Float[Tensor, "frames points 3"]
) -> Float[Tensor, "frames 3 3"]:
    return align(source.expand(len(target), -1, 3), target).rotation
