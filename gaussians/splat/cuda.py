"""gsplat's CUDA kernels behind our interface (extra `cuda`).

gsplat 1.5 is a pure Python wheel that compiles its kernels at first use and needs a CUDA toolkit for it.
"""

from types import ModuleType

import torch
from jaxtyping import Float
from torch import Tensor

from meshanim.errors import BackendError, DependencyError, OptionError
from meshanim.gaussians.cameras import Cameras
from meshanim.gaussians.gaussians import Gaussians
from meshanim.gaussians.splat.reference import check_values
from meshanim.gaussians.splat.rendering import RasterOptions, Rendering

__all__ = ["rasterize_cuda"]

TILE = 16
CHUNK = 32  # channels a pass; more do not fit a multiprocessor's shared memory


def rasterize_cuda(
    gaussians: Gaussians,
    cameras: Cameras,
    background: Float[Tensor, "*#images channels"],
    images: torch.Size,
    options: RasterOptions,
    screen_offsets: Float[Tensor, "*images n 2"] | None,
) -> Rendering:
    """`rasterize` by gsplat's stages: projection, tiles, pixels.

    Raises
    ------
    DependencyError
        If gsplat is not installed.
    BackendError
        If its kernels were not built.
    OptionError
        If max_alpha is another than the one gsplat was compiled with.
    """
    gsplat = _gsplat(options.max_alpha)
    check_values(gaussians)
    background = background.expand(*images, background.shape[-1])
    batch, count = images[:-1], len(gaussians)

    def whole(field: Tensor, trailing: int) -> Tensor:
        return field.expand(*batch, *field.shape[field.ndim - trailing :])

    means, opacities = whole(gaussians.means, 2), whole(gaussians.opacities, 1)
    poses = cameras.world_to_camera.expand(*images, 4, 4)
    radii, positions, depths, conics, compensations = gsplat.fully_fused_projection(
        means,
        None,
        whole(gaussians.quaternions, 2),
        whole(gaussians.scales, 2),
        poses,
        cameras.intrinsics.expand(*images, 3, 3),
        cameras.width,
        cameras.height,
        eps2d=options.eps2d,
        near_plane=options.near,
        far_plane=options.far,
        packed=False,
        calc_compensations=options.antialiased,
        opacities=opacities,
    )
    opacities = opacities[..., None, :].expand(*images, count)
    if options.antialiased:
        opacities = opacities * compensations
    if screen_offsets is not None:
        positions = positions + screen_offsets
    channels = _colors(gsplat, gaussians, means, poses, radii, images)
    if options.depth:
        channels = torch.cat([channels, depths[..., None]], -1)
        background = torch.cat([background, torch.zeros_like(background[..., :1])], -1)
    columns, rows = -(-cameras.width // TILE), -(-cameras.height // TILE)
    _, keys, members = gsplat.isect_tiles(positions, radii, depths, TILE, columns, rows)
    starts = gsplat.isect_offset_encode(keys, batch.numel() * len(cameras), columns, rows)
    starts = starts.reshape(*images, rows, columns)
    pictures = []
    for first in range(0, channels.shape[-1], CHUNK):
        picture, alpha = gsplat.rasterize_to_pixels(
            positions,
            conics,
            channels[..., first : first + CHUNK],
            opacities,
            cameras.width,
            cameras.height,
            TILE,
            starts,
            members,
            backgrounds=background[..., first : first + CHUNK],
        )
        pictures.append(picture)
    picture, alpha = torch.cat(pictures, -1), alpha[..., 0]
    depth = None
    if options.depth:
        picture, depth = picture[..., :-1], picture[..., -1]
        if options.depth == "expected":
            depth = depth / alpha.clamp_min(1e-10)
    return Rendering(picture, alpha, depth, screen_offsets, radii)


def _colors(
    gsplat: ModuleType, gaussians: Gaussians, means: Tensor, poses: Tensor, radii: Tensor, images: torch.Size
) -> Float[Tensor, "*images n channels"]:
    if gaussians.sh is None:
        assert gaussians.colors is not None
        return gaussians.colors[..., None, :, :].expand(*images, *gaussians.colors.shape[-2:])
    rotation, translation = poses[..., :3, :3], poses[..., :3, 3:]
    position = -(rotation.transpose(-1, -2) @ translation)[..., 0]
    directions = means[..., None, :, :] - position[..., None, :]
    coefficients = gaussians.sh[..., None, :, :, :].expand(*images, *gaussians.sh.shape[-3:])
    seen = (radii > 0).all(-1)
    colors = gsplat.spherical_harmonics(gaussians.sh_degree, directions, coefficients, masks=seen)
    return (colors + 0.5).clamp_min(0.0)


def _gsplat(max_alpha: float) -> ModuleType:
    try:
        import gsplat
    except ImportError as error:
        raise DependencyError("gsplat", "cuda") from error
    remedy = "install a CUDA toolkit that fits torch's CUDA, or use backend='reference'"
    try:
        from gsplat.cuda._backend import _C
    except (ImportError, RuntimeError, OSError) as error:
        reason = str(error).splitlines()[0]
        raise BackendError(f"gsplat could not compile its kernels ({reason}): {remedy}") from error
    if _C is None:
        raise BackendError(f"gsplat found no CUDA toolkit to compile its kernels with: {remedy}")
    version = tuple(int(part) for part in gsplat.__version__.split(".")[:2])
    compiled = 0.999 if version < (1, 6) else 0.99
    if max_alpha != compiled:
        raise OptionError(
            f"gsplat {gsplat.__version__} is compiled with max_alpha {compiled}, not {max_alpha}: "
            f"give max_alpha={compiled} or use backend='reference'"
        )
    return gsplat
