"""Gaussians that ride on the triangles of a moving mesh."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import roma
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from meshanim.errors import BackendError, MeshError, OptionError, ShapeError
from meshanim.gaussians.binding_native import BindingLists, available, to_world_native
from meshanim.gaussians.gaussians import Gaussians
from meshanim.gaussians.harmonics import COEFFICIENTS, harmonics, rotate_harmonics
from meshanim.geometry import (
    Subdivision,
    SurfaceCorrespondence,
    TriangleMesh,
    triangle_frames,
)
from meshanim.geometry.closest_points import barycentric_coordinates
from meshanim.geometry.correspondence import agreeing_points

__all__ = ["Binding", "Refinement", "bind"]

BACKENDS = ("auto", "native", "reference")
Vertices = Float[Tensor, "*#batch vertices 3"]


class Refinement(NamedTuple):
    """A binding and its Gaussians after some were added or removed."""

    binding: "Binding"
    gaussians: Gaussians
    parent: Int[Tensor, " n"]
    """Which of the old Gaussians each comes from: rows of an optimiser's state follow it."""
    fresh: Bool[Tensor, " n"]
    """Which ones are new: they come last."""


def bind(
    mesh: TriangleMesh,
    per_face: int | Int[np.ndarray, " faces"] = 1,
    faces: Int[np.ndarray, " bound"] | Bool[np.ndarray, " faces"] | None = None,
) -> "Binding":
    """Bind Gaussians to the triangles of a mesh, those of a triangle side by side.

    Parameters
    ----------
    mesh : TriangleMesh
        At rest.
    per_face : int or (F,) int
        Gaussians a triangle, one or more; or of each triangle of the mesh, none or more.
    faces : (n,) int or (F,) bool, optional
        Triangles to bind to; all if not given.

    Raises
    ------
    OptionError
        If a triangle does not exist or is named twice, or a number of Gaussians is negative or zero for all.
    ShapeError
        If a mask or the numbers have not one entry a face.
    """
    if faces is None:
        chosen = np.arange(mesh.n_faces)
    elif faces.dtype == bool:
        if len(faces) != mesh.n_faces:
            raise ShapeError(f"faces has {len(faces)} entries, the mesh {mesh.n_faces} faces")
        chosen = np.flatnonzero(faces)
    else:
        chosen = faces
        if chosen.size and (chosen.min() < 0 or chosen.max() >= mesh.n_faces):
            raise OptionError(
                f"faces names {chosen.min()}..{chosen.max()}, but there are {mesh.n_faces} triangles"
            )
        if len(np.unique(chosen)) != len(chosen):
            raise OptionError("faces names a triangle twice: give per_face for several Gaussians on one")
    if isinstance(per_face, np.ndarray):
        if len(per_face) != mesh.n_faces:
            raise ShapeError(f"per_face has {len(per_face)} entries, the mesh {mesh.n_faces} faces")
        counts = per_face[chosen]
    else:
        counts = np.full(len(chosen), per_face)
    if counts.min(initial=0) < 0 or not counts.any():
        raise OptionError(f"per_face must give some triangle a Gaussian and none less than 0, not {per_face}")
    return Binding(mesh, torch.from_numpy(np.repeat(chosen, counts)))


