"""What can be wrong with a data set, found by reading all of it."""

import hashlib
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from tqdm import tqdm

from meshanim.audio import Waveform
from meshanim.datasets.motion_dataset import DatasetSource, MotionArrays, MotionDataset, SequenceInfo
from meshanim.errors import MeshanimError
from meshanim.jobs import run_jobs

__all__ = ["SequenceReport", "check_dataset", "check_sequence", "opened"]

TOLERANCE = 2.0
"""Frames by which sound and motion may differ in length; published data differ by one."""
SILENCE = 1e-4
"""Largest amplitude of a recording that is silent (full scale is 1)."""
CHUNK = 64


@dataclass(frozen=True)
class SequenceReport:
    """What is wrong with one sequence, and digests by which to find it twice.

    Parameters
    ----------
    name : str
        Of the sequence.
    defects : tuple of str
        One line each, without the name.
    motion, audio : str
        Digests of the arrays and of the samples; empty where they cannot be read.
    """

    name: str
    defects: tuple[str, ...]
    motion: str
    audio: str


def check_sequence(dataset: MotionDataset, name: str) -> SequenceReport:
    """Read all of one sequence."""
    defects: list[str] = []
    motion = audio = ""
    info: SequenceInfo | None = None
    try:
        info = dataset.info(name)
        arrays = dataset.motion(name)
        motion = _digest_of_motion(arrays)
        defects += _motion_defects(dataset, info, arrays)
    except MeshanimError as error:
        defects.append(str(error))
    try:
        waveform = dataset.audio(name)
        audio = hashlib.blake2b(waveform.samples.tobytes(), digest_size=16).hexdigest()
        defects += _audio_defects(waveform, info)
    except MeshanimError as error:
        defects.append(str(error))
    return SequenceReport(name, tuple(dict.fromkeys(defects)), motion, audio)


def _digest_of_motion(arrays: MotionArrays) -> str:
    digest = hashlib.blake2b(digest_size=16)
    for first in range(0, len(arrays.vertices), CHUNK):
        digest.update(np.ascontiguousarray(arrays.vertices[first : first + CHUNK]).tobytes())
    if arrays.curves is not None:
        digest.update(np.ascontiguousarray(arrays.curves).tobytes())
    for key in sorted(arrays.coefficients):
        digest.update(np.ascontiguousarray(arrays.coefficients[key]).tobytes())
    return digest.hexdigest()


def _motion_defects(dataset: MotionDataset, info: SequenceInfo, arrays: MotionArrays) -> Iterator[str]:
    vertices = arrays.vertices
    if info.frames == 0:
        yield "has no frames"
    template = dataset.subjects[info.subject].template
    bad, farthest = [], 0.0
    for first in range(0, len(vertices), CHUNK):
        distance = np.abs(vertices[first : first + CHUNK] - template)
        finite = np.isfinite(distance).all(axis=(1, 2))
        bad += list(first + np.flatnonzero(~finite))
        if finite.any() and distance.size:
            farthest = max(farthest, float(distance[finite].max()))
    if bad:
        yield f"vertices are not finite in {len(bad)} frames, the first is {bad[0]}"
    if dataset.unit == "m" and farthest > 1:
        yield f"vertices leave their template by {farthest:.3g} m: wrong unit?"
    others = {"pose": arrays.pose, "curves": arrays.curves, **arrays.coefficients}
    for key, array in others.items():
        if array is not None and not np.isfinite(array).all():
            yield f"{key} is not finite"


def _audio_defects(waveform: Waveform, info: SequenceInfo | None) -> Iterator[str]:
    loudest = float(np.abs(waveform.samples).max())
    if loudest <= SILENCE:
        yield f"the sound is silent: its largest amplitude is {loudest:.1e}"
    if info is None:
        return
    excess = info.frames - waveform.duration * info.fps
    if abs(excess) > TOLERANCE:
        yield (
            f"{info.frames / info.fps:.2f} s of motion and {waveform.duration:.2f} s of sound: the motion is "
            f"{abs(excess):.1f} frames too {'long' if excess > 0 else 'short'}"
        )


@lru_cache(maxsize=1)
def opened(source: DatasetSource) -> MotionDataset:
    """The data set in this process, opened once."""
    return source.open()


def _check_job(job: tuple[DatasetSource, str]) -> SequenceReport:
    source, name = job
    return check_sequence(opened(source), name)


def check_dataset(dataset: MotionDataset, progress: bool = False, workers: int = 1) -> list[str]:
    """Every defect of a data set as one line "where: what".

    Parameters
    ----------
    dataset : MotionDataset
        What to read.
    progress : bool
        Show a bar.
    workers : int
        Local processes; 0 takes one a core, 1 this process.
    """
    found: Iterator[SequenceReport]
    if workers == 1:
        found = (check_sequence(dataset, name) for name in dataset.sequences)
    else:
        found = run_jobs(_check_job, [(dataset.source, name) for name in dataset.sequences], workers)
    bar = tqdm(found, "check", len(dataset), unit="sequence", disable=not progress)
    reports = sorted(bar, key=lambda report: report.name)
    lines = _merged(reports)
    lines += _twice(reports)
    lines += _subject_defects(dataset)
    lines += _split_defects(dataset)
    return lines


def _merged(reports: list[SequenceReport]) -> list[str]:
    """A line a defect; what is wrong with one file that many sequences share is said once."""
    names = defaultdict(list)
    for report in reports:
        for defect in report.defects:
            names[defect].append(report.name)
    return [
        f"{where[0]}{f' and {len(where) - 1} more' if len(where) > 1 else ''}: {defect}"
        for defect, where in names.items()
    ]


def _twice(reports: list[SequenceReport]) -> Iterator[str]:
    for what in ("motion", "audio"):
        seen = defaultdict(list)
        for report in reports:
            if getattr(report, what):
                seen[getattr(report, what)].append(report.name)
        for names in seen.values():
            if len(names) > 1:
                noun = "motion" if what == "motion" else "sound"
                yield f"{', '.join(names[1:])}: the same {noun} as {names[0]}: duplicated sentence"


def _subject_defects(dataset: MotionDataset) -> Iterator[str]:
    sizes = {name: subject.template.shape for name, subject in dataset.subjects.items()}
    count = dataset.mesh.n_vertices if dataset.mesh else max((size[0] for size in sizes.values()), default=0)
    for name, subject in dataset.subjects.items():
        if sizes[name] != (count, 3):
            yield f"{name}: template has {sizes[name][0]} vertices, expected {count}"
        if not np.isfinite(subject.template).all():
            yield f"{name}: template is not finite"


def _split_defects(dataset: MotionDataset) -> Iterator[str]:
    present = set(dataset.sequences)
    for split, names in dataset.splits.items():
        for name in names:
            if name not in present:
                yield f"{name}: split {split} names it, but there is no such sequence"
    if dataset.splits:
        members = {name for names in dataset.splits.values() for name in names}
        for name in dataset.sequences:
            if name not in members:
                yield f"{name}: in no split"
