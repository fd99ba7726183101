"""The noise of diffusion: cosine schedule, few steps of many, one step back."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from meshanim.errors import OptionError, ShapeError

__all__ = ["CosineSchedule", "FrameNoise", "Step"]

OFFSET, LARGEST_BETA = 0.008, 0.999


class Step(NamedTuple):
    """One denoising step: x_before = clean * x0 + noisy * x_t + deviation * noise."""

    time: int
    clean: float
    noisy: float
    deviation: float


@dataclass(frozen=True)
class CosineSchedule:
    """Cosine schedule (Nichol and Dhariwal, ICML 2021, Eq. 17) over `steps` steps; 1000 in the paper.

    Parameters
    ----------
    steps : int
        T.

    Raises
    ------
    OptionError
        If there are none.
    """

    steps: int = 1000

    def __post_init__(self):
        if self.steps < 1:
            raise OptionError(f"steps must be at least 1, not {self.steps}")

    @property
    def kept(self) -> Float64[np.ndarray, " steps"]:
        """Share of the variance that is signal after each step, alpha-bar (Eq. 10)."""
        at = np.arange(self.steps + 1) / self.steps
        signal = np.cos((at + OFFSET) / (1 + OFFSET) * math.pi / 2) ** 2
        beta = np.minimum(1 - signal[1:] / signal[:-1], LARGEST_BETA)
        return np.cumprod(1 - beta)

    def noised(
        self, clean: Float[Tensor, "batch frames numbers"], noise: Tensor, times: Tensor
    ) -> Float[Tensor, "batch frames numbers"]:
        """X_t = sqrt(alpha-bar_t) X_0 + sqrt(1 - alpha-bar_t) noise, at a time for each row (Eq. 10)."""
        kept = torch.from_numpy(self.kept).to(clean.device)[times][:, None, None]
        return kept.sqrt().to(clean.dtype) * clean + (1 - kept).sqrt().to(clean.dtype) * noise

    def sampling(self, count: int) -> tuple[Step, ...]:
        """Steps from pure noise to the result: `count` times, evenly spread, the first and last among them.

        DDPM's posterior (Ho et al., NeurIPS 2020, Eq. 7) with the schedule of those times alone.

        Raises
        ------
        OptionError
            If count is not between 1 and `steps`.
        """
        if not 1 <= count <= self.steps:
            raise OptionError(f"{count} denoising steps; expected 1 to {self.steps}")
        times = np.rint(np.linspace(0, self.steps - 1, count)).astype(int) if count > 1 else [self.steps - 1]
        kept = self.kept[times]
        before = np.concatenate([[1.0], kept[:-1]])
        beta = 1 - kept / before
        clean = np.sqrt(before) * beta / (1 - kept)
        noisy = np.sqrt(1 - beta) * (1 - before) / (1 - kept)
        deviation = np.sqrt(beta * (1 - before) / (1 - kept))
        rows = zip(map(int, times), clean.tolist(), noisy.tolist(), deviation.tolist())
        return tuple(Step(*row) for row in rows)[::-1]


class FrameNoise:
    """Normal noise by frame: the same for a stream and for the whole, in whatever portions it is asked for.

    Parameters
    ----------
    steps, width : int
        Noises a frame, and numbers of each.
    seed : int
        Same seed, same noise.
    given : (steps or more, T, width), optional
        Noise from elsewhere instead.

    Raises
    ------
    ShapeError
        If what is given has another shape.
    """

    def __init__(
        self,
        steps: int,
        width: int,
        seed: int = 0,
        given: Float[Tensor, "steps frames numbers"] | None = None,
    ):
        if given is not None and (given.shape[0] < steps or given.shape[2] != width):
            raise ShapeError(f"noise has shape {tuple(given.shape)}; expected ({steps}, frames, {width})")
        self.steps, self.width, self.given = steps, width, given
        self.generator = torch.Generator().manual_seed(seed)
        self.first = 0
        self.kept: list[Tensor] = []

    def frames(self, first: int, last: int) -> Float[Tensor, "steps frames numbers"]:
        """Noise of frames from one to before another; frames before it will not be asked for again.

        Raises
        ------
        ShapeError
            If noise that was given does not last.
        """
        if self.given is not None:
            if last > self.given.shape[1]:
                raise ShapeError(
                    f"noise is given for {self.given.shape[1]} frames, frame {last - 1} is asked for"
                )
            return self.given[: self.steps, first:last]
        self.kept, self.first = self.kept[first - self.first :], first
        while self.first + len(self.kept) < last:
            self.kept.append(torch.randn(self.steps, self.width, generator=self.generator))
        return torch.stack(self.kept[: last - first], dim=1)
