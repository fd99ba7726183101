"""Niantic's .spz: Gaussians in a tenth of the space of a .ply."""

import gzip
import zlib
from pathlib import Path

import numpy as np
import torch

from meshanim.errors import FileFormatError
from meshanim.files import written_whole
from meshanim.gaussians.gaussians import Gaussians
from meshanim.gaussians.harmonics import COEFFICIENTS
from meshanim.gaussians.ply import stored

__all__ = ["read_spz", "write_spz"]

_HEADER = np.dtype(
    [("magic", "<u4"), ("version", "<u4"), ("count", "<u4")]
    + [(name, "u1") for name in ("sh_degree", "fraction_bits", "flags", "reserved")]
)
_MAGIC = 0x5053474E  # "NGSP"
_MOST_FRACTION_BITS = 20
_COLOR = 0.15  # bytes of colour a unit of the first harmonic, so that values outside 0 to 1 fit
_ROOT_HALF = 0.5**0.5


def write_spz(path: str | Path, gaussians: Gaussians) -> None:
    """Write version 3 of the format, which viewers and engines read; axes are kept (x right, y up, z back).

    A gzipped header of 16 bytes, then field by field: positions in 24-bit fixed point, as many bits behind
    the point as the largest coordinate leaves (a micrometre within 8 m); opacities, colours and harmonics
    (clipped to -1 to 1) in a byte each; logarithms of scales in steps of 1/16 (6 %); the three smaller parts
    of the quaternion in 10 bits each.

    Parameters
    ----------
    path : str or Path
        Written whole.
    gaussians : Gaussians
        Without a batch.

    Raises
    ------
    ShapeError
        If they have a batch, other than three channels, or values that are not finite.
    """
    kept = stored(gaussians)
    reach = float(np.abs(kept.means).max(initial=1e-3))
    bits = int(np.clip(np.floor(np.log2((2**23 - 1) / reach)), 0, _MOST_FRACTION_BITS))
    header = np.zeros(1, _HEADER)
    header["magic"], header["version"], header["count"] = _MAGIC, 3, len(kept.means)
    header["sh_degree"], header["fraction_bits"] = COEFFICIENTS.index(kept.sh.shape[1]), bits
    fixed = np.round(kept.means.astype(np.float64) * 2**bits).clip(-(2**23), 2**23 - 1).astype("<i4")
    parts = [
        header.view(np.uint8),
        fixed.view(np.uint8).reshape(-1, 4)[:, :3],
        _bytes(255 * kept.opacities),
        _bytes(255 * (_COLOR * kept.sh[:, 0] + 0.5)),
        _bytes(16 * (np.log(np.maximum(kept.scales, 1e-30)) + 10)),
        _smallest_three(kept.quaternions).view(np.uint8),
        _bytes(128 * kept.sh[:, 1:] + 128),
    ]
    with written_whole(path) as temporary:
        temporary.write_bytes(gzip.compress(b"".join(part.tobytes() for part in parts), mtime=0))


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


def _smallest_three(quaternions: np.ndarray) -> np.ndarray:
    """Index of the largest of x, y, z, w in the upper 2 bits, then a sign and 9 bits for each other part."""
    xyzw = np.roll(quaternions, -1, axis=1)
    largest = np.abs(xyzw).argmax(1)
    row = np.arange(len(xyzw))
    sign = xyzw[row, largest] < 0
    packed = largest.astype(np.uint32)
    for part in range(4):
        value = xyzw[:, part]
        size = np.minimum(np.round(511 * np.abs(value) / _ROOT_HALF), 511).astype(np.uint32)
        pushed = packed << 10 | (((value < 0) ^ sign).astype(np.uint32) << 9) | size
        packed = np.where(part == largest, packed, pushed)
    return packed.astype("<u4")


