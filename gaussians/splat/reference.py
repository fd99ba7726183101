"""The rasteriser in torch: readable, any device and type, twice as careful as fast. The tests' oracle."""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from roma import unitquat_to_rotmat
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from meshanim.errors import ShapeError
from meshanim.gaussians.cameras import Cameras
from meshanim.gaussians.gaussians import Gaussians
from meshanim.gaussians.harmonics import harmonics
from meshanim.gaussians.splat.rendering import RasterOptions, Rendering

__all__ = ["Projection", "check_values", "project", "rasterize_reference"]

MIN_ALPHA = 1 / 255
MIN_LIGHT = 1e-4  # of what reaches the camera; compositing stops before it
MAX_EXTENT = 3.33  # standard deviations
GUARD = 0.15  # of the image size: how far beyond its edges the perspective's slope still follows
TILE = 16
PAIRS = 1 << 21  # of pixels and Gaussians that are composited at once: bounds the memory


@dataclass(frozen=True)
class Projection:
    """Gaussians as one camera sees them.

    Parameters
    ----------
    positions : (N, 2)
        Centres, pixels.
    conics : (N, 3)
        xx, xy, yy of the inverse covariance in the image, 1 / pixels squared.
    depths : (N,)
        Along the viewing axis, metres.
    opacities : (N,)
        Multiplied by the compensation if antialiased.
    extents : (N, 2)
        Half the box outside of which alpha < 1 / 255, pixels along x and y.
    visible : (N,) bool
        Not culled; what is culled may have any value above, NaN included.
    """

    positions: Float[Tensor, "n 2"]
    conics: Float[Tensor, "n 3"]
    depths: Float[Tensor, " n"]
    opacities: Float[Tensor, " n"]
    extents: Float[Tensor, "n 2"]
    visible: Bool[Tensor, " n"]


