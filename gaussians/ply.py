"""The .ply of 3D Gaussian Splatting, and GaussianAvatars' with the triangle of each Gaussian."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32
from plyfile import PlyData, PlyElement, PlyParseError
from torch import Tensor

from meshanim.errors import FileFormatError, OptionError, ShapeError
from meshanim.files import written_whole
from meshanim.gaussians.binding import Binding
from meshanim.gaussians.gaussians import Gaussians
from meshanim.gaussians.harmonics import COEFFICIENTS, harmonics
from meshanim.geometry import TriangleMesh

__all__ = ["Stored", "first_harmonic", "read_bound_ply", "read_ply", "stored", "write_ply"]

LEAST_OPACITY = 1e-6
"""Opacities are kept within this of 0 and 1, where their logits are infinite."""
LEAST_SCALE = 1e-12
"""Metres; scales of zero have no logarithm."""


class Stored(NamedTuple):
    """What files keep: float32, without a batch, colours as harmonics, unit quaternions."""

    means: Float32[np.ndarray, "n 3"]
    quaternions: Float32[np.ndarray, "n 4"]
    scales: Float32[np.ndarray, "n 3"]
    opacities: Float32[np.ndarray, " n"]
    sh: Float32[np.ndarray, "n coefficients 3"]


def first_harmonic(colors: Float[Tensor, "n 3"]) -> Float[Tensor, "n 1 3"]:
    """The coefficient of degree 0 that shows a colour from everywhere."""
    return (colors[:, None] - 0.5) / harmonics(colors.new_zeros(3), 0)


def stored(gaussians: Gaussians) -> Stored:
    """Gaussians as files keep them.

    Raises
    ------
    ShapeError
        If they have a batch, other than three channels, or values that are not finite.
    """
    if gaussians.batch_shape:
        raise ShapeError(
            f"a file holds Gaussians without a batch, not of {tuple(gaussians.batch_shape)}: choose a frame"
        )
    sh = gaussians.sh
    if sh is None:
        assert gaussians.colors is not None
        if gaussians.colors.shape[1] != 3:
            raise ShapeError(f"a file holds red, green and blue, not {gaussians.colors.shape[1]} channels")
        sh = first_harmonic(gaussians.colors)
    fields = {
        "means": gaussians.means,
        "quaternions": torch.nn.functional.normalize(gaussians.quaternions, dim=-1),
        "scales": gaussians.scales,
        "opacities": gaussians.opacities,
        "sh": sh,
    }
    for name, field in fields.items():
        bad = (~torch.isfinite(field[..., None].flatten(1))).any(1)
        if bool(bad.any()):
            first = int(bad.nonzero()[0])
            raise ShapeError(f"{name}: {int(bad.sum())} Gaussians are NaN or infinite, the first is {first}")
    return Stored(*(field.detach().cpu().to(torch.float32).numpy() for field in fields.values()))


def write_ply(path: str | Path, gaussians: Gaussians, binding: Binding | None = None) -> None:
    """Write the .ply that 3D Gaussian Splatting trains and viewers read: binary, little-endian, float32.

    x y z, nx ny nz (zeros), f_dc_0.. and f_rest_0.. (channel by channel), opacity (logit), scale_0.. (log),
    rot_0.. (w, x, y, z). For viewers write the world's Gaussians of one frame (`Binding.to_world`). With a
    binding, the Gaussians are local and `binding_0` names the triangle of each, as GaussianAvatars
    (Qian et al. 2024) writes them; the mesh goes into a file of its own.

    Parameters
    ----------
    path : str or Path
        Written whole.
    gaussians : Gaussians
        Without a batch. Colours are written as harmonics of degree 0. Opacities are kept within 1e-6 of 0
        and 1, scales above 1e-12.
    binding : Binding, optional
        If the Gaussians are local ones.

    Raises
    ------
    ShapeError
        If they have a batch, other than three channels, values that are not finite, or another number than
        are bound.
    """
    kept = stored(gaussians)
    opacities = np.clip(kept.opacities.astype(np.float64), LEAST_OPACITY, 1 - LEAST_OPACITY)
    columns = {name: kept.means[:, axis] for axis, name in enumerate("xyz")}
    columns |= {name: np.zeros(len(kept.means), np.float32) for name in ("nx", "ny", "nz")}
    columns |= _numbered("f_dc", kept.sh[:, 0])
    rest = kept.sh[:, 1:].transpose(0, 2, 1)
    columns |= _numbered("f_rest", rest.reshape(len(rest), rest.shape[1] * rest.shape[2]))
    columns["opacity"] = np.log(opacities / (1 - opacities)).astype(np.float32)
    columns |= _numbered("scale", np.log(np.maximum(kept.scales, LEAST_SCALE)))
    columns |= _numbered("rot", kept.quaternions)
    if binding is not None:
        if len(binding) != len(gaussians):
            raise ShapeError(f"{len(gaussians)} Gaussians given, {len(binding)} are bound")
        columns["binding_0"] = binding.face.cpu().numpy().astype(np.float32)
    table = np.empty(len(kept.means), [(name, "<f4") for name in columns])
    for name, column in columns.items():
        table[name] = column
    with written_whole(path) as temporary:
        PlyData([PlyElement.describe(table, "vertex")], byte_order="<").write(str(temporary))


def _numbered(name: str, columns: np.ndarray) -> dict[str, np.ndarray]:
    return {f"{name}_{index}": column for index, column in enumerate(columns.T)}


def read_ply(path: str | Path) -> Gaussians:
    """Gaussians of the world from a .ply, whoever wrote it: binary or ascii, properties in any order.

    Returns
    -------
    Gaussians
        float32, colours as harmonics of the file's degree.

    Raises
    ------
    FileFormatError
        If the file is missing, damaged or no .ply of Gaussians, lacks a property or holds NaN, or if its
        Gaussians are bound to triangles (`read_bound_ply`).
    """
    table = _table(path)
    if "binding_0" in (table.dtype.names or ()):
        raise FileFormatError(
            f"{path} has Gaussians in the frames of triangles (binding_0), not of the world: "
            "read it with read_bound_ply and the mesh"
        )
    return _gaussians(path, table)


def read_bound_ply(path: str | Path, mesh: TriangleMesh) -> tuple[Binding, Gaussians]:
    """Binding and local Gaussians from a .ply of GaussianAvatars or of `write_ply` with a binding.

    Parameters
    ----------
    path : str or Path
        The file.
    mesh : TriangleMesh
        At rest, with the triangles that the file means.

    Raises
    ------
    FileFormatError
        As `read_ply`; if nothing is bound, or to triangles that the mesh has not.
    """
    table = _table(path)
    if "binding_0" not in (table.dtype.names or ()):
        raise FileFormatError(
            f"{path} has no binding_0: its Gaussians are the world's, read it with read_ply"
        )
    face = table["binding_0"].astype(np.float64)
    if not np.array_equal(face, np.round(face)):
        raise FileFormatError(f"{path}: binding_0 must be whole numbers")
    try:
        return Binding(mesh, torch.from_numpy(face.astype(np.int64))), _gaussians(path, table)
    except OptionError as error:
        raise FileFormatError(f"{path} is bound to another mesh than {mesh!r}: {error}") from error


def _table(path: str | Path) -> np.ndarray:
    try:
        data = PlyData.read(str(path))
    except OSError as error:
        raise FileFormatError(f"cannot read {path}: {error.strerror or error}") from error
    except (PlyParseError, UnicodeDecodeError, ValueError) as error:
        raise FileFormatError(f"{path} is no whole .ply: {error}") from error
    if "vertex" not in data:
        raise FileFormatError(f"{path} has no vertices, but {[element.name for element in data.elements]}")
    return data["vertex"].data


def _gaussians(path: str | Path, table: np.ndarray) -> Gaussians:
    names = table.dtype.names or ()
    n_rest = sum(name.startswith("f_rest_") for name in names)
    if n_rest // 3 + 1 not in COEFFICIENTS or n_rest % 3:
        raise FileFormatError(f"{path} has {n_rest} f_rest properties; degree 0 to 3 has 0, 9, 24 or 45")
    wanted = {
        "means": ["x", "y", "z"],
        "first": [f"f_dc_{channel}" for channel in range(3)],
        "rest": [f"f_rest_{index}" for index in range(n_rest)],
        "opacities": ["opacity"],
        "scales": [f"scale_{axis}" for axis in range(3)],
        "quaternions": [f"rot_{part}" for part in range(4)],
    }
    missing = [name for group in wanted.values() for name in group if name not in names]
    if missing:
        raise FileFormatError(f"{path} is no .ply of Gaussians: it lacks {', '.join(missing)}")
    groups = {}
    for key, group in wanted.items():
        columns = [table[name].astype(np.float32) for name in group]
        groups[key] = np.stack(columns, 1) if columns else np.zeros((len(table), 0), np.float32)
        if not np.isfinite(groups[key]).all():
            bad = np.flatnonzero(~np.isfinite(groups[key]).all(1))
            raise FileFormatError(
                f"{path}: {len(bad)} Gaussians have NaN or infinite {', '.join(group)}, the first is {bad[0]}"
            )
    if not (groups["quaternions"] ** 2).sum(1).all():
        bad = np.flatnonzero(~(groups["quaternions"] ** 2).sum(1).astype(bool))
        raise FileFormatError(f"{path}: {len(bad)} Gaussians have a rotation of zero, the first is {bad[0]}")
    rest = groups["rest"].reshape(len(table), 3, n_rest // 3).transpose(0, 2, 1)
    tensors = {key: torch.from_numpy(np.ascontiguousarray(group)) for key, group in groups.items()}
    return Gaussians(
        tensors["means"],
        tensors["quaternions"],
        tensors["scales"].exp(),
        tensors["opacities"][:, 0].sigmoid(),
        sh=torch.from_numpy(np.ascontiguousarray(np.concatenate([groups["first"][:, None], rest], 1))),
    )
