"""What `meshanim evaluate motion` measures: folders of motion, of whatever program, against recordings."""

import json
import re
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float32, Int64
from torch import Tensor
from tqdm import tqdm

from meshanim.datasets.motion_dataset import MotionDataset, detect_kind, loader_options, open_dataset
from meshanim.errors import FileFormatError, OptionError, ShapeError
from meshanim.heads import load_head
from meshanim.results import Results
from meshanim.training.metrics.masks import Mask, load_mask
from meshanim.training.motion_evaluation import JITTER_ABOVE, MotionEvaluation, MotionMasks, masks_of_head
from meshanim.unpickle import load_pickle

__all__ = ["EvaluateMotionOptions", "MotionScores", "evaluate_motion", "group_predictions", "read_motion"]

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "biwi": 1.0}
BILABIALS = ("P", "B", "M")
SAMPLE = re.compile(r"(?P<name>.+?)(_condition_(?P<condition>.+?))?(_sample_?(?P<number>\d+))?")
Unit = Literal["m", "cm", "mm", "biwi"]
Motion = Float32[np.ndarray, "frames vertices 3"]
Pose = Float32[np.ndarray, "frames 3"]


@dataclass(frozen=True)
class EvaluateMotionOptions:
    """Score a folder of predicted motion, of whatever program, against recorded motion.

    Example: meshanim evaluate motion --predicted results/npy --data vocaset --lips-mask vocaset_lve:lve.txt
    """

    predicted: Path
    """Folder of NAME.npy, (T, V * 3) or (T, V, 3), or NAME.npz with vertices and perhaps pose. Several
    predictions of one recording are NAME_condition_X or NAME_sampleK; all count for MEE, CE and diversity."""
    true: Path | None = None
    """Folder of the recordings in the same formats; or --data."""
    data: Path | None = None
    """A data set of any layout that meshanim data knows: recordings, templates, masks of its head."""
    split: str = ""
    """Of the data set: all of it has to be predicted, other predictions do not count."""
    stride: int = 1
    """Take every n-th frame of the data set (2 for VOCASET at 30 frames a second)."""
    fps: float | None = None
    """Frames a second; needed without --data, and for layouts that do not say."""
    unit: Unit = "m"
    """Of the files in the folders; biwi is BIWI's area-normalised unit, which no number in mm comes from."""
    templates: Path | None = None
    """templates.pkl or .npz of subjects at rest, in --unit, for FDD; those of --data if not given."""
    head: str = ""
    """Head whose regions are the masks: default, flame:/path/generic_model.pkl; the data's if not given."""
    lips_mask: str = ""
    """File of lip vertices, or NAME:FILE for a published mask whose count is checked (docs/metrics.md)."""
    upper_face_mask: str = ""
    """The same for FDD and AFDD."""
    eyes_mask: str = ""
    """The same for the eye error."""
    lip_pairs: Path | None = None
    """.npy (P, 2) or .json {"upper": [...], "lower": [...]} of inner lip vertices above each other."""
    jitter_above: float = JITTER_ABOVE
    """Hz above which the power of the lips' acceleration counts as jitter."""
    name: str = ""
    """Of what is scored; the folder's if not given."""
    json: Path | None = None
    """Where to write the rows, each sequence's numbers included, for meshanim evaluate compare."""

    def __post_init__(self):
        if (self.true is None) == (self.data is None):
            raise OptionError("give the recordings as --true DIR or as --data DIR, one of the two")
        if self.true is not None and (self.split or self.stride != 1):
            raise OptionError("--split and --stride are for --data")
        if self.true is not None and self.fps is None:
            raise OptionError("--true DIR does not say its rate: give --fps")


class MotionScores(NamedTuple):
    """Rows, and what a reader has to know about them, a line each."""

    results: Results
    notes: list[str]


class _Truth(NamedTuple):
    names: tuple[str, ...]
    fps: float
    unit: str
    dataset: MotionDataset | None
    folder: Mapping[str, Path]
    templates: Mapping[str, np.ndarray]
    scale: float


