"""Lips that seal: the last millimetres between the lips are closed where speech says p, b or m."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from meshanim.errors import OptionError
from meshanim.heads import Head

__all__ = [
    "LipSeal",
    "head_lip_pairs",
    "head_lip_seal",
    "seal_envelope",
    "sealed_frames",
    "sealed_steps",
]


def sealed_steps(
    posterior: Float[Tensor, " steps"], threshold: float = 0.35, pair_threshold: float = 0.2
) -> Bool[Tensor, " steps"]:
    """Feature steps in which the lips touch: p, b or m is likely, or fairly likely twice in a row.

    A step is sealed where its probability is above `threshold`, or above `pair_threshold` twice in a row.
    Asked of the features themselves, not of animation frames, which step over short bilabials. On recorded
    speech (tests/audio/data, features at 50 a second) these values find 30 of 31 bilabials and seal 3.4 % of
    the frames that have none, most of them d, n, l and th, whose lips are close together.

    Parameters
    ----------
    posterior : (S,)
        Probability of p, b or m in each feature step.
    threshold, pair_threshold : float
        Probabilities.
    """
    likely = posterior > pair_threshold
    sealed = posterior > threshold
    sealed[1:] |= likely[1:] & likely[:-1]
    return sealed


def sealed_frames(
    steps: Bool[Tensor, " steps"], rate: float, fps: float, frames: int, first: int = 0, offset: int = 0
) -> Float[Tensor, " frames"]:
    """1 for animation frames in which any feature step is sealed, else 0.

    A frame has the steps whose middle is within it, and the one that its own middle is in.

    Parameters
    ----------
    steps : (S,) bool
        Of `sealed_steps`; nothing is sealed beyond them.
    rate, fps : float
        Feature steps and animation frames a second.
    frames : int
        How many, from frame `first` on.
    first : int
        Number of the first frame.
    offset : int
        Number of the first step.
    """
    frame = torch.arange(first, first + frames, dtype=torch.float64)
    ratio = rate / fps
    # Middles at k + 0.5 steps: those in [frame, frame + 1) * ratio.
    low = torch.minimum((frame * ratio - 0.5).ceil(), ((frame + 0.5) * ratio).floor()).long() - offset
    high = (
        torch.maximum(((frame + 1) * ratio - 0.5).ceil(), ((frame + 0.5) * ratio).floor() + 1).long() - offset
    )
    before = torch.cat([torch.zeros(1, dtype=torch.long), steps.long().cumsum(0).cpu()])
    count = before[high.clamp(0, len(steps))] - before[low.clamp(0, len(steps))]
    return (count > 0).to(steps.device, torch.float32)


def seal_envelope(
    sealed: Float[Tensor, " frames"], fps: float, ramp: float = 0.08
) -> Float[Tensor, " frames"]:
    """How far the lips should be sealed in each frame, 0 to 1.

    Around sealed frames the envelope falls as a squared cosine to zero within `ramp` seconds, so it looks no
    further ahead than that.

    Parameters
    ----------
    sealed : (T,)
        1 where the lips touch, else 0: `sealed_frames`.
    fps : float
        Frames a second.
    ramp : float
        Seconds.

    Raises
    ------
    OptionError
        If fps or ramp is not positive.
    """
    if not (fps > 0 and ramp > 0):
        raise OptionError(f"fps and ramp must be positive, not {fps} and {ramp}")
    envelope = sealed.clone()
    for distance in range(1, look_ahead(fps, ramp)):
        height = torch.cos(torch.tensor(torch.pi / 2 * distance / fps / ramp)).square().to(sealed)
        envelope[distance:] = torch.maximum(envelope[distance:], height * sealed[:-distance])
        envelope[:-distance] = torch.maximum(envelope[:-distance], height * sealed[distance:])
    return envelope


def look_ahead(fps: float, ramp: float = 0.08) -> int:
    """Frames after a frame that its envelope depends on."""
    return int(ramp * fps) + 1


@dataclass(frozen=True)
class LipSeal:
    """Closes what is left between the lips along a fixed field.

    Parameters
    ----------
    pairs : (P, 2) int
        Upper and lower lip vertices of the mouth's middle.
    closing : (V, 3) float
        How the lips come together: any multiple of, say, the shape mouthClose.
    overlap : float
        Metres by which sealed lips press into each other.
    largest : float
        Metres: the most that is ever closed, so that a wrong seal shuts no open jaw.
    ramp : float
        As in `seal_envelope`.
    """

    pairs: Int[Tensor, "pairs 2"]
    closing: Float[Tensor, "vertices 3"]
    overlap: float = 0.0003
    largest: float = 0.008
    ramp: float = 0.08

    def __post_init__(self):
        change = self._gaps(self.closing[None]).mean()
        if not change < 0:
            raise OptionError("the closing field does not bring the lip pairs together")
        # One unit closes the mean gap by one metre.
        object.__setattr__(self, "closing", self.closing / -change)

    def to(self, device: torch.device | str) -> "LipSeal":
        """On another device."""
        if self.closing.device == torch.device(device):
            return self
        return replace(self, pairs=self.pairs.to(device), closing=self.closing.to(device))

    def look_ahead(self, fps: float) -> int:
        """Frames that have to be known after the last one that can be sealed."""
        return look_ahead(fps, self.ramp)

    def envelope(self, sealed: Float[Tensor, " frames"], fps: float) -> Float[Tensor, " frames"]:
        """`seal_envelope` with this seal's ramp."""
        return seal_envelope(sealed, fps, ramp=self.ramp)

    def __call__(
        self, vertices: Float[Tensor, "frames vertices 3"], envelope: Float[Tensor, " frames"]
    ) -> Float[Tensor, "frames vertices 3"]:
        """Close the widest remaining gap of each frame by the envelope's share.

        Parameters
        ----------
        vertices : (T, V, 3)
            Metres, zero pose.
        envelope : (T,)
            0 leaves a frame as it is, 1 seals it.
        """
        gap = self._gaps(vertices).amax(1)
        amount = envelope * (gap + self.overlap).clamp(0, self.largest)
        return vertices + amount[:, None, None] * self.closing

    def _gaps(self, vertices: Tensor) -> Tensor:
        return vertices[:, self.pairs[:, 0], 1] - vertices[:, self.pairs[:, 1], 1]


def head_lip_seal(head: Head | None) -> LipSeal | None:
    """The seal of a head that declares lip pairs and has ARKit's mouthClose; None for any other."""
    pairs = head_lip_pairs(head)
    if head is None or pairs is None or "mouthClose" not in head.expression_names:
        return None
    closing = head.expression_directions[head.expression_names.index("mouthClose")]
    return LipSeal(torch.from_numpy(pairs), closing.unflatten(0, (-1, 3)))


def head_lip_pairs(head: Head | None) -> Int[np.ndarray, "pairs 2"] | None:
    """The lip pairs that a head declares; None where it has none."""
    pairs = getattr(head, "lip_pairs", None)
    return None if pairs is None else np.asarray(pairs, np.int64)
