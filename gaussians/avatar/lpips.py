"""LPIPS without torchvision: AlexNet from a file of weights, the linear heads that torchmetrics ships."""

from importlib.resources import files
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from meshanim.errors import FileFormatError

__all__ = ["Lpips"]

LAYERS = (
    (0, 3, 64, 11, 4, 2),
    (3, 64, 192, 5, 1, 2),
    (6, 192, 384, 3, 1, 1),
    (8, 384, 256, 3, 1, 1),
    (10, 256, 256, 3, 1, 1),
)
"""Number in AlexNet's `features`, channels in and out, kernel, stride, padding."""
POOLED = (3, 6)  # a 3 x 3 maximum at stride 2 comes before these
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)


class Lpips(nn.Module):
    """Learned perceptual distance (Zhang et al. 2018, version 0.1, AlexNet) of images in [0, 1].

    Parameters
    ----------
    weights : path
        AlexNet as torchvision publishes it (alexnet-owt-7be5be79.pth): a state dict with
        features.N.weight and features.N.bias. It is not shipped.

    Raises
    ------
    FileFormatError
        If the file is missing, unsafe to read, or holds another network.
    """

    def __init__(self, weights: str | Path):
        super().__init__()
        shipped = files("torchmetrics") / "functional/image/lpips_models/alex.pth"
        state, heads = (_state(Path(str(path))) for path in (weights, shipped))
        self.convolutions, self.heads = nn.ModuleList(), []
        for index, (number, before, after, kernel, stride, padding) in enumerate(LAYERS):
            layer = nn.Conv2d(before, after, kernel, stride, padding)
            try:
                layer.load_state_dict({k: state[f"features.{number}.{k}"] for k in ("weight", "bias")})
            except (KeyError, RuntimeError) as error:
                raise FileFormatError(f"{weights} holds no AlexNet of torchvision: {error}") from error
            self.convolutions.append(layer)
            self.heads.append(heads[f"lin{index}.model.1.weight"])
        self.requires_grad_(False)

    def forward(
        self, first: Float[Tensor, "height width 3"], second: Float[Tensor, "height width 3"]
    ) -> Float[Tensor, ""]:
        """Distance of two images, 0 for equal ones."""
        pair = torch.stack([first, second]).movedim(-1, 1) * 2 - 1
        features = (pair - pair.new_tensor(SHIFT)[:, None, None]) / pair.new_tensor(SCALE)[:, None, None]
        total = pair.new_zeros(())
        for layer, (number, *_), head in zip(self.convolutions, LAYERS, self.heads):
            if number in POOLED:
                features = nn.functional.max_pool2d(features, 3, 2)
            features = torch.relu(layer(features))
            unit = features / (features.square().sum(1, keepdim=True).sqrt() + 1e-10)
            total = total + (head[0] * (unit[0] - unit[1]).square()).sum(0).mean()
        return total


def _state(path: Path) -> dict[str, Tensor]:
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many kinds; all of them mean that the file is no state dict
        reason = str(error) or "it is cut short"
        raise FileFormatError(f"cannot read the weights {path}: {reason}") from error
    if not isinstance(state, dict):
        raise FileFormatError(f"{path} holds no state dict")
    return state