def read_motion(path: Path) -> tuple[Motion, Pose | None, float | None]:
    """Vertices of a .npy or .npz file, in its unit, its head pose and its rate where it has them.

    Raises
    ------
    FileFormatError
        If the file is damaged, or holds neither (T, V * 3) nor (T, V, 3).
    """
    try:
        if path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as archive:
                found = {key: archive[key] for key in ("vertices", "pose", "fps") if key in archive}
        else:
            found = {"vertices": np.load(path, allow_pickle=False)}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise FileFormatError(f"{path} is damaged or no array: {error}") from error
    if "vertices" not in found:
        raise FileFormatError(f"{path} has no array called vertices")
    vertices, pose = found["vertices"], found.get("pose")
    fps = float(found["fps"]) if "fps" in found else None
    if vertices.ndim == 4 and len(vertices) == 1:
        vertices = vertices[0]
    if vertices.ndim == 2 and vertices.shape[1] % 3 == 0:
        vertices = vertices.reshape(len(vertices), -1, 3)
    if vertices.ndim != 3 or vertices.shape[2] != 3 or vertices.dtype.kind != "f":
        raise FileFormatError(
            f"{path} has shape {vertices.shape} of {vertices.dtype}, expected (frames, vertices * 3) floats"
        )
    if pose is not None and pose.shape != (len(vertices), 3):
        raise FileFormatError(f"{path} has {len(vertices)} frames and pose of shape {pose.shape}")
    return vertices.astype(np.float32), None if pose is None else pose.astype(np.float32), fps


def group_predictions(stems: Sequence[str], names: Sequence[str]) -> dict[str, list[str]]:
    """Which files predict which recording, the one that is scored first.

    A file predicts the recording of its own name, or of what precedes _condition_X and _sampleK. First is the
    one without either, then the one whose condition is the recording's own subject (CodeTalker's protocol for
    BIWI-Test-A), then by name.

    Parameters
    ----------
    stems : sequence of str
        File names without ending.
    names : sequence of str
        Of the recordings.

    Raises
    ------
    OptionError
        If a file predicts no recording.
    """
    known = set(names)
    groups: dict[str, list[tuple[int, int, str]]] = {}
    for stem in stems:
        match = SAMPLE.fullmatch(stem)
        name = stem if stem in known or match is None else match["name"]
        if name not in known:
            raise OptionError(
                f"{stem} predicts none of the {len(known)} recordings, such as {min(known, default='none')}"
            )
        condition, number = (
            (None, None) if stem == name or match is None else match.group("condition", "number")
        )
        own = condition is None or name.startswith(f"{condition}_")
        order = (0 if condition is None else 1 if own else 2, int(number or 0), stem)
        groups.setdefault(name, []).append(order)
    return {name: [stem for *_, stem in sorted(groups[name])] for name in names if name in groups}


