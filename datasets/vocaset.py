"""VOCASET as it is published, the layout that VOCA reads.

    DIR/data_verts.npy            (N, 5023, 3) metres, zero pose, the frames of all sequences
    DIR/raw_audio_fixed.pkl       {subject: {sequence: {audio: int (T,), sample_rate: int}}}
    DIR/templates.pkl             {subject: (5023, 3)}
    DIR/subj_seq_to_idx.pkl       {subject: {sequence: {frame: row of data_verts}}}, rows in any order

60 frames a second, pickles of Python 2. Source: Cudeiro et al., Capture, Learning, and Synthesis of 3D
Speaking Styles, 2019, and VOCA's data reader.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int64

from meshanim.audio import Waveform
from meshanim.audio.waveform import FULL_SCALE
from meshanim.datasets.mesh_files import as_float32, load_mesh, read_npy
from meshanim.datasets.motion_dataset import (
    DatasetOptions,
    MotionArrays,
    MotionDataset,
    SequenceInfo,
    Subject,
)
from meshanim.datasets.published import VOCASET
from meshanim.errors import FileFormatError, MeshanimError, ShapeError
from meshanim.unpickle import load_pickle

__all__ = ["VocasetDataset", "VocasetOptions"]


@dataclass(frozen=True)
class VocasetOptions(DatasetOptions):
    """What the files do not say.

    Parameters
    ----------
    faces : path, optional
        A mesh file with FLAME's faces, such as VOCA's template/FLAME_sample.ply.
    """

    faces: Path | None = None


class VocasetDataset(MotionDataset):
    """Reads the layout above; data_verts.npy is memory-mapped, the sounds are loaded once, when first asked.

    A sequence is named SUBJECT_sentenceNN, as FaceFormer names it. Its vertices are a view of the file where
    its rows follow each other at one distance, and a copy of its own rows where they do not.

    Parameters
    ----------
    directory : path
        With the four files.
    options : VocasetOptions, optional
        Stride and faces.

    Raises
    ------
    FileFormatError
        If a pickle is missing, damaged, or names anything but arrays.
    """

    kind = "vocaset"
    files = "data_verts.npy, raw_audio_fixed.pkl, templates.pkl, subj_seq_to_idx.pkl"
    Options = VocasetOptions

    @classmethod
    def detect(cls, directory: Path) -> bool:
        """By subj_seq_to_idx.pkl."""
        return (directory / "subj_seq_to_idx.pkl").is_file()

    def __init__(self, directory: str | Path, options: VocasetOptions | None = None):
        super().__init__(directory, options)
        self.name = VOCASET.name
        self.fps = VOCASET.fps / self.options.stride
        templates = self._read_templates()
        self.subjects = {name: Subject(name, templates[name]) for name in VOCASET.ordered(templates)}
        index = self._nested("subj_seq_to_idx.pkl")
        self._rows = {
            f"{subject}_{sentence}": (subject, sentence, rows)
            for subject, sentences in index.items()
            for sentence, rows in sentences.items()
        }
        self.sequences = tuple(sorted(self._rows))
        self.splits = VOCASET.split([(name, *self._rows[name][:2]) for name in self.sequences])
        if self.options.faces is not None:
            self.mesh = load_mesh(self.options.faces, len(next(iter(templates.values()))))

    def _read_templates(self) -> dict[str, np.ndarray]:
        path = self.directory / "templates.pkl"
        templates = load_pickle(path)
        if (
            not isinstance(templates, dict)
            or not templates
            or not all(
                isinstance(value, np.ndarray) and value.ndim == 2 and value.shape[1] == 3
                for value in templates.values()
            )
        ):
            raise FileFormatError(f"{path} holds no dictionary of (vertices, 3) arrays")
        return {str(name): np.asarray(value, np.float32) for name, value in templates.items()}

    def _nested(self, file: str) -> dict[str, dict[str, Any]]:
        """A pickle of a dictionary by subject and sequence, of dictionaries."""
        path = self.directory / file
        content = load_pickle(path)
        if not isinstance(content, dict) or not all(
            isinstance(sentences, dict) and all(isinstance(entry, dict) for entry in sentences.values())
            for sentences in content.values()
        ):
            raise FileFormatError(f"{path} holds no dictionaries by subject and sequence")
        return content

    @cached_property
    def _vertices(self) -> np.ndarray:
        path = self.directory / "data_verts.npy"
        array = read_npy(path)
        expected = next(iter(self.subjects.values())).template.shape
        if array.ndim != 3 or array.shape[1:] != expected:
            raise FileFormatError(f"{path} has shape {array.shape}, expected (frames, {expected[0]}, 3)")
        return array

    @cached_property
    def _sounds(self) -> dict[str, dict[str, Any]]:
        return self._nested("raw_audio_fixed.pkl")

    def _frame_rows(self, name: str) -> Int64[np.ndarray, " frames"]:
        """Rows of data_verts.npy by frame."""
        self._known(name)
        rows = self._rows[name][2]
        path = self.directory / "subj_seq_to_idx.pkl"
        try:
            frames = np.array([int(frame) for frame in rows], np.int64)
            values = np.array([int(row) for row in rows.values()], np.int64)
        except (TypeError, ValueError) as error:
            raise FileFormatError(f"{path}: {name} has frames that are no numbers: {error}") from error
        return values[np.argsort(frames, kind="stable")]

    def info(self, name: str) -> SequenceInfo:
        """By the index of rows."""
        frames = len(self._frame_rows(name))
        subject, sentence, _ = self._rows[name]
        if subject not in self.subjects:
            raise FileFormatError(f"{self.directory / 'templates.pkl'} has no subject {subject!r}")
        number = VOCASET.number(sentence) or 0
        return self._strided(SequenceInfo(subject, number, "", VOCASET.fps, frames, name=name))

    def motion(self, name: str) -> MotionArrays:
        """Rows of the memory-mapped file."""
        rows = self._frame_rows(name)[:: self.options.stride]
        count = len(self._vertices)
        if len(rows) and not (rows.min() >= 0 and rows.max() < count):
            raise FileFormatError(
                f"{self.directory / 'data_verts.npy'} has {count} frames, {name} names row {rows.max()}"
            )
        steps = np.diff(rows)
        step = int(steps[0]) if len(steps) else 1
        if len(rows) and step > 0 and (steps == step).all():
            return MotionArrays(as_float32(self._vertices[rows[0] : rows[-1] + 1 : step]))
        return MotionArrays(np.asarray(self._vertices[rows], np.float32))

    def audio(self, name: str) -> Waveform:
        """The sound of a sequence; integers are 16-bit samples whatever their type."""
        self._known(name)
        subject, sentence, _ = self._rows[name]
        where = f"{self.directory / 'raw_audio_fixed.pkl'}: {name}"
        entry = self._sounds.get(subject, {}).get(sentence)
        if entry is None:
            raise FileFormatError(f"{where} has no sound")
        if not {"audio", "sample_rate"} <= set(entry):
            raise FileFormatError(f"{where} has {', '.join(map(str, entry))}, expected audio and sample_rate")
        try:
            samples, rate = np.asarray(entry["audio"]), int(entry["sample_rate"])
            return Waveform(_amplitudes(samples), rate)
        except (MeshanimError, TypeError, ValueError) as error:
            raise FileFormatError(f"{where}: {error}") from error


def _amplitudes(samples: np.ndarray) -> np.ndarray:
    if samples.dtype.kind == "f":
        return samples
    if samples.dtype.kind not in "iu":
        raise ShapeError(f"samples are of type {samples.dtype}, expected numbers")
    if samples.size and np.abs(samples.astype(np.int64)).max() > FULL_SCALE:
        raise ShapeError("samples are beyond 16 bits")
    return samples.astype(np.float32) / np.float32(FULL_SCALE)