@dataclass(frozen=True, eq=False)
class Binding:
    """Which triangle carries each Gaussian.

    A triangle's frame (rotation R, scale k, origin T of `triangle_frames`) takes a Gaussian from its own,
    local space to the world: mu' = k R mu + T, q' = q(R) q / |q|, s' = k s (GaussianSpeech, Eqs. 25 to 27,
    after GaussianAvatars, Qian et al. 2024, Sec. 3.2). Local means and scales are in units of the triangle's
    scale k; the second local axis is the triangle's normal. Opacities and colours stay as they are.

    Parameters
    ----------
    mesh : TriangleMesh
        At rest: the triangles, and where Gaussians are when they are bound anew.
    face : (N,) int64
        Triangle of each Gaussian.

    Raises
    ------
    ShapeError
        If `face` is not one row of int64.
    OptionError
        If it names a triangle that does not exist.
    """

    mesh: TriangleMesh
    face: Int[Tensor, " n"]

    def __post_init__(self):
        if self.face.ndim != 1 or self.face.dtype != torch.int64:
            raise ShapeError(f"face must be (N,) int64, not {tuple(self.face.shape)} {self.face.dtype}")
        if len(self.face) and (int(self.face.min()) < 0 or int(self.face.max()) >= self.mesh.n_faces):
            raise OptionError(
                f"face names {int(self.face.min())}..{int(self.face.max())}, but there are "
                f"{self.mesh.n_faces} triangles"
            )

    def __len__(self) -> int:
        """How many Gaussians are bound."""
        return len(self.face)

    @cached_property
    def faces(self) -> Int[Tensor, "faces 3"]:
        """Vertex indices of the mesh's triangles, where `face` is."""
        return torch.from_numpy(self.mesh.faces).to(self.face.device)

    @property
    def count(self) -> Int[Tensor, " faces"]:
        """Gaussians on each triangle of the mesh."""
        return torch.bincount(self.face, minlength=self.mesh.n_faces)

    @property
    def rest(self) -> Float[Tensor, "vertices 3"]:
        """Vertices of the mesh at rest in float64, metres, where `face` is."""
        return torch.from_numpy(self.mesh.vertices).to(self.face.device)

    def to(self, device: torch.device | str) -> "Binding":
        """On another device."""
        return Binding(self.mesh, self.face.to(device))

    def to_world(
        self, local: Gaussians, vertices: Vertices, rotate_sh: bool = False, backend: str = "auto"
    ) -> Gaussians:
        """Gaussians where the triangles of a posed mesh take them.

        Gradients reach the local Gaussians and the vertices, and are finite on triangles without area too.

        Parameters
        ----------
        local : Gaussians
            N of them, in their triangles' frames.
        vertices : (V, 3) or (..., V, 3) float
            Posed vertices, metres: one frame or a batch. Of the Gaussians' type and device.
        rotate_sh : bool
            If true, spherical harmonics are the triangle's and turn with it; otherwise they are the world's
            (as in GaussianAvatars), so that shading by direction stays where it is when the head turns.
        backend : str
            "native" (C++, CPU, float32), "reference" (torch: any device and type) or "auto": native where it
            is built and applies.

        Returns
        -------
        Gaussians
            means, quaternions and scales with the batch of vertices and Gaussians, and sh if it turns; the
            other fields are the very same tensors.

        Raises
        ------
        ShapeError
            If vertices or Gaussians are of another number, type or device.
        OptionError, BackendError
            An unknown backend; one that is not there.
        """
        self._check(local, vertices)
        fields = local.means, local.quaternions, local.scales
        batch = torch.broadcast_shapes(vertices.shape[:-2], *(field.shape[:-2] for field in fields))
        if _choose(backend, vertices) == "native":
            count = batch.numel()
            flat = to_world_native(
                _rows(vertices, batch).expand(count, -1, -1),
                _rows(local.means, batch),
                _rows(local.quaternions, batch),
                _rows(local.scales, batch),
                self._lists,
            )
            means, quaternions, scales = (field.reshape(*batch, *field.shape[-2:]) for field in flat)
        else:
            means, quaternions, scales = (
                field.expand(*batch, -1, -1) for field in self._reference(*fields, vertices)
            )
        sh = local.sh
        if rotate_sh and sh is not None:
            sh = rotate_harmonics(sh, triangle_frames(vertices, self.faces).rotation, self.face)
        return Gaussians(means, quaternions, scales, local.opacities, local.colors, sh)

    def _reference(
        self, means: Tensor, quaternions: Tensor, scales: Tensor, vertices: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        frames = triangle_frames(vertices, self.faces)
        turn = roma.rotmat_to_unitquat(frames.rotation).index_select(-2, self.face)
        scale = frames.scale.index_select(-1, self.face)[..., None]
        rotation, origin = (
            frames.rotation.index_select(-3, self.face),
            frames.origin.index_select(-2, self.face),
        )
        own = roma.quat_wxyz_to_xyzw(torch.nn.functional.normalize(quaternions, dim=-1))
        return (
            scale * (rotation @ means[..., None])[..., 0] + origin,
            roma.quat_xyzw_to_wxyz(roma.quat_product(*torch.broadcast_tensors(turn, own))),
            scale * scales,
        )

    def to_local(self, world: Gaussians, vertices: Vertices, rotate_sh: bool = False) -> Gaussians:
        """The inverse of `to_world`: what any Gaussians in the world are in the frames of their triangles.

        Raises
        ------
        ShapeError
            If vertices or Gaussians are of another number, type or device.
        MeshError
            If a triangle with Gaussians is a point, so that nothing has a place in its frame.
        """
        self._check(world, vertices)
        frames = triangle_frames(vertices, self.faces)
        scale = frames.scale.index_select(-1, self.face)[..., None]
        if bool((scale == 0).any()):
            flat = self.face[(scale == 0).reshape(-1, len(self), 1).any(0)[:, 0]]
            raise MeshError(
                f"{len(torch.unique(flat))} triangles with Gaussians are points, the first is face "
                f"{int(flat.min())}: Gaussians have no place in their frames"
            )
        back = frames.rotation.mT.index_select(-3, self.face)
        means = (back @ (world.means - frames.origin.index_select(-2, self.face))[..., None])[..., 0] / scale
        turn = roma.quat_conjugation(roma.rotmat_to_unitquat(frames.rotation)).index_select(-2, self.face)
        own = roma.quat_wxyz_to_xyzw(torch.nn.functional.normalize(world.quaternions, dim=-1))
        quaternions = roma.quat_xyzw_to_wxyz(roma.quat_product(*torch.broadcast_tensors(turn, own)))
        sh = world.sh
        if rotate_sh and sh is not None:
            sh = rotate_harmonics(sh, frames.rotation.mT, self.face)
        return Gaussians(means, quaternions, world.scales / scale, world.opacities, world.colors, sh)

    def initial_gaussians(
        self,
        scales: tuple[float, float, float] = (0.5, 0.12, 0.5),
        opacity: float = 0.6,
        color: tuple[float, ...] = (0.5, 0.5, 0.5),
        sh_degree: int | None = None,
        dtype: torch.dtype = torch.float32,
    ) -> Gaussians:
        """Local Gaussians that cover the mesh: flat on their triangles, of one colour.

        A single Gaussian sits at its triangle's centroid; several are spread evenly over it and smaller by
        the square root of their number.

        Parameters
        ----------
        scales : 3 float
            Of a triangle's only Gaussian, in units of the triangle: along the first side, the normal, across.
            GaussianAvatars starts from 1, 1, 1.
        opacity : float
            0 to 1; 0.1 in GaussianAvatars.
        color : D float
            In [0, 1].
        sh_degree : int, optional
            If given, spherical harmonics of this degree, whose first coefficient gives the colour (D = 3).
        dtype : torch.dtype
            Of the Gaussians.

        Raises
        ------
        OptionError
            If a value is out of range.
        """
        if min(scales) <= 0 or not 0 <= opacity <= 1:
            raise OptionError(
                f"scales must be positive and opacity within 0 to 1, not {scales} and {opacity}"
            )
        if sh_degree is not None and (sh_degree not in range(len(COEFFICIENTS)) or len(color) != 3):
            raise OptionError(
                f"sh_degree must be 0 to 3 with three colours, not {sh_degree} with {len(color)}"
            )
        frames = triangle_frames(self.rest, self.faces)
        points = (_spread(self._rank)[..., None] * self.rest[self.faces[self.face]]).sum(1)
        offset = (frames.rotation[self.face].mT @ (points - frames.origin[self.face])[..., None])[..., 0]
        size = frames.scale[self.face, None]
        means = torch.where(size > 0, offset / torch.where(size > 0, size, 1.0), 0.0)
        shared = self.count[self.face, None].double().rsqrt()
        tone = means.new_tensor(color).expand(len(self), -1)
        sh = None
        if sh_degree is not None:
            rest = means.new_zeros(len(self), COEFFICIENTS[sh_degree] - 1, 3)
            sh = torch.cat([(tone[:, None] - 0.5) / harmonics(means.new_zeros(3), 0), rest], 1)
        return Gaussians(
            means,
            means.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(self), 1),
            shared * means.new_tensor(scales),
            means.new_full((len(self),), opacity),
            tone if sh is None else None,
            sh,
        ).map(lambda field: field.to(dtype, copy=True))

    def select(self, which: Int[Tensor, " chosen"] | Bool[Tensor, " n"]) -> "Binding":
        """The binding of the Gaussians at these indices, or where a mask is true."""
        return Binding(self.mesh, self.face[which])

    def keep_one_per_face(self, keep: Bool[Tensor, " n"], rank: Float[Tensor, " n"]) -> Bool[Tensor, " n"]:
        """A mask that leaves no triangle empty that has Gaussians now: its highest one stays, if none would.

        Parameters
        ----------
        keep : (N,) bool
            Which ones would stay.
        rank : (N,) float
            Decides who stays on a triangle that would be empty, such as opacity; the first of equals.
        """
        emptied = torch.bincount(self.face[keep], minlength=self.mesh.n_faces) == 0
        candidates = emptied[self.face].nonzero()[:, 0]
        candidates = candidates[torch.argsort(rank[candidates], descending=True, stable=True)]
        candidates = candidates[torch.argsort(self.face[candidates], stable=True)]
        face = self.face[candidates]
        first = torch.ones_like(face, dtype=torch.bool)
        first[1:] = face[1:] != face[:-1]
        kept = keep.clone()
        kept[candidates[first]] = True
        return kept

    def prune(self, local: Gaussians, keep: Bool[Tensor, " n"]) -> Refinement:
        """Remove Gaussians; a triangle that would be empty keeps its most opaque one."""
        self._check(local)
        opacities = local.opacities.detach().reshape(-1, len(self)).amax(0)
        parent = self.keep_one_per_face(keep, opacities).nonzero()[:, 0]
        fresh = torch.zeros_like(parent, dtype=torch.bool)
        return Refinement(self.select(parent), local.select(parent), parent, fresh)

    def clone(self, local: Gaussians, which: Int[Tensor, " chosen"] | Bool[Tensor, " n"]) -> Refinement:
        """Add a copy of each of these Gaussians on the same triangle."""
        self._check(local)
        everyone = torch.arange(len(self), device=self.face.device)
        parent = torch.cat([everyone, everyone[which]])
        return Refinement(self.select(parent), local.select(parent), parent, _last(parent, len(self)))

    def split(
        self,
        local: Gaussians,
        which: Int[Tensor, " chosen"] | Bool[Tensor, " n"],
        count: int = 2,
        generator: torch.Generator | None = None,
    ) -> Refinement:
        """Replace each of these Gaussians by smaller ones drawn from it, on the same triangle.

        After Kerbl et al. 2023 (adaptive density control): a child's centre is drawn from the parent and its
        scale is the parent's divided by 0.8 `count`. All of it in local units. (GaussianAvatars' code draws
        with the deviation in world units and adds the offset to local coordinates, so that the children of a
        triangle of millimetres lie on top of each other.)

        Parameters
        ----------
        local : Gaussians
            Without a batch.
        which : (n,) int or (N,) bool
            Which ones.
        count : int
            Children each, 2 or more.
        generator : torch.Generator, optional
            Randomness.

        Raises
        ------
        OptionError
            If `count` is less than 2.
        ShapeError
            If the Gaussians have a batch.
        """
        self._check(local)
        if count < 2:
            raise OptionError(f"count must be 2 or more, not {count}")
        if local.batch_shape:
            raise ShapeError(f"split takes Gaussians without a batch, not of {tuple(local.batch_shape)}")
        everyone = torch.arange(len(self), device=self.face.device)
        stays = torch.ones_like(self.face, dtype=torch.bool)
        stays[which] = False
        parent = torch.cat([everyone[stays], everyone[~stays].repeat(count)])
        fresh = _last(parent, int(stays.sum()))
        drawn = local.select(parent[fresh])
        noise = torch.randn(drawn.scales.shape, generator=generator, dtype=drawn.scales.dtype)
        unit = torch.nn.functional.normalize(drawn.quaternions, dim=-1)
        axes = roma.unitquat_to_rotmat(roma.quat_wxyz_to_xyzw(unit))
        offsets = (axes @ (drawn.scales * noise.to(drawn.scales))[..., None])[..., 0]
        children = Gaussians(
            drawn.means + offsets,
            drawn.quaternions,
            drawn.scales / (0.8 * count),
            drawn.opacities,
            drawn.colors,
            drawn.sh,
        )
        gaussians = Gaussians.concatenate([local.select(everyone[stays]), children])
        return Refinement(self.select(parent), gaussians, parent, fresh)

    def to_mesh(
        self,
        local: Gaussians,
        target: TriangleMesh | Subdivision | SurfaceCorrespondence,
        rotate_sh: bool = False,
    ) -> tuple["Binding", Gaussians]:
        """Bind the same Gaussians to the triangles of another mesh.

        Parameters
        ----------
        local : Gaussians
            Without a batch.
        target : Subdivision, TriangleMesh or SurfaceCorrespondence
            A subdivision of this mesh: each Gaussian goes to the child of its triangle that is closest at
            rest. Another mesh in the same place and pose: to the triangle closest to it whose normal agrees.
            At rest, the world's Gaussians do not change. A correspondence from this mesh to one of another
            shape: the Gaussians are first carried onto the target, by the deformation of the registration.
        rotate_sh : bool
            Whether spherical harmonics are the triangles' own (as in `to_world`).

        Returns
        -------
        Binding, Gaussians
            On the target; triangles of it may have none.

        Raises
        ------
        ShapeError
            If the subdivision or correspondence is of another mesh, or the Gaussians have a batch.
        """
        self._check(local)
        if local.batch_shape:
            raise ShapeError(f"to_mesh takes Gaussians without a batch, not of {tuple(local.batch_shape)}")
        posed = self.mesh
        if isinstance(target, SurfaceCorrespondence):
            if not np.array_equal(target.source.faces, self.mesh.faces):
                raise ShapeError(
                    f"the correspondence is from {target.source!r}, the Gaussians are on {self.mesh!r}"
                )
            posed = self.mesh.with_vertices(target.registered)
        exact = local.detach().to(torch.float64)
        world = self.to_world(exact, torch.from_numpy(posed.vertices).to(self.face.device), rotate_sh)
        means, face = world.means.cpu().numpy(), self.face.cpu().numpy()
        if isinstance(target, Subdivision):
            if target.parent.max(initial=-1) != self.mesh.n_faces - 1:
                raise ShapeError(
                    f"the subdivision is of {target.parent.max(initial=-1) + 1} triangles, the Gaussians are "
                    f"on {self.mesh.n_faces}"
                )
            mesh, new_face = target.mesh, _closest_child(target, means, face)
        else:
            mesh = target.target if isinstance(target, SurfaceCorrespondence) else target
            *_, new_face, _ = agreeing_points(mesh, means, posed.face_normals[face])
        binding = Binding(mesh, torch.from_numpy(new_face).to(self.face.device))
        moved = binding.to_local(world, binding.rest, rotate_sh)
        return binding, moved.to(local.means.dtype)

    @property
    def _rank(self) -> Tensor:
        """How many Gaussians of the same triangle come before each."""
        order = torch.argsort(self.face, stable=True)
        start = torch.cumsum(self.count, 0) - self.count
        rank = torch.empty_like(self.face)
        rank[order] = torch.arange(len(self), device=self.face.device) - start[self.face[order]]
        return rank

    @cached_property
    def _lists(self) -> BindingLists:
        return BindingLists.of(self.mesh.faces, self.mesh.n_vertices, self.face)

    def _check(self, gaussians: Gaussians, vertices: Tensor | None = None) -> None:
        if len(gaussians) != len(self):
            raise ShapeError(f"{len(gaussians)} Gaussians given, {len(self)} are bound")
        if gaussians.means.device != self.face.device:
            raise ShapeError(
                f"the Gaussians are on {gaussians.means.device}, the binding on {self.face.device}: "
                "use binding.to(device)"
            )
        if vertices is None:
            return
        if vertices.ndim < 2 or tuple(vertices.shape[-2:]) != (self.mesh.n_vertices, 3):
            raise ShapeError(
                f"vertices must be (..., {self.mesh.n_vertices}, 3), not {tuple(vertices.shape)}"
            )
        if vertices.dtype != gaussians.means.dtype or vertices.device != gaussians.means.device:
            raise ShapeError(
                f"vertices are {vertices.dtype} on {vertices.device}, the Gaussians "
                f"{gaussians.means.dtype} on {gaussians.means.device}"
            )


