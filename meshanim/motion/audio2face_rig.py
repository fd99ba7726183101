"""NVIDIA's own rigs: the options of a solve from its JSON, the shapes from bs_skin.npz."""

import json
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from meshanim.errors import FileFormatError, OptionError
from meshanim.motion.blendshape_solver import BlendshapeSolver, SolverOptions
from meshanim.motion.box_programs import Backend
from meshanim.motion.vertex_sampling import VertexSampling

__all__ = ["audio2face_solver", "read_solver_config"]

CENTIMETRE = 0.01
# Audio2Face-3D SDK: what multiplies each strength, beside the square of the bounding box over templateBBSize.
SCALES = {"l2": 10.0, "temporal": 100.0, "symmetry": 10.0}


def read_solver_config(
    path: str | Path, names: Sequence[str], samples: int, nvidia_parity: bool = False
) -> SolverOptions:
    """Options from the JSON beside a rig: numPoses, bsSolveActivePoses, strengthL2regularization and so on.

    NVIDIA sums over vertices where we take a mean, so its strengths are divided by their number.

    Parameters
    ----------
    path : str or Path
        The JSON; its keys at the top or in one object such as "blendshape_params".
    names : (numPoses,) str
        Shapes in the order of the file, without the neutral.
    samples : int
        Vertices that the solve looks at.
    nvidia_parity : bool
        As of `SolverOptions`.

    Raises
    ------
    FileFormatError
        If the file is missing, no such JSON, or of another number of poses.
    """
    values = _config(Path(path))
    count = len(names)
    if values["numPoses"] != count:
        raise FileFormatError(f"{path} is for {values['numPoses']} poses, the rig has {count}")
    try:
        active = _numbers(values, "bsSolveActivePoses", count, 1)
        multipliers = _numbers(values, "bsWeightMultipliers", count, 1)
        offsets = _numbers(values, "bsWeightOffsets", count, 0)
        return SolverOptions(
            l2=SCALES["l2"] * float(values.get("strengthL2regularization", 3.5)) / samples,
            l1=0.25 * float(values.get("strengthL1regularization", 1.0)) ** 2 / samples,
            temporal=SCALES["temporal"] * float(values.get("strengthTemporalSmoothing", 0.0)) / samples,
            symmetry=SCALES["symmetry"] * float(values.get("strengthSymmetry", 100.0)) / samples,
            active=tuple(name for name, on in zip(names, active) if on),
            cancelling=_pairs(values, "bsSolveCancelPoses", names),
            symmetric=_pairs(values, "bsSolveSymmetryPoses", names),
            multipliers={name: by for name, by in zip(names, multipliers) if by != 1},
            offsets={name: by for name, by in zip(names, offsets) if by != 0},
            template_size=float(values.get("templateBBSize", 54.7)),
            nvidia_parity=nvidia_parity,
        )
    except (TypeError, ValueError) as error:
        raise FileFormatError(f"{path} has a value of the wrong kind: {error}") from error


def audio2face_solver(
    rig: str | Path, config: str | Path | None = None, nvidia_parity: bool = False, backend: Backend = "auto"
) -> BlendshapeSolver:
    """The solver of a bs_skin.npz or bs_tongue.npz of Audio2Face-3D, in metres.

    The file has poseNames, the neutral (V, 3), a (V, 3) array of displacements a pose, and frontalMask, the
    vertices to look at (indices, or a 0 or 1 for each vertex); centimetres.

    Parameters
    ----------
    rig : str or Path
    config : str or Path, optional
        The JSON beside it; our own options if not given.
    nvidia_parity, backend
        As of `SolverOptions` and `BlendshapeSolver`.

    Raises
    ------
    FileFormatError
        If a file is missing, damaged or of another kind.
    """
    try:
        with np.load(rig, allow_pickle=False) as archive:
            names = [str(name) for name in archive["poseNames"] if str(name) != "neutral"]
            neutral = CENTIMETRE * archive["neutral"].astype(np.float64)
            deltas = np.stack([archive[name] for name in names]).astype(np.float32) * np.float32(CENTIMETRE)
            mask = archive["frontalMask"] if "frontalMask" in archive else np.arange(len(neutral))
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise FileFormatError(f"{rig} is no rig of Audio2Face-3D: {error}") from error
    binary = len(mask) == len(neutral) and set(np.unique(mask)) <= {0, 1}
    rows = np.flatnonzero(mask) if binary else np.unique(mask).astype(np.int64)
    if not len(rows) or rows[-1] >= len(neutral):
        raise FileFormatError(f"{rig}: frontalMask names vertex {rows.max(initial=-1)} of {len(neutral)}")
    options = None if config is None else read_solver_config(config, names, len(rows), nvidia_parity)
    if config is None and nvidia_parity:
        raise OptionError("NVIDIA parity needs the JSON with NVIDIA's strengths")
    sampling = VertexSampling(rows, np.ones(len(rows)))
    return BlendshapeSolver(neutral, deltas, names, options, sampling, backend=backend)


def _config(path: Path) -> Mapping[str, Any]:
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise FileFormatError(f"cannot read {path}: {error.strerror or error}") from error
    except ValueError as error:
        raise FileFormatError(f"{path} is no JSON: {error}") from error
    for found in (values, *(values.values() if isinstance(values, dict) else ())):
        if isinstance(found, dict) and "numPoses" in found:
            return found
    raise FileFormatError(f"{path} has no numPoses: it is no config of a blendshape solve")


def _numbers(values: Mapping[str, Any], key: str, count: int, otherwise: float) -> list[float]:
    numbers = [float(value) for value in values.get(key, [otherwise] * count)]
    if len(numbers) != count:
        raise ValueError(f"{key} has {len(numbers)} entries for {count} poses")
    return numbers


def _pairs(values: Mapping[str, Any], key: str, names: Sequence[str]) -> tuple[tuple[str, str], ...]:
    """Names that share an id; -1 is in no pair."""
    ids = [int(value) for value in _numbers(values, key, len(names), -1)]
    groups = {
        number: [name for name, own in zip(names, ids) if own == number] for number in ids if number >= 0
    }
    for number, members in groups.items():
        if len(members) != 2:
            raise ValueError(f"{key}: id {number} is shared by {len(members)} poses, not 2")
    return tuple((first, second) for first, second in groups.values())
