"""How fast the image loss and its gradient are, against torchmetrics' SSIM and the torch reference."""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from meshanim.gaussians.losses import image_loss
from meshanim.results import Results

__all__ = ["LossBenchmark", "run"]


@dataclass(frozen=True)
class LossBenchmark:
    """Time of the L1 + D-SSIM loss with its gradient, against torchmetrics and torch.

    Example: meshanim bench image-loss --json loss.json
    """

    sizes: tuple[int, ...] = (256, 512, 1024)
    """Square images of so many pixels a side."""
    repeats: int = 9
    """Interleaved repeats; medians are reported."""
    seed: int = 0
    json: Path | None = None
    """Also write the rows here."""


def run(options: LossBenchmark | None = None) -> Results:
    """Measure and return the rows; milliseconds are medians of interleaved repeats."""
    options = options or LossBenchmark()
    results = Results("image-loss")
    generator = torch.Generator().manual_seed(options.seed)
    for size in options.sizes:
        rendered, target = (torch.rand(1, size, size, 3, generator=generator) for _ in range(2))
        rendered.requires_grad_()
        _compare(f"{size} x {size}", rendered, target, options.repeats, results)
    return results


def _compare(case: str, rendered: Tensor, target: Tensor, repeats: int, results: Results) -> None:
    from torchmetrics.functional.image import structural_similarity_index_measure  # loads transformers

    planes = target.movedim(-1, 1).contiguous()

    def generic() -> Tensor:
        ssim = structural_similarity_index_measure(rendered.movedim(-1, 1), planes, data_range=1.0)
        assert isinstance(ssim, Tensor)
        return 0.8 * (rendered - target).abs().mean() + 0.2 * (1 - ssim)

    ways: dict[str, Callable[[], Tensor]] = {
        "torchmetrics": generic,
        "reference": lambda: image_loss(rendered, target, backend="reference"),
        "native": lambda: image_loss(rendered, target, backend="native"),
    }
    times: dict[str, list[float]] = {name: [] for name in ways}
    for repeat in range(repeats + 1):
        for name, way in ways.items():
            start = time.perf_counter()
            torch.autograd.grad(way(), rendered)
            if repeat:  # the first round warms up
                times[name].append(1e3 * (time.perf_counter() - start))
    medians = {name: statistics.median(values) for name, values in times.items()}
    for name, milliseconds in medians.items():
        results.add(case, name, "forward + backward", milliseconds, "ms")
    for name in ("torchmetrics", "reference"):
        results.add(case, f"{name} / native", "ratio", medians[name] / medians["native"], "x")
