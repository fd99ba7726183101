"""UniTalker's A2F-Bench (Fan et al. 2024): one folder a data set, annotations of many kinds.

    DIR/train.json, val.json, test.json   {"info": {"id_list": [NAME, ...]},
                                           "data": [{"annot_path", "audio_path", "id", "annot_type",
                                                     "dataset", "fps"}, ...]}, paths from DIR
    DIR/id_template.npy                   a template for each of id_list, in the unit of the annotations
    DIR/pca.npz                           optional: principal components of the offsets from the template

An annotation is a .npy file (T, ...), 25 to 100 frames a second: vertices; blendshape weights; or FLAME as
DAD-3DHeads gives it, 413 numbers: 300 shape, 100 expression, 3 jaw, 6 rotation (the first two columns of the
matrix, in an image whose y points down), 3 translation, 1 scale. Sound is a wav file or a .npy of samples at
16 kHz. UniTalker's own loader takes every second frame of 60 and every fourth of 100, cuts at 20 s, leaves
out what is shorter than 0.5 s and multiplies BIWI by 0.2; here that is left to `stride` and `scale`.
"""

import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import roma
import torch
from jaxtyping import Float, Float32

from meshanim.audio import Waveform, load_waveform
from meshanim.datasets.flame_coefficients import (
    CoefficientOptions,
    flame_template,
    flame_vertices,
    optional_head,
)
from meshanim.datasets.motion_dataset import MotionArrays, MotionDataset, SequenceInfo, Subject
from meshanim.datasets.multiface_topology import read_obj
from meshanim.errors import FileFormatError, OptionError, ShapeError

__all__ = ["PrincipalComponents", "UniTalkerDataset", "UniTalkerOptions"]

SPLITS = ("train", "val", "test")
SAMPLE_RATE = 16000
ENTRY = ("annot_path", "audio_path", "id", "annot_type", "dataset", "fps")
FLAME_WIDTHS = {"shape": 300, "expression": 100, "jaw": 3, "rotation_6d": 6, "translation": 3, "scale": 1}


@dataclass(frozen=True)
class Annotation:
    """A kind of annotation: what it holds, its width, and its unit."""

    holds: str
    width: int
    unit: str = "m"
    scale: float = 1.0


ANNOTATIONS = {
    "BIWI_23370_vertices": Annotation("vertices", 23370 * 3, "biwi"),
    "FLAME_5023_vertices": Annotation("vertices", 5023 * 3),
    "FLAME_SUB_2055_vertices": Annotation("vertices", 2055 * 3),
    "meshtalk_6172_vertices": Annotation("vertices", 6172 * 3, scale=0.001),
    "3DETF_blendshape_weight": Annotation("curves", 52),
    "inhouse_blendshape_weight": Annotation("curves", 51),
    "24_viseme": Annotation("curves", 24),
    "flame_params_from_dadhead": Annotation("flame", sum(FLAME_WIDTHS.values())),
}


@dataclass(frozen=True)
class UniTalkerOptions(CoefficientOptions):
    """What the folder does not say.

    Parameters
    ----------
    scale : float, optional
        Metres for one unit of annotated vertices. By default 1, 0.001 for MeshTalk's, and BIWI's unit is
        kept; UniTalker takes 0.2 for BIWI.
    faces : path, optional
        OBJ with the faces of the annotated vertices.
    curve_names : tuple of str
        Names of the blendshapes, which the folder does not give; by default blendshape_00 and on.
    """

    scale: float | None = None
    faces: Path | None = None
    curve_names: tuple[str, ...] = ()

    def __post_init__(self):
        super().__post_init__()
        if self.scale is not None and not self.scale > 0:
            raise OptionError(f"scale must be positive, not {self.scale}")


@dataclass(frozen=True)
class PrincipalComponents:
    """The linear model of pca.npz; an offset is `mean + coefficients @ components`, in the files' unit.

    Parameters
    ----------
    components : (K, D) float32
        Orthonormal rows.
    mean : (D,) float32
        Of the offsets from the templates.
    coefficient_mean, coefficient_std : (K,) float32
        Of the training data.
    """

    components: Float32[np.ndarray, "components width"]
    mean: Float32[np.ndarray, " width"]
    coefficient_mean: Float32[np.ndarray, " components"]
    coefficient_std: Float32[np.ndarray, " components"]


