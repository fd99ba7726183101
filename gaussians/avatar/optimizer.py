"""Adam with a rate a group, whose state follows the Gaussians when some are added or removed."""

import math

import torch
from torch import nn

from meshanim.gaussians.avatar.density import Refined
from meshanim.gaussians.avatar.model import GAUSSIAN_FIELDS, Avatar
from meshanim.gaussians.avatar.settings import FitSettings, Rate

__all__ = ["carry", "forget_opacities", "make_optimizer", "rate_at"]


def make_optimizer(
    avatar: Avatar, tracked: nn.Module | None, settings: FitSettings, extent: float
) -> torch.optim.Adam:
    """Adam over the avatar and, where it is refined, the tracking; a group a `settings.rates` entry."""
    groups = {name: [getattr(avatar, name)] for name in GAUSSIAN_FIELDS if getattr(avatar, name).numel()}
    if avatar.colors is not None:
        groups["network"] = list(avatar.colors.parameters())
    if tracked is not None:
        for name, parameter in tracked.named_parameters():
            groups.setdefault(name if name in ("expression", "translation") else "pose", []).append(parameter)
    described = []
    for name, parameters in groups.items():
        factor = extent if name == "means" and settings.extent_means else 1.0
        described.append({"params": parameters, "name": name, "lr": 0.0, "factor": factor})
    return torch.optim.Adam(described, betas=settings.betas, eps=1e-15, fused=True)


def rate_at(rate: Rate, step: int, steps: int) -> float:
    """The learning rate at a step, counted from 0.

    The fall is exponential from `level` on: start * end^((x - level) / (1 - level)) at share x of the run,
    times delay_factor + (1 - delay_factor) sin(pi / 2 min(step / delay, 1)) (Yu et al., "Plenoxels", 2022).
    """
    share = step / max(steps, 1)
    value = rate.start
    if share > rate.level:
        value *= rate.end ** ((share - rate.level) / (1 - rate.level))
    if rate.delay:
        rise = math.sin(math.pi / 2 * min(step / rate.delay, 1.0))
        value *= rate.delay_factor + (1 - rate.delay_factor) * rise
    return value


def carry(optimizer: torch.optim.Optimizer, avatar: Avatar, refined: Refined) -> None:
    """Turn to the avatar's new parameters after a refinement.

    Moments of the Gaussians that remain follow them; new ones have no momentum and the parent's second one.
    """
    for group in optimizer.param_groups:
        if group["name"] not in GAUSSIAN_FIELDS:
            continue
        (before,), after = group["params"], getattr(avatar, group["name"])
        group["params"] = [after]
        state = optimizer.state.pop(before, None)
        if state:
            for key in ("exp_avg", "exp_avg_sq"):
                state[key] = state[key][refined.parent]
            state["exp_avg"][refined.fresh] = 0
            optimizer.state[after] = state


def forget_opacities(optimizer: torch.optim.Optimizer, avatar: Avatar) -> None:
    """After a reset: what Adam knew of the opacities holds no more."""
    for key in ("exp_avg", "exp_avg_sq"):
        optimizer.state[avatar.opacities][key].zero_()