def rasterize_reference(
    gaussians: Gaussians,
    cameras: Cameras,
    background: Float[Tensor, "*#images channels"],
    images: torch.Size,
    options: RasterOptions,
    screen_offsets: Float[Tensor, "*images n 2"] | None,
) -> Rendering:
    """`rasterize` in torch, one image after the other."""
    check_values(gaussians)
    scenes = _frames(gaussians, images[:-1])
    size = (*images, 4, 4)
    poses = cameras.world_to_camera.expand(size).reshape(-1, 4, 4)
    intrinsics = cameras.intrinsics.expand(*images, 3, 3).reshape(-1, 3, 3)
    behind = background.expand(*images, background.shape[-1]).reshape(len(poses), -1)
    offsets = None if screen_offsets is None else screen_offsets.reshape(len(poses), len(gaussians), 2)
    parts = [
        _image(
            scenes[index // len(cameras)],
            poses[index],
            intrinsics[index],
            (cameras.width, cameras.height),
            behind[index],
            options,
            None if offsets is None else offsets[index],
        )
        for index in range(len(poses))
    ]
    shape = (*images, cameras.height, cameras.width)
    channels = background.shape[-1]
    pictures = torch.stack([part[0] for part in parts])
    rgb, alpha, depth = pictures.split([channels, 1, 1], -1)
    if options.depth == "expected":
        depth = depth / alpha.clamp_min(1e-10)
    radii = [part[1] for part in parts]
    return Rendering(
        rgb.reshape(*shape, channels),
        alpha.reshape(shape),
        depth.reshape(shape) if options.depth else None,
        screen_offsets,
        torch.stack(radii).reshape(*images, len(gaussians), 2),
    )


def check_values(gaussians: Gaussians) -> None:
    """Refuse what cannot be rendered.

    Raises
    ------
    ShapeError
        If a field is NaN or infinite somewhere, or a quaternion is zero; says which and how many.
    """
    for name in ("means", "quaternions", "scales", "opacities", "colors", "sh"):
        field = getattr(gaussians, name)
        if field is not None:
            count = field.numel() - int(torch.isfinite(field).sum())
            if count:
                raise ShapeError(f"{name} has {count} values that are not finite")
    zero = int((gaussians.quaternions == 0).all(-1).sum())
    if zero:
        raise ShapeError(f"quaternions has {zero} of length zero")


def project(
    gaussians: Gaussians,
    world_to_camera: Float[Tensor, "4 4"],
    intrinsics: Float[Tensor, "3 3"],
    size: tuple[int, int],
    options: RasterOptions,
) -> Projection:
    """Gaussians without a batch, seen by one camera of (width, height) `size` (EWA)."""
    rotation, translation = world_to_camera[:3, :3], world_to_camera[:3, 3]
    x, y, z = (gaussians.means @ rotation.T + translation).unbind(-1)
    focal = torch.stack([intrinsics[0, 0], intrinsics[1, 1]])
    centre = intrinsics[:2, 2]
    ratio = torch.stack([x, y], -1) / z[:, None]
    extent = torch.tensor(size, dtype=z.dtype, device=z.device)
    low, high = -(centre + GUARD * extent) / focal, (extent - centre + GUARD * extent) / focal
    slope = ratio.clamp(low, high)
    # Rows of the perspective's Jacobian times the camera's rotation.
    rows = (focal / z[:, None])[..., None] * (rotation[:2] - slope[..., None] * rotation[2])
    quaternions = torch.nn.functional.normalize(gaussians.quaternions, dim=-1)
    axes = unitquat_to_rotmat(quaternions.roll(-1, -1)) * gaussians.scales[:, None, :]
    spread = rows @ axes
    covariance = spread @ spread.transpose(-1, -2)
    xx, xy, yy = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    sharp = xx * yy - xy * xy
    xx, yy = xx + options.eps2d, yy + options.eps2d
    determinant = xx * yy - xy * xy
    opacities = gaussians.opacities
    if options.antialiased:
        kept = (sharp / determinant).clamp_min(0)
        # Where nothing is kept nothing is seen, and the root has no gradient.
        opacities = opacities * torch.where(kept > 0, kept, torch.ones_like(kept)).sqrt() * (kept > 0)
    conics = torch.stack([yy, -xy, xx], -1) / determinant[:, None]
    positions = focal * ratio + centre
    with torch.no_grad():
        reach = (2 * torch.log(opacities.clamp_min(MIN_ALPHA) / MIN_ALPHA)).sqrt().clamp_max(MAX_EXTENT)
        extents = reach[:, None] * torch.stack([xx, yy], -1).sqrt()
        radii = extents.ceil()
        inside = ((positions + radii > 0) & (positions - radii < extent) & (radii > 0)).all(-1)
        visible = (z >= options.near) & (z <= options.far) & (determinant > 0)
        visible &= (opacities >= MIN_ALPHA) & inside
    return Projection(positions, conics, z, opacities, extents, visible)


def _frames(gaussians: Gaussians, batch: torch.Size) -> list[Gaussians]:
    """Each frame's Gaussians, as views."""
    trailing = {"means": 2, "quaternions": 2, "scales": 2, "opacities": 1, "colors": 2, "sh": 3}
    fields = {}
    for name, dimensions in trailing.items():
        field = getattr(gaussians, name)
        if field is not None:
            wide = field.expand(*batch, *field.shape[field.ndim - dimensions :])
            fields[name] = [wide[tuple(index)] for index in _indices(batch)]
    return [Gaussians(**dict(zip(fields, values))) for values in zip(*fields.values())]


def _indices(batch: torch.Size) -> Iterator[list[int]]:
    return (
        iter(torch.cartesian_prod(*map(torch.arange, batch)).reshape(-1, len(batch)).tolist())
        if batch
        else iter([[]])
    )


def _image(
    gaussians: Gaussians,
    world_to_camera: Tensor,
    intrinsics: Tensor,
    size: tuple[int, int],
    background: Tensor,
    options: RasterOptions,
    offsets: Tensor | None,
) -> tuple[Float[Tensor, "height width channels"], Int[Tensor, "n 2"]]:
    """Channels are the colours, alpha and accumulated depth; and the radii of all Gaussians."""
    with torch.no_grad():
        everything = project(gaussians, world_to_camera, intrinsics, size, options)
        visible = everything.visible.nonzero()[:, 0]
        radii = torch.where(everything.visible[:, None], everything.extents.ceil(), 0).to(torch.int32)
        order = visible[everything.depths[visible].argsort(stable=True)]
    # Only what is seen is differentiated: the rest may divide by zero.
    seen = gaussians.select(order)
    projection = project(seen, world_to_camera, intrinsics, size, options)
    colors = seen.colors
    if seen.sh is not None:
        position = -world_to_camera[:3, :3].T @ world_to_camera[:3, 3]
        directions = torch.nn.functional.normalize(seen.means - position, dim=-1)
        values = harmonics(directions, seen.sh_degree or 0)
        colors = ((values[..., None] * seen.sh).sum(-2) + 0.5).clamp_min(0.0)
    positions = projection.positions if offsets is None else projection.positions + offsets[order]
    assert colors is not None
    channels = torch.cat([colors, projection.depths[:, None]], -1)
    tables = (positions, projection.conics, projection.opacities, channels)
    width, height = size
    columns, rows = -(-width // TILE), -(-height // TILE)
    tiles, pictures = [torch.zeros(0, dtype=torch.long, device=order.device)], []
    for chosen, members, filled in _tile_batches(positions.detach(), projection.extents, columns, rows):
        arguments = (*tables, chosen, members, filled, columns, options.max_alpha)
        keep = torch.is_grad_enabled() and any(table.requires_grad for table in tables)
        pictures.append(
            checkpoint(_composite, *arguments, use_reentrant=False) if keep else _composite(*arguments)
        )
        tiles.append(chosen)
    grid = channels.new_zeros(rows * columns, TILE * TILE, channels.shape[-1] + 1)
    if pictures:
        grid = grid.index_copy(0, torch.cat(tiles), torch.cat(pictures))
    grid = (
        grid.reshape(rows, columns, TILE, TILE, -1).transpose(1, 2).reshape(rows * TILE, columns * TILE, -1)
    )
    rgb, depth, alpha = grid[:height, :width].split([len(background), 1, 1], -1)
    return torch.cat([rgb + (1 - alpha) * background, alpha, depth], -1), radii


def _tile_batches(
    positions: Tensor, extents: Tensor, columns: int, rows: int
) -> Iterator[tuple[Tensor, ...]]:
    """Tiles with something in them, a bounded number at a time.

    Their indices (T,), which Gaussians are in each (T, L) in the order given, and which of these places are
    filled (T, L) bool.
    """
    last = positions.new_tensor([columns - 1, rows - 1])
    low = ((positions - extents - 0.5) / TILE).floor().clamp_min(0).minimum(last + 1).long()
    high = ((positions + extents - 0.5) / TILE).floor().minimum(last).clamp_min(-1).long()
    wide = (high - low + 1).clamp_min(0)
    count = wide[:, 0] * wide[:, 1]
    gaussian = torch.arange(len(count), device=count.device).repeat_interleave(count)
    nth = torch.arange(len(gaussian), device=count.device) - (count.cumsum(0) - count)[gaussian]
    column = low[gaussian, 0] + nth % wide[gaussian, 0]
    row = low[gaussian, 1] + nth // wide[gaussian, 0]
    tile, order = (row * columns + column).sort(stable=True)
    gaussian = gaussian[order]
    tiles, lengths = tile.unique_consecutive(return_counts=True)
    starts = lengths.cumsum(0) - lengths
    by_length = lengths.argsort()
    sizes = lengths[by_length].tolist()
    first = 0
    while first < len(sizes):
        end = first + 1
        while end < len(sizes) and (end + 1 - first) * sizes[end] * TILE * TILE <= PAIRS:
            end += 1
        chosen = by_length[first:end]
        place = torch.arange(sizes[end - 1], device=count.device)
        filled = place < lengths[chosen, None]
        members = gaussian[torch.where(filled, starts[chosen, None] + place, 0)]
        yield tiles[chosen], members, filled
        first = end


def _composite(
    positions: Float[Tensor, "n 2"],
    conics: Float[Tensor, "n 3"],
    opacities: Float[Tensor, " n"],
    channels: Float[Tensor, "n channels"],
    tiles: Int[Tensor, " tiles"],
    members: Int[Tensor, "tiles length"],
    filled: Bool[Tensor, "tiles length"],
    columns: int,
    max_alpha: float,
) -> Float[Tensor, "tiles pixels channels+1"]:
    """Channels and alpha of the pixels of some tiles."""
    pixel = torch.arange(TILE * TILE, device=tiles.device)
    across = (tiles % columns * TILE)[:, None] + pixel % TILE + 0.5
    down = (tiles // columns * TILE)[:, None] + pixel // TILE + 0.5
    dx = positions[members, 0][..., None] - across[:, None, :]
    dy = positions[members, 1][..., None] - down[:, None, :]
    xx, xy, yy = (conics[members, k][..., None] for k in range(3))
    distance = 0.5 * (xx * dx * dx + yy * dy * dy) + xy * dx * dy
    alpha = (opacities[members][..., None] * torch.exp(-distance)).clamp_max(max_alpha)
    alpha = torch.where(filled[..., None] & (alpha.detach() >= MIN_ALPHA), alpha, 0.0)
    # What would be left falls from Gaussian to Gaussian, so the first that is refused ends the rest.
    with torch.no_grad():
        accepted = (1 - alpha).cumprod(1) > MIN_LIGHT
    alpha = torch.where(accepted, alpha, 0.0)
    left = (1 - alpha).cumprod(1)
    weights = alpha * torch.cat([torch.ones_like(left[:, :1]), left[:, :-1]], 1)
    blended = weights.transpose(1, 2) @ channels[members]
    return torch.cat([blended, 1 - left[:, -1, :, None]], -1)
