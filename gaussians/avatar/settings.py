"""How an avatar is fitted: presets as frozen dataclasses."""

from dataclasses import dataclass, field, replace
from typing import Literal

from meshanim.errors import OptionError

__all__ = ["PRESETS", "ColorSettings", "Density", "FitSettings", "Rate", "Regularizers", "preset"]


@dataclass(frozen=True)
class Rate:
    """A learning rate over a run: warm-up, level, exponential fall.

    Parameters
    ----------
    start : float
        Of the level.
    end : float
        At the last step, as a share of `start`.
    level : float
        Share of the run before it falls.
    delay : int
        Steps over which it rises from nearly nothing (a sine, as in Plenoxels and 3D Gaussian Splatting).
    delay_factor : float
        What it is multiplied by at step 0.
    """

    start: float
    end: float = 1.0
    level: float = 0.0
    delay: int = 0
    delay_factor: float = 0.01


@dataclass(frozen=True)
class Density:
    """When and how Gaussians are added and removed.

    Parameters
    ----------
    rule : "screen" or "top"
        "screen": GaussianAvatars' (Kerbl et al. 2023, Sec. 5): where the mean gradient in the image exceeds
        `threshold`, clone small Gaussians and split large ones. "top": split those with the largest mean
        gradient in the world, until `limit` is reached in equal parts.
    start, stop, every : float
        From, until and between refinements, as shares of the run.
    threshold : float
        Mean gradient by the position in the image, in halves of its size (normalised device coordinates).
    clone_below : float
        Gaussians whose largest scale is below this share of the scene's radius are cloned, others split.
    prune_opacity : float
        Less opaque ones are removed.
    prune_scale, prune_radius : float
        After the first reset: remove what is larger than this share of the scene's radius, or pixels.
    reset_every : float
        Share of the run between resets of the opacities to 0.01; 0 for never.
    limit : int
        Gaussians at the end ("top").
    """

    rule: Literal["screen", "top"] = "screen"
    start: float = 1 / 60
    stop: float = 1.0
    every: float = 1 / 300
    threshold: float = 2e-4
    clone_below: float = 0.01
    prune_opacity: float = 0.005
    prune_scale: float = 0.1
    prune_radius: float = 20.0
    reset_every: float = 0.1
    limit: int = 22_000


@dataclass(frozen=True)
class Regularizers:
    """What keeps Gaussians on their triangles (GaussianAvatars, Eqs. 5 and 6), in units of the triangle.

    Parameters
    ----------
    position_weight, position_threshold : float
        Of mean relu(|mu| - threshold).
    scale_weight, scale_threshold : float
        Of mean |relu(s - threshold)|.
    """

    position_weight: float = 0.01
    position_threshold: float = 1.0
    scale_weight: float = 1.0
    scale_threshold: float = 0.6


@dataclass(frozen=True)
class ColorSettings:
    """How colours depend on direction and expression.

    Parameters
    ----------
    sh_degree : int
        0 to 3.
    sh_every : float
        Share of the run between degrees; 0 for all at once.
    latent : int
        Numbers each Gaussian gives a network of two hidden layers that adds to its colour by expression;
        0 for no network.
    hidden : int
        Width of that network.
    """

    sh_degree: int = 3
    sh_every: float = 1 / 600
    latent: int = 0
    hidden: int = 32


PAPER_RATES = {
    "means": Rate(5e-3, 0.01),
    "scales": Rate(0.017),
    "rotations": Rate(1e-3),
    "opacities": Rate(0.05),
    "sh0": Rate(2.5e-3),
    "sh_rest": Rate(1.25e-4),
    "latents": Rate(2.5e-3),
    "network": Rate(1e-3),
    "expression": Rate(1e-3),
    "pose": Rate(1e-5),
    "translation": Rate(1e-6),
}


@dataclass(frozen=True)
class FitSettings:
    """A whole fit.

    Parameters
    ----------
    iterations : int
        Steps, of one picture each (and process).
    color, density, regularizers
        See there.
    ssim_weight : float
        Share of D-SSIM in the image loss.
    scale, opacity : (3,) float, float
        Gaussians at the start: scale along a triangle's first side, normal and across, in its units.
    rates : mapping of str to Rate
        Of means, scales, rotations, opacities, sh0, sh_rest, latents, network; and of the head's
        expression, pose (radians) and translation (metres) where tracking is refined.
    betas : (float, float)
        Of Adam.
    extent_means : bool
        Whether the rate of means is multiplied by the scene's radius (3D Gaussian Splatting).
    coarse : float
        Share of the run at half the pictures' size.
    """

    iterations: int = 600_000
    color: ColorSettings = field(default_factory=ColorSettings)
    density: Density = field(default_factory=Density)
    regularizers: Regularizers = field(default_factory=Regularizers)
    ssim_weight: float = 0.2
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    opacity: float = 0.1
    rates: dict[str, Rate] = field(default_factory=lambda: dict(PAPER_RATES))
    betas: tuple[float, float] = (0.9, 0.999)
    extent_means: bool = True
    coarse: float = 0.0


def _falling(start: float) -> Rate:
    return Rate(start, end=0.01, level=0.3, delay=50, delay_factor=0.02)


SMALL_RATES = {
    "means": _falling(3.2e-2),
    "scales": _falling(6.8e-2),
    "rotations": _falling(4e-2),
    "opacities": _falling(5e-2),
    "sh0": _falling(3.5e-2),
    "sh_rest": _falling(8e-3),
    "latents": _falling(4e-2),
    "network": _falling(8e-3),
    "expression": _falling(2e-3),
    "pose": _falling(5e-4),
    "translation": _falling(5e-5),
}
PRESETS = {
    "paper": FitSettings(),
    "small": FitSettings(
        iterations=4000,
        color=ColorSettings(sh_degree=2, sh_every=0.0, latent=8),
        density=Density(
            "top", start=0.08, stop=0.49, every=0.08, prune_opacity=0.02, reset_every=0.0, limit=21_800
        ),
        regularizers=Regularizers(scale_weight=0.05, scale_threshold=0.8),
        scale=(0.5, 0.12, 0.5),
        opacity=0.62,
        rates=SMALL_RATES,
        betas=(0.9, 0.99),
        extent_means=False,
    ),
}
"""`paper`: GaussianAvatars (Qian et al. 2024, Sec. 4 and its published configuration), for a GPU. `small`:
minutes on two cores."""


def preset(name: str, size: int, iterations: int | None = None) -> FitSettings:
    """Settings by name for pictures of a size.

    Parameters
    ----------
    name : str
        paper or small.
    size : int
        Largest side, pixels. From 384 on, `small` starts at half of it, with fewer steps, more Gaussians.
    iterations : int, optional
        Instead of the preset's; shares of the run scale with it.

    Raises
    ------
    OptionError
        If there is no such preset.
    """
    if name not in PRESETS:
        raise OptionError(f"no preset '{name}'; there are {', '.join(PRESETS)}")
    settings = PRESETS[name]
    if name == "small" and size >= 384:
        density = replace(settings.density, limit=29_800)
        settings = replace(settings, iterations=4500, coarse=0.55, density=density)
    return settings if iterations is None else replace(settings, iterations=iterations)