def evaluate_motion(options: EvaluateMotionOptions, progress: bool = True) -> MotionScores:
    """Every metric of docs/metrics.md that the masks and templates at hand allow.

    Raises
    ------
    FileFormatError, OptionError, ShapeError
        If a file cannot be read, a prediction is missing or of another topology, or a mask does not fit.
    """
    files = _motion_files(options.predicted)
    truth = _truth(options)
    known = truth.names if truth.dataset is None else truth.dataset.sequences
    predicted = group_predictions(list(files), known)
    groups = {name: predicted[name] for name in truth.names if name in predicted}
    missing = [name for name in truth.names if name not in groups]
    if options.split and missing:
        raise OptionError(
            f"{options.predicted} lacks {len(missing)} of {len(truth.names)} sequences, such as {missing[0]}"
        )
    notes = [f"{len(missing)} recordings have no prediction and do not count"] if missing else []
    several = {len(group) for group in groups.values()} - {1}
    if several:
        notes.append(
            f"up to {max(several)} predictions of a recording: errors are of the subject's own style"
            " or else the first by name; MEE, CE and diversity of all"
        )
    evaluation: MotionEvaluation | None = None
    without_template = 0
    for name, stems in tqdm(groups.items(), desc=options.predicted.name, unit="clip", disable=not progress):
        true, true_pose, bilabials = _recording(truth, name)
        samples, pose = _samples([files[stem] for stem in stems], truth)
        if evaluation is None:
            masks = _masks(options, truth, true.shape[1])
            notes += _unmeasured(masks)
            evaluation = MotionEvaluation(masks, truth.fps, truth.unit, options.jitter_above)
        template = _template(truth, name)
        without_template += template is None
        evaluation.add(name, samples, true, template, bilabials, pose, true_pose)
    if evaluation is None:
        raise OptionError(f"{options.predicted} predicts nothing of the recordings")
    if without_template:
        notes.append(f"{without_template} sequences have no template: no FDD and no Frechet distance of them")
    if evaluation.truncation:
        notes.append(evaluation.truncation)
    results = Results("evaluate motion")
    case = options.split or (truth.dataset.name if truth.dataset is not None else "recordings")
    for value in evaluation.values():
        results.add_measured(case, options.name or options.predicted.resolve().name, value)
    if options.json is not None:
        results.save(options.json)
    return MotionScores(results, notes)


def _motion_files(folder: Path) -> dict[str, Path]:
    files = sorted(path for path in folder.glob("*") if path.suffix in (".npy", ".npz"))
    if not files:
        raise FileFormatError(f"{folder} holds no .npy and no .npz files")
    stems = {path.stem: path for path in files}
    if len(stems) < len(files):
        raise FileFormatError(f"{folder} holds a motion twice, as .npy and as .npz")
    return stems


def _truth(options: EvaluateMotionOptions) -> _Truth:
    scale = METRES[options.unit]
    unit = "biwi" if options.unit == "biwi" else "m"
    templates = {} if options.templates is None else _read_templates(options.templates, scale)
    if options.true is not None:
        assert options.fps is not None
        files = _motion_files(options.true)
        return _Truth(tuple(files), options.fps, unit, None, files, templates, scale)
    assert options.data is not None
    kind = detect_kind(options.data)
    given = {"stride": options.stride, "fps": options.fps}
    dataset = open_dataset(options.data, kind, loader_options(kind, given))
    if dataset.unit != unit:
        raise OptionError(
            f"{options.data} is in {dataset.unit}, the predictions in {options.unit}: they cannot be compared"
        )
    names = dataset.split(options.split) if options.split else dataset.sequences
    return _Truth(names, dataset.fps, unit, dataset, {}, templates, scale)


def _recording(truth: _Truth, name: str) -> tuple[Tensor, Tensor | None, list[tuple[float, float]]]:
    if truth.dataset is None:
        vertices, pose, _ = _checked_rate(truth.folder[name], truth.fps)
        return torch.from_numpy(vertices * np.float32(truth.scale)), _tensor(pose), []
    info, arrays = truth.dataset.info(name), truth.dataset.motion(name)
    spans = [(start, end) for start, end, symbol in info.phonemes if symbol in BILABIALS]
    return torch.from_numpy(np.array(arrays.vertices)), _tensor(arrays.pose), spans


def _samples(paths: Sequence[Path], truth: _Truth) -> tuple[Tensor, Tensor | None]:
    """All predictions of a recording, cut to the shortest, and the pose of the first."""
    read = [_checked_rate(path, truth.fps) for path in paths]
    shapes = {vertices.shape[1] for vertices, _, _ in read}
    if len(shapes) > 1:
        raise ShapeError(f"{paths[0].stem}: predictions of {sorted(shapes)} vertices")
    frames = min(len(vertices) for vertices, _, _ in read)
    stacked = np.stack([vertices[:frames] for vertices, _, _ in read]) * np.float32(truth.scale)
    return torch.from_numpy(stacked), _tensor(read[0][1])


