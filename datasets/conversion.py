"""From any data set to the project's own layout or to FaceFormer's, sequence by sequence."""

import json
import shutil
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path

from tqdm import tqdm

from meshanim.datasets.checking import opened
from meshanim.datasets.faceformer import (
    faceformer_stem,
    write_faceformer_sequence,
    write_faceformer_templates,
    write_faceformer_topology,
)
from meshanim.datasets.meshanim_format import write_dataset, write_sequence, write_subject
from meshanim.datasets.motion_dataset import DatasetSource, MotionDataset
from meshanim.errors import FileFormatError, MeshanimError, OptionError
from meshanim.files import written_whole
from meshanim.jobs import run_jobs

__all__ = ["FORMATS", "Conversion", "SequenceJob", "convert", "convert_sequence"]

FORMATS = ("meshanim", "faceformer")


@dataclass(frozen=True)
class SequenceJob:
    """One sequence to be converted, by any process that sees the files.

    Parameters
    ----------
    source : DatasetSource
        Where it comes from.
    name : str
        Of the sequence.
    target : Path
        Folder of the new data set, absolute.
    format : str
        meshanim or faceformer.
    skip_defects : bool
        Leave out what cannot be read instead of raising.
    """

    source: DatasetSource
    name: str
    target: Path
    format: str
    skip_defects: bool = False


@dataclass(frozen=True)
class Conversion:
    """What a conversion did.

    Parameters
    ----------
    directory : Path
        The new data set.
    sequences : int
        In it.
    kept : int
        Of them, from an earlier run.
    skipped : dict
        Why a sequence was left out, by name.
    """

    directory: Path
    sequences: int
    kept: int
    skipped: dict[str, str]


def _done(target: Path, name: str) -> bool:
    # The folder of a sequence is renamed into its place as the last of its files.
    return (target / "sequences" / name / "sequence.json").exists()


def convert_sequence(job: SequenceJob) -> tuple[str, str]:
    """Convert one sequence, unless it is there; its name, and why it was left out if it was.

    Raises
    ------
    MeshanimError
        If it cannot be read, unless defects are skipped.
    """
    if _done(job.target, job.name):
        return job.name, ""
    dataset = opened(job.source)
    try:
        sequence = dataset[job.name]
    except MeshanimError as error:
        if job.skip_defects:
            return job.name, str(error)
        if isinstance(error, FileFormatError):
            raise FileFormatError(f"{error} (--skip-defects leaves out {job.name})") from error
        raise
    sound = dataset.audio_file(job.name)
    if sound is not None and sound.suffix.lower() != ".wav":
        sound = None
    if job.format == "faceformer":
        write_faceformer_sequence(job.target, sequence, sound, lossless=True)
    else:
        write_sequence(job.target, sequence, sound, lossless=True)
    return job.name, ""


def convert(
    dataset: MotionDataset,
    target: str | Path,
    format: str = "meshanim",
    workers: int = 0,
    dask: str = "",
    skip_defects: bool = False,
    progress: bool = False,
) -> Conversion:
    """Write a data set in another layout; what an interrupted run has written is kept.

    Vertices stay in the data set's unit and at its frames a second. Wav files are copied byte by byte, other
    sounds are written as 16-bit or, where that would lose something, 32-bit wav. FaceFormer's layout gets
    what it has no place for beside it (`meshanim.datasets.faceformer`).

    Parameters
    ----------
    dataset : MotionDataset
        What to convert.
    target : path
        A new or empty folder, or one that the same conversion has begun.
    format : str
        meshanim or faceformer.
    workers : int
        Local processes; 0 takes one a core.
    dask : str
        Address of a Dask scheduler whose workers convert instead.
    skip_defects : bool
        Leave out sequences that cannot be read.
    progress : bool
        Show a bar.

    Raises
    ------
    OptionError
        If the folder holds something else, or there are no vertices for FaceFormer's layout.
    FileFormatError
        If a sequence cannot be read.
    """
    if format not in FORMATS:
        raise OptionError(f"no format {format!r} to convert to; there are {', '.join(FORMATS)}")
    directory = Path(target).resolve()
    stems = _stems(dataset) if format == "faceformer" else {}
    _claim(dataset, directory, format)
    jobs = [
        SequenceJob(dataset.source, name, directory, format, skip_defects)
        for name in dataset.sequences
        if not _done(directory, name)
    ]
    kept = len(dataset) - len(jobs)
    results = run_jobs(convert_sequence, jobs, workers, dask)
    bar = tqdm(results, "convert", len(dataset), initial=kept, unit="sequence", disable=not progress)
    skipped = {name: reason for name, reason in bar if reason}
    for subject in dataset.subjects.values():
        write_subject(directory, subject)
    if format == "faceformer":
        write_faceformer_templates(directory, list(dataset.subjects.values()))
        if dataset.mesh is not None:
            write_faceformer_topology(directory, dataset.mesh)
    write_dataset(
        directory,
        dataset.name,
        dataset.fps,
        dataset.head,
        dataset.mesh,
        dataset.curve_names,
        list(dataset.subjects.values()),
        {split: [n for n in names if n not in skipped] for split, names in dataset.splits.items()},
        dataset.unit,
        stems,
    )
    return Conversion(directory, len(dataset) - len(skipped), kept, dict(sorted(skipped.items())))


def _stems(dataset: MotionDataset) -> dict[str, str]:
    """Names of FaceFormer's files where they are not the sequences' own."""
    stems = {}
    for name in dataset.sequences:
        try:
            stems[name] = faceformer_stem(dataset.info(name))
        except MeshanimError:
            continue  # a defect, which the sequence's own job reports
    twice = [stem for stem, count in Counter(stems.values()).items() if count > 1]
    if twice:
        raise OptionError(f"several sequences would be {twice[0]} in FaceFormer's layout: rename one of them")
    return {name: stem for name, stem in stems.items() if name != stem}


def _claim(dataset: MotionDataset, directory: Path, format: str) -> None:
    """Make the folder ours: new, or begun by the same conversion; remove what was half written."""
    if directory == dataset.directory.resolve():
        raise OptionError(f"{directory} would be converted into itself; choose another folder")
    source = dataset.source
    begun = json.loads(
        json.dumps(
            {
                "source": str(source.directory),
                "kind": source.kind,
                "options": asdict(source.options),
                "format": format,
            },
            default=str,
        )
    )
    path = directory / "conversion.json"
    if path.exists():
        try:
            earlier = json.loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise FileFormatError(f"{path} is damaged: {error}; delete {directory}") from error
        other = [key for key in begun if earlier.get(key) != begun[key]]
        if other:
            was = ", ".join(f"{key} {earlier.get(key)}" for key in other)
            raise OptionError(f"{directory} was begun with {was}; choose another folder or delete it")
    else:
        if directory.exists() and any(directory.iterdir()):
            raise OptionError(f"{directory} is not empty and no conversion of this data set; choose another")
        try:
            directory.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise FileFormatError(f"cannot write {directory}: {error.strerror}") from error
        with written_whole(path) as temporary:
            temporary.write_text(json.dumps(begun, indent=1) + "\n", encoding="utf-8")
    for folder in ("sequences", "wav", "vertices_npy"):
        for left in (directory / folder).glob(".*"):
            shutil.rmtree(left) if left.is_dir() else left.unlink()