class UniTalkerDataset(MotionDataset):
    """Reads one folder of the benchmark; a sequence is named as its annotation's file.

    Vertices are memory-mapped where they are float32 in the data set's unit. Weights of blendshapes are the
    curves. FLAME's are coefficients `shape`, `expression`, `jaw`, `rotation_6d`, `translation`, `scale`, and
    the pose is their rotation, turned to y up.

    Parameters
    ----------
    directory : path
        With train.json, val.json or test.json, and id_template.npy.
    options : UniTalkerOptions, optional
        Unit, faces, names of curves, head.

    Raises
    ------
    FileFormatError
        If a part is missing or damaged, or annotations of different kinds or rates are mixed.
    """

    kind = "unitalker"
    files = "train.json, val.json or test.json, id_template.npy"
    Options = UniTalkerOptions

    @classmethod
    def detect(cls, directory: Path) -> bool:
        """By the templates and a split."""
        splits = any((directory / f"{split}.json").is_file() for split in SPLITS)
        return splits and (directory / "id_template.npy").is_file()

    def __init__(self, directory: str | Path, options: UniTalkerOptions | None = None):
        super().__init__(directory, options)
        records = {
            split: _read_split(path)
            for split in SPLITS
            if (path := self.directory / f"{split}.json").is_file()
        }
        if not any(data for _, data in records.values()):
            raise FileFormatError(f"{self.directory} has no entries in {self.files}")
        self._people = next(iter(records.values()))[0]
        if any(people != self._people for people, _ in records.values()):
            raise FileFormatError(f"{self.directory}: the splits have different id_list")
        entries = {split: data for split, (_, data) in records.items()}
        self._kind, fps, self.name = (self._one(entries, key) for key in ("annot_type", "fps", "dataset"))
        if self._kind not in ANNOTATIONS:
            raise FileFormatError(
                f"{self.directory}: no annotation {self._kind!r}; there are {', '.join(ANNOTATIONS)}"
            )
        self.fps = fps / self.options.stride
        self._annotation = ANNOTATIONS[self._kind]
        self._scale = self._annotation.scale if self.options.scale is None else self.options.scale
        self.unit = self._annotation.unit if self.options.scale is None else "m"
        self.curve_names = self._names_of_curves()
        is_flame = self._annotation.holds == "flame"
        self._head = optional_head(self.options.head) if is_flame else None
        if self.options.head and not is_flame:
            raise OptionError(f"{self.directory} holds {self._annotation.holds}: it has no use for a head")
        self.head = self.options.head
        self._entries, self.splits = _named(self.directory, entries)
        self.sequences = tuple(self._entries)
        self.subjects = self._read_subjects()
        self.mesh = self._topology()

    def _one(self, entries: dict[str, list[dict]], key: str) -> Any:
        """The value that all entries share."""
        found = Counter(entry[key] for data in entries.values() for entry in data)
        if len(found) != 1:
            counts = ", ".join(f"{value} ({count})" for value, count in found.most_common())
            raise FileFormatError(f"{self.directory} mixes {key}: {counts}; keep each in a folder of its own")
        return next(iter(found))

    def _names_of_curves(self) -> tuple[str, ...]:
        if self._annotation.holds != "curves":
            return ()
        width, names = self._annotation.width, tuple(self.options.curve_names)
        if names and len(names) != width:
            raise OptionError(f"{len(names)} curve_names are given, {self._kind} has {width}")
        return names or tuple(f"blendshape_{index:02d}" for index in range(width))

    def _read_subjects(self) -> dict[str, Subject]:
        path = self.directory / "id_template.npy"
        templates = _load(path)
        if len(templates) != len(self._people):
            raise FileFormatError(f"{path} has {len(templates)} templates, id_list {len(self._people)} names")
        subjects = {}
        for name, template in zip(self._people, templates):
            subjects[name] = self._subject(path, name, np.asarray(template, np.float32).ravel())
        return subjects

    def _subject(self, path: Path, name: str, row: np.ndarray) -> Subject:
        holds, width = self._annotation.holds, self._annotation.width
        if holds == "curves":
            return Subject(name, np.zeros((0, 3), np.float32))
        if row.size != width:
            raise FileFormatError(f"{path} has {row.size} numbers a template, {self._kind} has {width}")
        if holds == "vertices":
            return Subject(name, row.reshape(-1, 3) * np.float32(self._scale))
        shape = row[: FLAME_WIDTHS["shape"]].copy()
        return Subject(name, flame_template(self._head, shape), shape)

    def _topology(self):
        if self._head is not None:
            return self._head.mesh
        if not self.options.faces:
            return None
        mesh = read_obj(self.options.faces)
        if self._annotation.holds != "vertices" or mesh.n_vertices * 3 != self._annotation.width:
            raise FileFormatError(
                f"{self.options.faces} has {mesh.n_vertices} vertices, {self._kind} "
                f"{self._annotation.width // 3 if self._annotation.holds == 'vertices' else 'none'}"
            )
        templates = [subject.template for subject in self.subjects.values()]
        return mesh.with_vertices(np.mean(templates, axis=0))

    def _entry(self, name: str) -> dict[str, Any]:
        self._known(name)
        return self._entries[name]

    def _annotated(self, name: str) -> np.ndarray:
        """(T, D), memory-mapped, every `stride`-th frame."""
        path = self.directory / self._entry(name)["annot_path"]
        array = _load(path)
        width = self._annotation.width
        if array.ndim < 2 or int(np.prod(array.shape[1:])) != width:
            raise FileFormatError(f"{path} has shape {array.shape}, expected (frames, {width}): {self._kind}")
        return array.reshape(len(array), width)[:: self.options.stride]

    def info(self, name: str) -> SequenceInfo:
        """By the entry and the header of the annotation."""
        frames = len(self._annotated(name))
        return SequenceInfo(self._people[self._entry(name)["id"]], 0, "", self.fps, frames, name=name)

    def motion(self, name: str) -> MotionArrays:
        """Vertices, curves or coefficients, as the annotation is."""
        array = self._annotated(name)
        if self._annotation.holds == "vertices":
            vertices = np.asanyarray(array, np.float32)
            if self._scale != 1:
                vertices = vertices * np.float32(self._scale)
            return MotionArrays(vertices.reshape(len(array), -1, 3))
        array = np.array(array, np.float32)
        if self._annotation.holds == "curves":
            return MotionArrays(np.zeros((len(array), 0, 3), np.float32), curves=array)
        parts = np.split(array, np.cumsum(list(FLAME_WIDTHS.values()))[:-1], axis=1)
        coefficients = dict(zip(FLAME_WIDTHS, parts))
        vertices = flame_vertices(
            self._head, coefficients["shape"], coefficients["expression"], coefficients["jaw"]
        )
        path = self.directory / self._entry(name)["annot_path"]
        return MotionArrays(
            vertices, _upright_pose(coefficients["rotation_6d"], path), coefficients=coefficients
        )

    def audio(self, name: str) -> Waveform:
        """The sound of a sequence, the whole file."""
        path = self.directory / self._entry(name)["audio_path"]
        if path.suffix != ".npy":
            return load_waveform(path, rate=None)
        samples = _load(path)
        if samples.dtype.kind != "f":
            raise FileFormatError(f"{path} holds {samples.dtype}, expected float samples at {SAMPLE_RATE} Hz")
        try:
            return Waveform(samples, SAMPLE_RATE)
        except ShapeError as error:
            raise FileFormatError(f"{path}: {error}") from error

    def audio_file(self, name: str) -> Path | None:
        """Its file if it is a wav file."""
        path = self.directory / self._entry(name)["audio_path"]
        return path if path.suffix == ".wav" else None

    def components(self) -> PrincipalComponents | None:
        """The linear model of pca.npz; None where there is none.

        Raises
        ------
        FileFormatError
            If the file is damaged or of another width than the annotations.
        """
        path = self.directory / "pca.npz"
        if not path.is_file():
            return None
        keys = ["components_to_data", "original_data_mean", "data_components_mean", "data_components_std"]
        try:
            with np.load(path, allow_pickle=False) as archive:
                components, mean, *moments = (archive[key].astype(np.float32) for key in keys)
        except (OSError, ValueError, KeyError, EOFError) as error:
            raise FileFormatError(f"{path} is damaged or lacks one of {', '.join(keys)}: {error}") from error
        width = self._annotation.width
        if components.shape[1:] != (width,) or mean.shape != (width,):
            raise FileFormatError(f"{path} has components {components.shape}, expected (any, {width})")
        if any(moment.shape != (len(components),) for moment in moments):
            raise FileFormatError(
                f"{path} has moments of another number than its {len(components)} components"
            )
        return PrincipalComponents(components, mean, *moments)

    def check(self, progress: bool = False, workers: int = 1) -> list[str]:
        """As of every data set; also a damaged pca.npz."""
        defects = super().check(progress)
        try:
            self.components()
        except FileFormatError as error:
            defects.append(str(error))
        return defects