def _choose(backend: str, vertices: Tensor) -> str:
    if backend not in BACKENDS:
        raise OptionError(f"backend {backend!r} is not one of {', '.join(BACKENDS)}")
    fits = vertices.device.type == "cpu" and vertices.dtype == torch.float32
    if backend == "auto":
        return "native" if fits and available() else "reference"
    if backend == "native" and not available():
        raise BackendError(
            "backend 'native' is not built: install meshanim with a C++17 compiler at hand, "
            "or use backend='reference'"
        )
    if backend == "native" and not fits:
        raise BackendError(
            f"backend 'native' computes float32 on the CPU, not {vertices.dtype} on {vertices.device}: "
            "use backend='reference'"
        )
    return backend


def _rows(field: Tensor, batch: torch.Size) -> Tensor:
    """One leading dimension: of a single frame if all share the field, of all frames otherwise."""
    shared = field.shape[:-2].numel() == 1
    return (field if shared else field.expand(*batch, -1, -1)).reshape(
        1 if shared else batch.numel(), *field.shape[-2:]
    )


def _last(parent: Tensor, kept: int) -> Tensor:
    return torch.arange(len(parent), device=parent.device) >= kept


def _spread(rank: Tensor) -> Tensor:
    """Barycentric coordinates of the first, second, ... of evenly spread points of a triangle."""
    # Roberts's R2 sequence from the centroid on, folded from the square into the triangle.
    step = torch.tensor([0.7548776662466927, 0.5698402909980532], dtype=torch.float64, device=rank.device)
    square = torch.remainder(1 / 3 + rank[:, None] * step, 1.0)
    folded = torch.where(square.sum(1, keepdim=True) > 1, 1 - square, square)
    return torch.cat([1 - folded.sum(1, keepdim=True), folded], 1)


def _closest_child(subdivision: Subdivision, points: np.ndarray, face: np.ndarray) -> np.ndarray:
    """(N,) child of each parent face that is closest to each point."""
    start, end = (np.searchsorted(subdivision.parent, face, side) for side in ("left", "right"))
    counts = end - start
    begin = np.cumsum(counts) - counts
    owner = np.repeat(np.arange(len(points)), counts)
    child = np.arange(len(owner)) - begin[owner] + start[owner]
    corners = subdivision.mesh.vertices[subdivision.mesh.faces[child]]
    weights = barycentric_coordinates(points[owner], corners)
    square = ((np.einsum("nk,nkd->nd", weights, corners) - points[owner]) ** 2).sum(1)
    order = np.lexsort((child, square, owner))
    return child[order[begin]]
