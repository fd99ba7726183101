"""Adding and removing Gaussians while an avatar is fitted; every triangle keeps at least one."""

from dataclasses import dataclass

import roma
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from meshanim.gaussians.avatar.model import GAUSSIAN_FIELDS, Avatar
from meshanim.gaussians.avatar.settings import Density

__all__ = ["DensityStatistics", "Refined", "refine"]

RESET_OPACITY = 0.01
SHRINK = 1.7  # "top": a half's scale along the axis that was split
APART = 0.55  # and how far it moves along it, in standard deviations of the parent


class DensityStatistics(nn.Module):
    """What is known of each Gaussian since the last refinement; part of a run's checkpoint.

    Attributes
    ----------
    gradient, seen, radius : (N,)
        Sum of the gradients' lengths, number of pictures with the Gaussian, largest radius in pixels.
    """

    def __init__(self, count: int):
        super().__init__()
        self.gradient: Tensor
        self.seen: Tensor
        self.radius: Tensor
        for name in ("gradient", "seen", "radius"):
            self.register_buffer(name, torch.zeros(count))

    def clear(self, count: int) -> None:
        """Start anew with so many Gaussians."""
        for name in ("gradient", "seen", "radius"):
            setattr(self, name, getattr(self, name).new_zeros(count))

    def add(
        self,
        gradient: Float[Tensor, " n"],
        visible: Bool[Tensor, " n"],
        radius: Int[Tensor, " n"] | None = None,
    ) -> None:
        """Count one picture; without radii where the rule has no use for them."""
        self.gradient += torch.where(visible, gradient, 0.0)
        self.seen += visible
        if radius is not None:
            self.radius = torch.maximum(self.radius, torch.where(visible, radius, 0))

    def _load_from_state_dict(self, state_dict, prefix, *more):
        self.clear(len(state_dict[prefix + "seen"]))
        super()._load_from_state_dict(state_dict, prefix, *more)

    @property
    def mean(self) -> Float[Tensor, " n"]:
        """Mean length of the gradient over the pictures a Gaussian is in."""
        return self.gradient / self.seen.clamp_min(1)


@dataclass(frozen=True)
class Refined:
    """What a refinement did.

    Parameters
    ----------
    parent : (M,) int64
        Which of the old Gaussians each new one comes from; rows of an optimiser's state follow it.
    fresh : (M,) bool
        Which ones are new: their momentum is zero.
    """

    parent: Int[Tensor, " m"]
    fresh: Bool[Tensor, " m"]


@torch.no_grad()
def refine(
    avatar: Avatar,
    statistics: DensityStatistics,
    density: Density,
    left: int,
    extent: float,
    was_reset: bool,
    seed: int,
) -> Refined:
    """Add and remove Gaussians by what `statistics` gathered, and clear it.

    Parameters
    ----------
    left : int
        Refinements to come, this one included ("top" shares what is missing among them).
    extent : float
        Radius of the scene, metres.
    was_reset : bool
        Whether opacities were reset before: large Gaussians then go too ("screen").
    seed : int
        Of where children are drawn.
    """
    grow = _top if density.rule == "top" else _screen
    parent, fresh, rows = grow(avatar, statistics, density, left, extent, seed)
    opaque = torch.sigmoid(rows["opacities"])
    keep = opaque >= density.prune_opacity
    if density.rule == "screen" and was_reset:
        size = rows["scales"].exp().amax(1) * _triangle_scale(avatar)[avatar.face[parent]]
        keep &= (size <= density.prune_scale * extent) & (statistics.radius[parent] <= density.prune_radius)
    face = avatar.face[parent]
    keep = avatar.binding.select(parent).keep_one_per_face(keep, opaque)
    avatar.replace(face[keep], {name: value[keep] for name, value in rows.items()})
    statistics.clear(len(avatar))
    return Refined(parent[keep], fresh[keep])


def reset_opacities(avatar: Avatar) -> None:
    """Make every Gaussian nearly transparent (Kerbl et al. 2023, Sec. 5.2)."""
    ceiling = torch.logit(torch.tensor(RESET_OPACITY))
    avatar.opacities.data.clamp_(max=float(ceiling))


def _triangle_scale(avatar: Avatar) -> Tensor:
    from meshanim.geometry import triangle_frames

    return triangle_frames(avatar.binding.rest, avatar.binding.faces).scale.to(avatar.means)


def _rows(avatar: Avatar, parent: Tensor) -> dict[str, Tensor]:
    return {name: getattr(avatar, name).detach()[parent].clone() for name in GAUSSIAN_FIELDS}


def _axes(rotations: Tensor) -> Tensor:
    unit = torch.nn.functional.normalize(rotations, dim=-1)
    return roma.unitquat_to_rotmat(roma.quat_wxyz_to_xyzw(unit))


def _top(avatar, statistics, density, left, extent, seed):
    """Halves of the Gaussians with the largest gradient, side by side along the parent's longest axis."""
    count = len(avatar)
    room = max(0, density.limit - count) // max(left, 1)
    chosen = torch.argsort(statistics.mean, descending=True, stable=True)[: min(room, count // 3)]
    chosen = chosen[torch.sigmoid(avatar.opacities[chosen]) >= density.prune_opacity].sort().values
    everyone = torch.arange(count, device=chosen.device)
    parent = torch.cat([everyone, chosen])
    rows = _rows(avatar, parent)
    axis = avatar.scales[chosen].argmax(1)
    along = torch.nn.functional.one_hot(axis, 3).to(avatar.means)
    # Local units: the offset is not to be multiplied by the triangle's scale.
    offset = (_axes(avatar.rotations[chosen]) @ (APART * along * avatar.scales[chosen].exp())[..., None])[
        ..., 0
    ]
    smaller = along * torch.log(torch.tensor(SHRINK)) + 0.05
    for half, sign in ((chosen, 1), (torch.arange(count, len(parent), device=chosen.device), -1)):
        rows["means"][half] += sign * offset
        rows["scales"][half] -= smaller
    return parent, torch.arange(len(parent), device=chosen.device) >= count, rows


def _screen(avatar, statistics, density, left, extent, seed):
    """Copies of small Gaussians; for large ones, two drawn from the parent (Kerbl et al. 2023, Sec. 5.1)."""
    size = avatar.scales.exp().amax(1) * _triangle_scale(avatar)[avatar.face]
    wanted = statistics.mean >= density.threshold
    small = size <= density.clone_below * extent
    everyone = torch.arange(len(avatar), device=size.device)
    split = everyone[wanted & ~small]
    stay = everyone[~(wanted & ~small)]
    parent = torch.cat([stay, everyone[wanted & small], split, split])
    rows = _rows(avatar, parent)
    children = slice(len(parent) - 2 * len(split), len(parent))
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn((2 * len(split), 3), generator=generator).to(avatar.means)
    drawn = (_axes(rows["rotations"][children]) @ (noise * rows["scales"][children].exp())[..., None])[..., 0]
    rows["means"][children] += drawn  # both in local units
    rows["scales"][children] -= float(torch.log(torch.tensor(0.8 * 2)))
    return parent, torch.arange(len(parent), device=size.device) >= len(stay), rows
