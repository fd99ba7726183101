"""`rasterize`: one signature, three backends."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from meshanim.errors import BackendError, OptionError, ShapeError
from meshanim.gaussians.cameras import Cameras
from meshanim.gaussians.gaussians import Gaussians
from meshanim.gaussians.splat import native
from meshanim.gaussians.splat.cuda import rasterize_cuda
from meshanim.gaussians.splat.native import rasterize_native
from meshanim.gaussians.splat.reference import rasterize_reference
from meshanim.gaussians.splat.rendering import DepthMode, RasterOptions, Rendering

__all__ = ["BACKENDS", "rasterize"]

BACKENDS = ("auto", "native", "cuda", "reference")


def rasterize(
    gaussians: Gaussians,
    cameras: Cameras,
    background: Sequence[float] | Float[Tensor, "*#batch channels"] | None = None,
    *,
    near: float = 0.01,
    far: float = 1e10,
    eps2d: float = 0.3,
    antialiased: bool = False,
    max_alpha: float = 0.999,
    depth: DepthMode | None = "expected",
    screen_gradients: bool = False,
    backend: str = "auto",
) -> Rendering:
    """Images of 3D Gaussians, differentiable, pixel for pixel those of gsplat 1.5.

    Each Gaussian becomes a 2D Gaussian by the local affine approximation of the perspective (EWA), and the
    pixel at half-integer coordinates composites, from near to far,
    alpha = min(max_alpha, opacity exp(-d' S^-1 d / 2)), where alpha >= 1 / 255, until what is left of the
    light would fall to 1e-4 or less.

    Gradients reach means, quaternions, scales, opacities, colors or sh, background and `world_to_camera`.

    Parameters
    ----------
    gaussians : Gaussians
        N of them in world space. Fields without batch dimensions are shared by all images, never copied.
    cameras : Cameras
        C a frame, of the same or no batch dimensions.
    background : (D,) or (..., C, D), optional
        Colour behind everything; zeros if not given. Depth has no background.
    near, far : float
        Metres; Gaussians whose centre is nearer or farther are culled.
    eps2d : float
        Pixels squared, added to both variances in the image.
    antialiased : bool
        Multiply opacities by sqrt(det S / det (S + eps2d)), so that thin Gaussians do not gain from eps2d
        (Mip-Splatting, Yu et al. 2024, as gsplat has it).
    max_alpha : float
        0.999 in gsplat 1.5, 0.99 in 1.6 and in Kerbl's code. No gradient where it acts.
    depth : "expected", "accumulated" or None
        Which depth to render. None saves a channel.
    screen_gradients : bool
        Make `Rendering.screen_offsets`.
    backend : str
        "native" (C++, CPU, float32), "cuda" (gsplat, NVIDIA GPU), "reference" (torch, any device, float64
        too) or "auto": by device and type.

    Raises
    ------
    ShapeError
        If batches or channels do not fit together, or a field has NaN, infinity or a zero quaternion.
    OptionError, BackendError, DependencyError
        An option out of range; a backend that is not there; gsplat missing for "cuda".

    Source: Zwicker et al., "EWA Splatting", TVCG 2002; Kerbl et al., "3D Gaussian Splatting", SIGGRAPH 2023,
    Sec. 4 and 6; Ye et al., "gsplat", JMLR 2025; boxes that know the opacity: Hanson et al., "Speedy-Splat",
    2024, and Radl et al., "StopThePop", 2024, App. B.2.
    """
    options = RasterOptions(near, far, eps2d, antialiased, max_alpha, depth)
    backend = _choose(backend, gaussians)
    _check_cameras(gaussians, cameras)
    batch = _batch(gaussians, cameras)
    images = torch.Size((*batch, len(cameras)))
    if 0 in images:
        raise ShapeError(f"there is no image to render in a batch of {images}")
    behind = _background(background, gaussians, images)
    offsets = None
    if screen_gradients:
        offsets = gaussians.means.new_zeros((*images, len(gaussians), 2)).requires_grad_()
    render = {"native": rasterize_native, "cuda": rasterize_cuda, "reference": rasterize_reference}[backend]
    return render(gaussians, cameras, behind, images, options, offsets)


def _choose(backend: str, gaussians: Gaussians) -> str:
    if backend not in BACKENDS:
        raise OptionError(f"backend {backend!r} is not one of {', '.join(BACKENDS)}")
    means, single = gaussians.means, gaussians.means.dtype == torch.float32
    fits_native, fits_cuda = single and means.is_cpu, single and means.is_cuda
    if backend == "auto":
        if fits_cuda:
            return "cuda"
        return "native" if fits_native and native.available() else "reference"
    if backend == "native" and not native.available():
        raise BackendError(
            "backend 'native' is not built: install meshanim with a C++17 compiler at hand, "
            "or use backend='reference'"
        )
    if (backend == "native" and not fits_native) or (backend == "cuda" and not fits_cuda):
        place = "the CPU" if backend == "native" else "an NVIDIA GPU"
        raise BackendError(
            f"backend {backend!r} computes float32 on {place}, not {means.dtype} on {means.device}: "
            "use backend='reference' or 'auto'"
        )
    return backend


def _batch(gaussians: Gaussians, cameras: Cameras) -> torch.Size:
    own = gaussians.batch_shape
    if not own and cameras.world_to_camera.ndim == 3 == cameras.intrinsics.ndim:
        return own
    try:
        return torch.broadcast_shapes(own, cameras.world_to_camera.shape[:-3], cameras.intrinsics.shape[:-3])
    except RuntimeError as error:
        raise ShapeError(
            f"cameras {tuple(cameras.world_to_camera.shape)} do not fit the Gaussians' batch {tuple(own)}"
        ) from error


def _check_cameras(gaussians: Gaussians, cameras: Cameras) -> None:
    for name in ("world_to_camera", "intrinsics"):
        matrix = getattr(cameras, name)
        if matrix.dtype != gaussians.means.dtype or matrix.device != gaussians.means.device:
            raise ShapeError(
                f"{name} is {matrix.dtype} on {matrix.device}, the Gaussians are {gaussians.means.dtype} on "
                f"{gaussians.means.device}: use cameras.to(...)"
            )


def _background(
    background: Sequence[float] | Tensor | None, gaussians: Gaussians, images: torch.Size
) -> Tensor:
    """(..., channels), which fits the images but is not expanded to them."""
    channels = 3 if gaussians.colors is None else gaussians.colors.shape[-1]
    if background is None:
        return gaussians.means.new_zeros(channels)
    behind = torch.as_tensor(background, dtype=gaussians.means.dtype, device=gaussians.means.device)
    leading = behind.shape[:-1]
    try:
        if behind.shape[-1] != channels or (leading and torch.broadcast_shapes(leading, images) != images):
            raise RuntimeError
    except (RuntimeError, IndexError) as error:
        raise ShapeError(
            f"background {tuple(behind.shape)} does not fit {channels} channels of images {tuple(images)}"
        ) from error
    return behind
