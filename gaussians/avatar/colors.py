"""Colour by expression: a small network shared by all Gaussians, fed with a few numbers of each."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from meshanim.errors import BackendError, OptionError
from meshanim.gaussians.avatar.colors_native import available, color_network

__all__ = ["ExpressionColors"]

BACKENDS = ("auto", "native", "reference")
Y0 = 0.28209479177387814  # the constant harmonic


class ExpressionColors(nn.Module):
    """What an expression adds to each Gaussian's colour (GaussianSpeech, Sec. 4.1, without the direction).

    The first layer sees [latent; expression]; the expression's part is the same for all Gaussians and
    computed once, so that an expression of any width costs nothing per Gaussian. It starts near zero.

    Parameters
    ----------
    latent, expression, hidden : int
        Numbers a Gaussian, numbers a frame, width of the two hidden layers.
    """

    def __init__(self, latent: int, expression: int, hidden: int):
        super().__init__()
        self.by_latent = nn.Parameter(torch.randn(latent, hidden) / latent**0.5)
        self.by_expression = nn.Parameter(torch.randn(expression, hidden) * 0.3)
        self.bias = nn.Parameter(torch.zeros(hidden))
        self.inner = nn.Parameter(torch.randn(hidden, hidden) / hidden**0.5)
        self.inner_bias = nn.Parameter(torch.zeros(hidden))
        self.outer = nn.Parameter(torch.randn(hidden, 3) * 0.01)

    def forward(
        self,
        latents: Float[Tensor, "n latent"],
        expression: Float[Tensor, "batch expression"],
        backend: str = "auto",
    ) -> Float[Tensor, "batch n 3"]:
        """Residual of the colours.

        Parameters
        ----------
        latents : (N, L) float
            Of the Gaussians.
        expression : (B, E) float
            Of the frames.
        backend : str
            "native" (C++, CPU, float32), "reference" (torch: any device and type) or "auto": native where it
            is built and applies.

        Raises
        ------
        OptionError, BackendError
            An unknown backend; one that is not there.
        """
        frame = expression @ self.by_expression + self.bias
        if _choose(backend, latents) == "native":
            return color_network(latents, frame, self.by_latent, self.inner, self.inner_bias, self.outer)
        hidden = torch.relu(latents @ self.by_latent + frame[:, None])
        return torch.relu(hidden @ self.inner + self.inner_bias) @ self.outer

    def harmonics(
        self,
        latents: Float[Tensor, "n latent"],
        expression: Float[Tensor, "batch expression"],
        sh0: Float[Tensor, "n 1 3"],
        sh_rest: Float[Tensor, "n rest 3"],
        backend: str = "auto",
    ) -> Float[Tensor, "batch n coefficients 3"]:
        """Harmonics whose colour is changed by the residual; natively they are written in the same pass.

        Parameters
        ----------
        latents, expression, backend
            As in `forward`.
        sh0, sh_rest : (N, 1, 3), (N, R, 3)
            The constant harmonic, which gets the residual, and the others.
        """
        if _choose(backend, latents) == "native":
            frame = expression @ self.by_expression + self.bias
            network = self.by_latent, self.inner, self.inner_bias, self.outer
            rows = color_network(latents, frame, *network, sh0.flatten(1), sh_rest.flatten(1), 1 / Y0)
            return rows.unflatten(-1, (-1, 3))
        changed = sh0 + self(latents, expression, backend)[..., None, :] / Y0
        return torch.cat([changed, sh_rest.expand(len(changed), -1, -1, -1)], -2)


def _choose(backend: str, latents: Tensor) -> str:
    if backend not in BACKENDS:
        raise OptionError(f"backend {backend!r} is not one of {', '.join(BACKENDS)}")
    fits = latents.device.type == "cpu" and latents.dtype == torch.float32
    if backend == "auto":
        return "native" if available() and fits else "reference"
    if backend == "native" and not available():
        raise BackendError(
            "backend 'native' is not built: install meshanim with a C++17 compiler at hand, "
            "or use backend='reference'"
        )
    if backend == "native" and not fits:
        raise BackendError(
            f"backend 'native' computes float32 on the CPU, not {latents.dtype} on {latents.device}: "
            "use backend='reference' or 'auto'"
        )
    return backend