def _read_split(path: Path) -> tuple[tuple[str, ...], list[dict[str, Any]]]:
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        people = tuple(str(name) for name in record["info"]["id_list"])
        data = [{key: entry[key] for key in ENTRY} for entry in record["data"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise FileFormatError(
            f"{path} is no list of UniTalker: {type(error).__name__} {error}; expected info.id_list and data "
            f"with {', '.join(ENTRY)}"
        ) from error
    for entry in data:
        if not isinstance(entry["id"], int) or not 0 <= entry["id"] < len(people):
            raise FileFormatError(f"{path}: {entry['annot_path']} has id {entry['id']!r} of {len(people)}")
    return people, data


def _named(
    directory: Path, entries: dict[str, list[dict]]
) -> tuple[dict[str, dict], dict[str, tuple[str, ...]]]:
    """Entries by name, and the names of each split; one annotation in two splits is one sequence."""
    paths = {entry["annot_path"] for data in entries.values() for entry in data}
    stems = Counter(Path(path).stem for path in paths)
    named: dict[str, dict] = {}
    splits: dict[str, list[str]] = {}
    for split, data in entries.items():
        splits[split] = []
        for entry in data:
            path = Path(entry["annot_path"])
            name = path.stem if stems[path.stem] == 1 else "_".join(path.with_suffix("").parts)
            if named.setdefault(name, entry) != entry:
                raise FileFormatError(f"{directory}: {path} has two different entries")
            splits[split].append(name)
    return named, {split: tuple(names) for split, names in splits.items()}


def _load(path: Path) -> np.ndarray:
    """An array, memory-mapped."""
    try:
        return np.load(path, mmap_mode="r", allow_pickle=False)
    except OSError as error:
        raise FileFormatError(f"cannot read {path}: {error.strerror or error}") from error
    except (ValueError, EOFError) as error:
        raise FileFormatError(f"{path} is damaged or cut short: {error}") from error


def _upright_pose(columns: Float[np.ndarray, "frames 6"], path: Path) -> Float32[np.ndarray, "frames 3"]:
    """Axis-angle of two columns each (Zhou et al. 2019, Sec. 4.2), from image axes to y up and z forward."""
    raw = torch.from_numpy(np.asarray(columns, np.float64)).unflatten(1, (2, 3)).mT
    first = raw[:, :, 0]
    across = torch.linalg.cross(first, raw[:, :, 1])
    if not (across.norm(dim=1) > 1e-8).all():
        frame = int((~(across.norm(dim=1) > 1e-8)).int().argmax())
        raise FileFormatError(f"{path}: frame {frame} has no rotation in its six numbers")
    rotation = roma.special_gramschmidt(raw)
    upright = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=rotation.dtype)) @ rotation
    return roma.rotmat_to_rotvec(upright).numpy().astype(np.float32)
