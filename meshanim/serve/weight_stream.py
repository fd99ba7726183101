"""Speech to blendshape weights while it is being spoken."""

import numpy as np
from jaxtyping import Float, Float32

from meshanim.animator import AnimationOptions, Animator
from meshanim.models.audio2face import EmotionTrack
from meshanim.motion.blendshape_solver import BlendshapeSolver

__all__ = ["WeightStream"]


class WeightStream:
    """Weights of one speech: the animator's stream, whose faces are solved as they come.

    Parameters
    ----------
    animator : Animator
        The network and the head.
    solver : BlendshapeSolver
        Of the head's shapes; shared by streams.
    rate : int
        Samples a second of the blocks to come.
    options : AnimationOptions, optional
        How it is performed.
    """

    def __init__(
        self,
        animator: Animator,
        solver: BlendshapeSolver,
        rate: int,
        options: AnimationOptions | None = None,
    ):
        self.stream = animator.open(rate, options)
        self.fps = self.stream.fps
        self._solving = solver.stream()
        self._shapes = len(solver.names)

    def feel(self, emotions: EmotionTrack) -> None:
        """Follow other emotions from the next frame on; as `AnimationStream.feel`."""
        self.stream.feel(emotions)

    def push(
        self, samples: Float32[np.ndarray, " samples"], last: bool = False
    ) -> Float[np.ndarray, "frames shapes"]:
        """Take the next samples; give the weights of the frames that they complete (maybe none).

        Parameters
        ----------
        samples : (S,)
            From -1 to 1.
        last : bool
            Whether the speech ends here.

        Raises
        ------
        ShapeError
            If a sample is NaN or infinite, or there were none at all at the end.
        """
        parts = [self.stream.push(samples)] if len(samples) else []
        if last:
            parts.append(self.stream.finish())
        weights = [self._solving.push(frames.vertices) for frames in parts if len(frames.vertices)]
        return np.concatenate(weights) if weights else np.zeros((0, self._shapes))
