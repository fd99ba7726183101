"""Lips that seal: the last millimetres between the lips are closed where speech says p, b or m."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from meshanim.errors import OptionError
from meshanim.heads import Head

__all__ = ["LipSeal", "head_lip_pairs", "head_lip_seal", "seal_envelope"]


def seal_envelope(
    posterior: Float[Tensor, " frames"],
    fps: float,
    threshold: float = 0.35,
    pair_threshold: float = 0.2,
    ramp: float = 0.08,
) -> Float[Tensor, " frames"]:
    """How far the lips should be sealed in each frame, 0 to 1.

    A frame is sealed where the probability of a bilabial is above `threshold`, or above `pair_threshold` in
    two frames in a row. On recorded speech (tests/audio/data) these values find 27 of 31 bilabials and seal
    2.6 % of the frames that have none; 0.5 and 0.35 find 21 and seal 1.5 %. Around sealed frames the envelope
    falls as a squared cosine to zero within `ramp` seconds, so it looks no further ahead than that.

    Parameters
    ----------
    posterior : (T,)
        Probability of p, b or m at each animation frame.
    fps : float
        Frames a second.
    threshold, pair_threshold : float
        Probabilities.
    ramp : float
        Seconds.

    Raises
    ------
    OptionError
        If fps or ramp is not positive.
    """
    if not (fps > 0 and ramp > 0):
        raise OptionError(f"fps and ramp must be positive, not {fps} and {ramp}")
    likely = posterior > pair_threshold
    paired = torch.zeros_like(likely)
    paired[1:] |= likely[:-1]
    paired[:-1] |= likely[1:]
    sealed = ((posterior > threshold) | (likely & paired)).to(posterior.dtype)
    envelope = sealed.clone()
    for distance in range(1, look_ahead(fps, ramp)):
        height = torch.cos(torch.tensor(torch.pi / 2 * distance / fps / ramp)).square().to(posterior)
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

    def look_ahead(self, fps: float) -> int:
        """Frames that have to be known after the last one that can be sealed."""
        return look_ahead(fps, self.ramp)

    def envelope(self, posterior: Float[Tensor, " frames"], fps: float) -> Float[Tensor, " frames"]:
        """`seal_envelope` with this seal's ramp."""
        return seal_envelope(posterior, fps, ramp=self.ramp)

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