def read_spz(path: str | Path) -> Gaussians:
    """Read versions 2 and 3 of the format.

    Returns
    -------
    Gaussians
        float32, colours as harmonics.

    Raises
    ------
    FileFormatError
        If the file is missing, damaged or cut off, of another format, version or degree above 3.
    """
    try:
        raw = Path(path).read_bytes()
    except OSError as error:
        raise FileFormatError(f"cannot read {path}: {error.strerror}") from error
    if raw[:4] == _MAGIC.to_bytes(4, "little"):
        raise FileFormatError(
            f"{path} is version {int.from_bytes(raw[4:8], 'little')} of .spz; convert it to version 3"
        )
    try:
        content = gzip.decompress(raw)
    except (OSError, EOFError, zlib.error) as error:
        raise FileFormatError(f"{path} is no whole .spz: {error}") from error
    if len(content) < _HEADER.itemsize or content[:4] != _MAGIC.to_bytes(4, "little"):
        raise FileFormatError(f"{path} is gzipped, but no .spz inside")
    header = np.frombuffer(content, _HEADER, 1)[0]
    version, degree, count = int(header["version"]), int(header["sh_degree"]), int(header["count"])
    if version not in (2, 3) or degree >= len(COEFFICIENTS):
        raise FileFormatError(
            f"{path} is version {version} of .spz with harmonics of degree {degree}; versions 2 and 3 and "
            "degrees 0 to 3 are read"
        )
    others = COEFFICIENTS[degree] - 1
    widths = [9, 1, 3, 3, 4 if version == 3 else 3, 3 * others]
    size = _HEADER.itemsize + count * sum(widths)
    if len(content) < size:
        raise FileFormatError(f"{path} is cut off: {len(content)} bytes unpacked of {size}")
    starts = _HEADER.itemsize + count * np.concatenate([[0], np.cumsum(widths)])
    fields = (
        np.frombuffer(content, np.uint8, end - start, start).reshape(count, width)
        for start, end, width in zip(starts[:-1].tolist(), starts[1:].tolist(), widths)
    )
    positions, opacities, colors, scales, rotations, rest = fields
    whole = np.zeros((count * 3, 4), np.uint8)
    whole[:, 1:] = positions.reshape(-1, 3)
    # Shifted up by a byte, so that the sign is in its place.
    fixed = (whole.view("<i4") // 256).reshape(count, 3)
    first = ((colors.astype(np.float32) / 255 - 0.5) / _COLOR)[:, None]
    sh = np.concatenate([first, ((rest.astype(np.float32) - 128) / 128).reshape(count, others, 3)], 1)
    quaternions = _four_of(rotations) if version == 3 else _four_of_xyz(rotations)
    arrays = (
        fixed / 2.0 ** int(header["fraction_bits"]),
        quaternions,
        np.exp(scales.astype(np.float32) / 16 - 10),
        opacities[:, 0] / 255,
    )
    means, turns, sizes, opaque = (torch.from_numpy(array.astype(np.float32)) for array in arrays)
    return Gaussians(means, turns, sizes, opaque, sh=torch.from_numpy(sh.astype(np.float32)))


def _four_of(rotations: np.ndarray) -> np.ndarray:
    packed = np.ascontiguousarray(rotations).view("<u4")[:, 0].astype(np.int64)
    largest = packed >> 30
    xyzw = np.zeros((len(packed), 4))
    for part in reversed(range(4)):
        given = part != largest
        value = (packed & 511) / 511 * _ROOT_HALF * np.where(packed & 512, -1, 1)
        xyzw[given, part] = value[given]
        packed = np.where(given, packed >> 10, packed)
    row = np.arange(len(packed))
    xyzw[row, largest] = np.sqrt(np.maximum(0, 1 - (xyzw**2).sum(1)))
    return np.roll(xyzw, 1, axis=1)


def _four_of_xyz(rotations: np.ndarray) -> np.ndarray:
    xyz = rotations.astype(np.float64) / 127.5 - 1
    w = np.sqrt(np.maximum(0, 1 - (xyz**2).sum(1)))
    return np.concatenate([w[:, None], xyz], 1)