def _checked_rate(path: Path, fps: float) -> tuple[Motion, Pose | None, float | None]:
    vertices, pose, rate = read_motion(path)
    if rate is not None and abs(rate - fps) > 1e-3:
        raise OptionError(
            f"{path} has {rate:g} frames a second, the recordings {fps:g}: resample one of them"
        )
    return vertices, pose, rate


def _tensor(pose: np.ndarray | None) -> Tensor | None:
    return None if pose is None else torch.from_numpy(np.array(pose))


def _template(truth: _Truth, name: str) -> Float32[Tensor, "vertices 3"] | None:
    if truth.dataset is not None and not truth.templates:
        subject = truth.dataset.info(name).subject
        known = truth.dataset.subjects.get(subject)
        return None if known is None else torch.from_numpy(np.array(known.template))
    subject = name.rpartition("_")[0] if truth.dataset is None else truth.dataset.info(name).subject
    template = truth.templates.get(subject)
    return None if template is None else torch.from_numpy(template)


def _read_templates(path: Path, scale: float) -> dict[str, Float32[np.ndarray, "vertices 3"]]:
    if path.suffix == ".npz":
        try:
            with np.load(path, allow_pickle=False) as archive:
                content: object = dict(archive)
        except (OSError, ValueError, zipfile.BadZipFile) as error:
            raise FileFormatError(f"{path} is damaged or no .npz: {error}") from error
    else:
        content = load_pickle(path)
    if not isinstance(content, dict) or not all(
        isinstance(value, np.ndarray) and value.ndim == 2 and value.shape[1] == 3
        for value in content.values()
    ):
        raise FileFormatError(f"{path} holds no (vertices, 3) arrays by subject")
    return {str(name): (value * scale).astype(np.float32) for name, value in content.items()}


def _masks(options: EvaluateMotionOptions, truth: _Truth, mesh_vertices: int) -> MotionMasks:
    """Those of the head, replaced by those that are given."""
    head = options.head or (truth.dataset.head if truth.dataset is not None else "")
    masks = MotionMasks()
    if head:
        loaded = load_head(head)
        if loaded.n_vertices != mesh_vertices:
            raise ShapeError(f"head {head} has {loaded.n_vertices} vertices, the motion {mesh_vertices}")
        masks = masks_of_head(loaded)
    given: dict[str, Mask | Tensor] = {
        field: load_mask(specification, mesh_vertices)
        for field, specification in (
            ("lips", options.lips_mask),
            ("upper_face", options.upper_face_mask),
            ("eyes", options.eyes_mask),
        )
        if specification
    }
    if options.lip_pairs is not None:
        given["lip_pairs"] = _read_pairs(options.lip_pairs)
    return replace(masks, **given)  # type: ignore[arg-type]


def _read_pairs(path: Path) -> Int64[Tensor, "pairs 2"]:
    try:
        if path.suffix == ".npy":
            pairs = np.load(path, allow_pickle=False)
        else:
            content = json.loads(path.read_text(encoding="utf-8"))
            pairs = np.array(list(zip(content["upper"], content["lower"], strict=True)))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise FileFormatError(f"{path} holds no lip pairs: {error!r}") from error
    if pairs.ndim != 2 or pairs.shape[1] != 2 or pairs.dtype.kind not in "iu" or not len(pairs):
        raise FileFormatError(f"{path} holds {pairs.shape} of {pairs.dtype}, expected (pairs, 2) vertices")
    return torch.from_numpy(pairs.astype(np.int64))


def _unmeasured(masks: MotionMasks) -> list[str]:
    parts = {
        "lips": "lip errors, velocity, jitter and Frechet distance",
        "upper_face": "FDD and AFDD",
        "eyes": "eye error",
        "lip_pairs": "mouth opening and bilabials",
    }
    missing = [what for field, what in parts.items() if getattr(masks, field) is None]
    return [f"not measured, there is no mask: {'; '.join(missing)}"] if missing else []
