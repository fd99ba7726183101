"""Gaussians in files: the format follows the ending."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from meshanim.errors import FileFormatError, OptionError
from meshanim.files import written_whole
from meshanim.gaussians.gaussians import Gaussians
from meshanim.gaussians.harmonics import harmonics
from meshanim.gaussians.ply import first_harmonic, read_ply, stored, write_ply
from meshanim.gaussians.spz import read_spz, write_spz

__all__ = ["read_gaussians", "read_splat", "write_gaussians", "write_splat"]

_RECORD = np.dtype(
    [("position", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("rotation", "u1", 4)], align=False
)


def read_gaussians(path: str | Path) -> Gaussians:
    """Gaussians in the world from a .ply, .spz or .splat.

    Raises
    ------
    OptionError
        If the ending is another.
    FileFormatError
        If the file is missing, damaged or of another format.
    """
    read: dict[str, Callable[[str | Path], Gaussians]] = {
        ".ply": read_ply,
        ".spz": read_spz,
        ".splat": read_splat,
    }
    return read[_ending(path)](path)


def write_gaussians(path: str | Path, gaussians: Gaussians) -> None:
    """Write Gaussians without a batch as .ply (all of them), .spz (a tenth) or .splat (without harmonics).

    Raises
    ------
    OptionError
        If the ending is another.
    ShapeError
        If they have a batch, more than three channels or values that are not finite.
    """
    write: dict[str, Callable[[str | Path, Gaussians], None]] = {
        ".ply": write_ply,
        ".spz": write_spz,
        ".splat": write_splat,
    }
    write[_ending(path)](path, gaussians)


def _ending(path: str | Path) -> str:
    ending = Path(path).suffix.lower()
    if ending not in (".ply", ".spz", ".splat"):
        raise OptionError(f"Gaussians are kept in .ply, .spz or .splat, not in {path}")
    return ending


def write_splat(path: str | Path, gaussians: Gaussians) -> None:
    """Write the records of web viewers (antimatter15's .splat), 32 bytes a Gaussian, the largest first.

    Position and scales as float32, colour and opacity as bytes, the quaternion in bytes of 1/128.
    Harmonics above degree 0 are lost.

    Raises
    ------
    ShapeError
        If they have a batch, more than three channels or values that are not finite.
    """
    kept = stored(gaussians)
    records = np.zeros(len(kept.means), _RECORD)
    records["position"], records["scale"] = kept.means, kept.scales
    color = 0.5 + kept.sh[:, 0] * float(harmonics(torch.zeros(3), 0))
    tone = np.concatenate([color, kept.opacities[:, None]], 1)
    records["color"] = np.clip(np.round(255 * tone), 0, 255)
    records["rotation"] = np.clip(np.round(128 * kept.quaternions + 128), 0, 255)
    # Viewers that load piece by piece show the most important ones first.
    order = np.argsort(-kept.scales.prod(1) * kept.opacities, kind="stable")
    with written_whole(path) as temporary:
        temporary.write_bytes(records[order].tobytes())


def read_splat(path: str | Path) -> Gaussians:
    """Read what `write_splat` writes; harmonics of degree 0 give the colour.

    Raises
    ------
    FileFormatError
        If the file is missing, cut off in a record, or holds values that are not finite.
    """
    try:
        raw = Path(path).read_bytes()
    except OSError as error:
        raise FileFormatError(f"cannot read {path}: {error.strerror}") from error
    if len(raw) % _RECORD.itemsize:
        raise FileFormatError(
            f"{path} has {len(raw)} bytes, not a whole number of {_RECORD.itemsize}-byte records: cut off, "
            "or no .splat"
        )
    records = np.frombuffer(raw, _RECORD)
    bad = ~(np.isfinite(records["position"]) & np.isfinite(records["scale"])).all(1)
    if bad.any():
        raise FileFormatError(
            f"{path}: {bad.sum()} records are NaN or infinite, the first is {np.flatnonzero(bad)[0]}; "
            "perhaps it is no .splat"
        )
    tone = torch.from_numpy(records["color"].astype(np.float32) / 255)
    return Gaussians(
        torch.from_numpy(records["position"].astype(np.float32)),
        torch.from_numpy((records["rotation"].astype(np.float32) - 128) / 128),
        torch.from_numpy(records["scale"].astype(np.float32)),
        tone[:, 3].contiguous(),
        sh=first_harmonic(tone[:, :3]),
    )
