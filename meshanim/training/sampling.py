"""Which frames a batch has, as a function of its number: windows of frames, or whole sequences."""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from meshanim.errors import OptionError

__all__ = ["Sampler", "SequenceSampler", "Span", "WindowSampler"]

POOL = 16
"""Batches whose sequences are sorted by length together."""


class Span(NamedTuple):
    """Consecutive frames of a clip, and the chances that belong to them.

    Parameters
    ----------
    clip, first, frames : int
        Which frames.
    draw : int
        A random number from 0 on, for a choice by its remainder.
    coin : float
        A random number in [0, 1).
    """

    clip: int
    first: int
    frames: int
    draw: int
    coin: float


class Sampler(Protocol):
    """What a task needs to know of a way to make batches."""

    def spans(self, number: int, share: int = 0, shares: int = 1) -> list[Span]:
        """One of `shares` equal parts of a batch that is as many times as large as this sampler's.

        Processes take a share each: together they see what one process with the larger batch sees.
        """


class _Chances:
    """The random numbers of an epoch's spans."""

    def __init__(self, count: int, seed: int, epoch: int):
        self.generator = torch.Generator().manual_seed(seed * 1_000_003 + epoch)
        self.order = torch.randperm(count, generator=self.generator)
        self.draws = torch.randint(2**31, (count,), generator=self.generator).tolist()
        self.coins = torch.rand(count, generator=self.generator).tolist()


class WindowSampler:
    """Windows of consecutive frames: every epoch is a new permutation of all of them, cut at a new offset.

    Parameters
    ----------
    lengths : sequence of int
        Frames of each clip; clips shorter than a window are left out.
    frames : int
        Consecutive frames a window.
    windows : int
        Windows a batch.
    seed : int
        Of the order.
    """

    def __init__(self, lengths: Sequence[int], frames: int, windows: int, seed: int = 0):
        self.lengths, self.frames, self.windows, self.seed = list(lengths), frames, windows, seed
        self.slots = [(clip, k) for clip, n in enumerate(lengths) for k in range(n // frames)]
        if not self.slots:
            raise OptionError(f"no clip has the {frames} consecutive frames of a window")
        self._epoch: tuple[int, _Chances, Tensor] | None = None

    def spans(self, number: int, share: int = 0, shares: int = 1) -> list[Span]:
        """As `Sampler` says."""
        spans = []
        start = (number * shares + share) * self.windows
        for position in range(start, start + self.windows):
            epoch, place = divmod(position, len(self.slots))
            if self._epoch is None or self._epoch[0] != epoch:
                chances = _Chances(len(self.slots), self.seed, epoch)
                offsets = torch.randint(self.frames, (len(self.lengths),), generator=chances.generator)
                self._epoch = (epoch, chances, offsets)
            _, chances, offsets = self._epoch
            slot = int(chances.order[place])
            clip, k = self.slots[slot]
            first = min(k * self.frames + int(offsets[clip]), self.lengths[clip] - self.frames)
            spans.append(Span(clip, first, self.frames, chances.draws[slot], chances.coins[slot]))
        return spans


class SequenceSampler:
    """Whole sequences of like length: an epoch's permutation is sorted by length within pools of batches.

    The sequences that are left when an epoch's last batch would not be full are others in every epoch.

    Parameters
    ----------
    lengths : sequence of int
        Frames of each clip; clips of one frame are left out.
    sequences : int
        Sequences a batch.
    seed : int
        Of the order.
    """

    def __init__(self, lengths: Sequence[int], sequences: int, seed: int = 0):
        self.lengths, self.sequences, self.seed = list(lengths), sequences, seed
        self.clips = [clip for clip, frames in enumerate(lengths) if frames >= 2]
        self._epoch: tuple[tuple[int, int], list[list[int]], _Chances] | None = None

    def spans(self, number: int, share: int = 0, shares: int = 1) -> list[Span]:
        """As `Sampler` says.

        Raises
        ------
        OptionError
            If the larger batch has more sequences than there are.
        """
        size = self.sequences * shares
        batches = len(self.clips) // size
        if batches == 0:
            raise OptionError(f"a batch of {size} sequences is larger than the data: {len(self.clips)}")
        epoch, place = divmod(number, batches)
        if self._epoch is None or self._epoch[0] != (epoch, size):
            chances = _Chances(len(self.clips), self.seed, epoch)
            plan: list[list[int]] = []
            for pool in chances.order[: batches * size].split(POOL * size):
                ordered = sorted(pool.tolist(), key=lambda slot: self.lengths[self.clips[slot]])
                plan += [ordered[k : k + size] for k in range(0, len(ordered), size)]
            mixed = torch.randperm(batches, generator=chances.generator)
            self._epoch = ((epoch, size), [plan[k] for k in mixed.tolist()], chances)
        _, plan, chances = self._epoch
        return [
            Span(
                self.clips[slot], 0, self.lengths[self.clips[slot]], chances.draws[slot], chances.coins[slot]
            )
            for slot in plan[place][share::shares]
        ]
