"""`Gaussians`: what a scene of 3D Gaussians is, before anything renders, binds or fits it."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from meshanim.errors import OptionError, ShapeError

__all__ = ["Gaussians"]

_TRAILING = {
    "means": (3,),
    "quaternions": (4,),
    "scales": (3,),
    "opacities": (),
    "colors": (None,),
    "sh": (None, 3),
}
_HARMONICS = (1, 4, 9, 16)


@dataclass(frozen=True)
class Gaussians:
    """3D Gaussians, activated (no logits, no logarithms), in any one space; for rendering, the world's.

    Leading dimensions are a batch, of frames for instance. A field that all share may be given without it:
    means (B, N, 3) with opacities (N,).

    Parameters
    ----------
    means : (..., N, 3) float
        Centres, metres.
    quaternions : (..., N, 4) float
        Orientations as (w, x, y, z); any length but zero, they are normalised where they are used.
    scales : (..., N, 3) float
        Standard deviations along the Gaussian's own axes, metres.
    opacities : (..., N) float
        In [0, 1].
    colors : (..., N, D) float, optional
        Any number of channels; three are red, green, blue in [0, 1].
    sh : (..., N, K, 3) float, optional
        Spherical harmonics in place of colors, K = 1, 4, 9 or 16 coefficients a channel (degree 0 to 3), in
        the order and with the signs of 3D Gaussian Splatting (Kerbl et al. 2023); the colour is their sum
        + 0.5, at least 0.

    Raises
    ------
    ShapeError
        If the shapes do not fit together, or types or devices differ.
    OptionError
        If not exactly one of colors and sh is given.
    """

    means: Float[Tensor, "*#batch n 3"]
    quaternions: Float[Tensor, "*#batch n 4"]
    scales: Float[Tensor, "*#batch n 3"]
    opacities: Float[Tensor, "*#batch n"]
    colors: Float[Tensor, "*#batch n channels"] | None = None
    sh: Float[Tensor, "*#batch n coefficients 3"] | None = None

    def __post_init__(self):
        if (self.colors is None) == (self.sh is None):
            raise OptionError("Gaussians need either colors or sh")
        given = self._given()
        for name, tensor in given.items():
            trailing = _TRAILING[name]
            shape = tuple(tensor.shape[tensor.ndim - len(trailing) - 1 :])
            fits = len(shape) == len(trailing) + 1 and all(
                w in (None, g) for g, w in zip(shape[1:], trailing)
            )
            if not fits:
                wanted = ", ".join(["..., N", *("D" if size is None else str(size) for size in trailing)])
                raise ShapeError(f"{name} must be ({wanted}), not {tuple(tensor.shape)}")
            if shape[0] != self.means.shape[-2]:
                raise ShapeError(f"{name} has {shape[0]} Gaussians, means has {self.means.shape[-2]}")
            if tensor.dtype != self.means.dtype or tensor.device != self.means.device:
                types = [f"{t.dtype} on {t.device}" for t in (tensor, self.means)]
                raise ShapeError(f"{name} is {types[0]}, means {types[1]}")
        if self.sh is not None and self.sh.shape[-2] not in _HARMONICS:
            raise ShapeError(f"sh must have 1, 4, 9 or 16 coefficients, not {self.sh.shape[-2]}")
        try:
            self.batch_shape  # noqa: B018, it raises where the fields do not fit together
        except RuntimeError as error:
            shapes = ", ".join(f"{name} {tuple(shape)}" for name, shape in self._batches().items())
            raise ShapeError(f"batch dimensions do not fit together: {shapes}") from error

    def _given(self) -> dict[str, Tensor]:
        named = self.__dict__
        return {name: named[name] for name in _TRAILING if named[name] is not None}

    def _batches(self) -> dict[str, torch.Size]:
        return {
            name: tensor.shape[: tensor.ndim - len(_TRAILING[name]) - 1]
            for name, tensor in self._given().items()
        }

    def __len__(self) -> int:
        """How many Gaussians there are."""
        return self.means.shape[-2]

    @cached_property
    def batch_shape(self) -> torch.Size:
        """The batch that all fields together span."""
        return _together(self._batches().values())

    @property
    def sh_degree(self) -> int | None:
        """0 to 3; None with plain colors."""
        return None if self.sh is None else _HARMONICS.index(self.sh.shape[-2])

    def map(self, function: Callable[[Tensor], Tensor]) -> "Gaussians":
        """The same with a function applied to every field."""
        return Gaussians(**{name: function(tensor) for name, tensor in self._given().items()})

    def to(self, *device_or_dtype: torch.device | torch.dtype | str) -> "Gaussians":
        """On another device or of another type."""
        return self.map(lambda tensor: tensor.to(*device_or_dtype))  # type: ignore[call-overload]

    def detach(self) -> "Gaussians":
        """Without gradients."""
        return self.map(torch.Tensor.detach)

    def select(self, which: Tensor) -> "Gaussians":
        """The Gaussians at these indices, or where a boolean mask is true."""
        if which.dtype == torch.bool:
            which = which.nonzero()[:, 0]
        taken = {
            name: tensor.index_select(tensor.ndim - len(_TRAILING[name]) - 1, which)
            for name, tensor in self._given().items()
        }
        return Gaussians(**taken)

    @classmethod
    def concatenate(cls, parts: "list[Gaussians]") -> "Gaussians":
        """Several scenes in one, in the order given; all with colors or all with sh.

        Raises
        ------
        ShapeError
            If the parts have different fields or batches.
        """
        names = {tuple(part._given()) for part in parts}
        batches = {tuple(part._batches().items()) for part in parts}
        if len(names) != 1 or len(batches) != 1:
            raise ShapeError("only Gaussians with the same fields and batch dimensions can be concatenated")
        joined = {
            name: torch.cat([getattr(part, name) for part in parts], -1 - len(_TRAILING[name]))
            for name in names.pop()
        }
        return cls(**joined)


def _together(shapes: Iterable[torch.Size]) -> torch.Size:
    """`torch.broadcast_shapes`, at once where all are equal."""
    distinct = set(shapes)
    return distinct.pop() if len(distinct) == 1 else torch.broadcast_shapes(*distinct)
