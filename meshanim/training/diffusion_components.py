"""The diffusion network in the coordinates of its data's components: what training steps need not compute."""

from collections.abc import Iterator

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from meshanim.models.audio2face.diffusion import Audio2FaceDiffusion, DiffusionConfig, Part
from meshanim.motion.animation_state import Actors, StateBasis

__all__ = ["ComponentDiffusion", "upper_shapes"]


class ComponentDiffusion(Audio2FaceDiffusion):
    """A network whose skin is coefficients of the basis' components, about their mean shape.

    The components are orthonormal, so normal noise on all vertices is normal noise on the coefficients, and
    squared errors are the same. Only the motion outside of them is missing, and the noise there, which says
    nothing of the motion. `gain` is the size of each number, for its layers to work near 1.
    """

    gain: Tensor

    def __init__(self, config: DiffusionConfig, actors: Actors):
        super().__init__(config, actors)
        self.register_buffer("gain", torch.ones(self.numbers))

    def forward(self, features: Tensor, noisy: Tensor, times: Tensor, emotions: Tensor, identities: Tensor):
        """As that of vertices."""
        return self.gain * super().forward(features, noisy / self.gain, times, emotions, identities)

    def _parts(self) -> Iterator[Part]:
        moved = 0
        for part in super()._parts():
            first, size = part.columns.start - moved, part.size
            if part.name == "skin":
                size = self.actors.basis.sizes["skin"]
                moved = part.size - size
            yield Part(part.name, slice(first, first + size), part.projected)

    @torch.no_grad()
    def folded(self) -> Audio2FaceDiffusion:
        """The same network of vertices."""
        basis = self.actors.basis
        components, own = basis.skin_components.flatten(1), self.parts[0].columns.stop
        count = components.shape[1]
        state = {name: value.cpu() for name, value in self.state_dict().items()}
        gain = state.pop("gain")[:own, None]
        state["geometry.0.weight"] = state["geometry.0.weight"] @ (components / gain)
        state["outputs.0.weight"] = (gain * components).T @ state["outputs.0.weight"]
        state["outputs.0.bias"] = (gain * components).T @ state["outputs.0.bias"]
        mean = basis.skin_mean.flatten() + state["mean"][:own] @ components
        for name, value in (("mean", mean), ("scale", state["scale"][:1].expand(count))):
            state[name] = torch.cat([value, state[name][own:]])
        network = Audio2FaceDiffusion(self.config, self.actors)
        network.load_state_dict(state)
        return network.eval()


def upper_shapes(basis: StateBasis, upper: Int64[Tensor, " upper"]) -> Float[Tensor, "components components"]:
    """Factor that brings coefficients to numbers whose mean square is that of the upper face's displacements.

    Parameters
    ----------
    basis : StateBasis
        Its skin.
    upper : (U,)
        The upper face, among the vertices of the skin.
    """
    shapes = basis.skin_components[:, upper].flatten(1).double()
    values, vectors = torch.linalg.eigh(shapes @ shapes.T)
    share = len(shapes) / max(shapes.shape[1], 1)
    return (vectors * (values.clamp_min(0) * share).sqrt()).float()
