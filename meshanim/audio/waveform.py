"""`Waveform`: mono samples and their rate."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

__all__ = ["Waveform"]


@dataclass(frozen=True)
class Waveform:
    """Mono speech.

    Parameters
    ----------
    samples : (T,) float32
        Amplitudes, full scale is 1.
    rate : int
        Samples a second, Hz.
    """

    samples: Float[np.ndarray, " samples"]
    rate: int

    @property
    def duration(self) -> float:
        """Seconds."""
        return len(self.samples) / self.rate
