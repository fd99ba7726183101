"""The head's parameters at every timestep of a capture, as they were tracked or as they are being refined."""

from collections.abc import Mapping
from dataclasses import fields

import torch
from torch import Tensor, nn

from meshanim.errors import OptionError
from meshanim.heads import HeadParameters

__all__ = ["Tracking", "parse_noise", "perturbed"]

POSED = ("expression", "rotation", "neck", "jaw", "eyes", "translation")


class Tracking(nn.Module):
    """A row of parameters a timestep, which learn; identity stays as it is.

    Parameters
    ----------
    parameters : HeadParameters
        Of the capture; a single row is one for every timestep. Rotation and translation are added as zeros
        where the capture has none: trackers err there too.
    timesteps : int
        How many there are.
    """

    def __init__(self, parameters: HeadParameters, timesteps: int):
        super().__init__()
        for name in POSED:
            value = getattr(parameters, name)
            if value is None and name in ("rotation", "translation"):
                value = torch.zeros(1, 3)
            if value is not None:
                rows = value.detach().expand(timesteps, -1).clone()
                self.register_parameter(name, nn.Parameter(rows))

    def at(self, timesteps: Tensor) -> HeadParameters:
        """Rows of some timesteps; identity is left to the avatar."""
        return HeadParameters(**{name: rows[timesteps] for name, rows in self.named_parameters()})

    def parameters_now(self) -> HeadParameters:
        """All rows, detached."""
        return HeadParameters(**{name: rows.detach() for name, rows in self.named_parameters()})


def parse_noise(text: str) -> dict[str, float]:
    """Standard deviations by name, from text like "rotation=0.01,translation=0.001,expression=0.03".

    Of expression in weights, of rotation, neck, jaw and eyes in radians, of translation in metres.

    Raises
    ------
    OptionError
        If a name or number is none.
    """
    noise: dict[str, float] = {}
    for entry in filter(None, text.split(",")):
        name, _, value = entry.partition("=")
        try:
            noise[name.strip()] = float(value)
        except ValueError as error:
            raise OptionError(f"tracking noise {entry!r} is no NAME=NUMBER") from error
    unknown = sorted(set(noise) - set(POSED))
    if unknown or any(not value >= 0 for value in noise.values()):
        raise OptionError(f"tracking noise is of {', '.join(POSED)}, not negative; not {text!r}")
    return noise


def perturbed(
    parameters: HeadParameters, timesteps: int, noise: Mapping[str, float], seed: int
) -> HeadParameters:
    """Parameters with independent normal errors at every timestep, as an imperfect tracker gives them."""
    generator = torch.Generator().manual_seed(seed)
    changed = {part.name: getattr(parameters, part.name) for part in fields(parameters)}
    for name in POSED:
        deviation = noise.get(name, 0.0)
        if not deviation:
            continue
        value = changed[name]
        if value is None:
            value = torch.zeros(1, 6 if name == "eyes" else 3)
        value = value.expand(timesteps, -1)
        changed[name] = value + deviation * torch.randn(value.shape, generator=generator)
    return HeadParameters(**changed)
