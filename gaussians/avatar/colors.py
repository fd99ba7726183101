"""Colour by expression: a small network shared by all Gaussians, fed with a few numbers of each."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

__all__ = ["ExpressionColors"]


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
        self, latents: Float[Tensor, "n latent"], expression: Float[Tensor, "batch expression"]
    ) -> Float[Tensor, "batch n 3"]:
        """Residual of the colours."""
        frame = expression @ self.by_expression + self.bias
        if len(frame) == 1:
            hidden = torch.relu(torch.addmm(frame[0], latents, self.by_latent))
            hidden = torch.relu(torch.addmm(self.inner_bias, hidden, self.inner))
            return (hidden @ self.outer)[None]
        hidden = torch.relu((latents @ self.by_latent) + frame[:, None])
        return torch.relu(hidden @ self.inner + self.inner_bias) @ self.outer
