"""Head pose for data sets that were recorded without: GAVA's pose attribute augmentation (Sec. III-B).

Poses come from a talking-head video of each sentence, from tracked poses on file, or from the prosody of the
sound; they are brought to the sequence's frames, filtered as rotations (Gaussian, sigma 1 frame, window 15)
and stored beside the zero-pose vertices, to be applied about the neck joint (`Head.pose`).
"""

import json
import os
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from tqdm import tqdm
from tyro.conf import Positional

from meshanim.audio import loudness, pitch
from meshanim.datasets.meshanim_format import MeshanimDataset
from meshanim.errors import DependencyError, FileFormatError, OptionError
from meshanim.files import check_writable, written_whole
from meshanim.jobs import run_jobs
from meshanim.motion.pose import pose_from_prosody, smooth_rotations
from meshanim.motion.pose_track import (
    PoseStatistics,
    PoseTrack,
    center_rotations,
    load_pose_track,
    pose_statistics,
    resample_rotations,
)
from meshanim.motion.video_pose import pose_from_video

__all__ = ["AugmentPoseOptions", "augment_pose", "plot_statistics"]

PROSODY_RATE = 100.0
NEW_POSE, BEGUN = ".pose-new.npy", ".pose-begun.json"
"""Poses of a run that is not finished, and its options."""
TRACKS = (".npz", ".npy", "")
VIDEOS = (".mp4", ".mov", ".mkv", ".avi", ".webm")


@dataclass(frozen=True)
class AugmentPoseOptions:
    """Give every sequence of a data set a head pose.

    Example: meshanim data augment-pose corpus --source video --tracks videos --plot poses.png
    """

    directory: Positional[Path]
    """Data set in the project's format (meshanim data convert makes one); its pose.npy files are replaced
    when all poses are made; an interrupted run is continued."""
    source: Literal["prosody", "video", "file"] = "prosody"
    """prosody: made from the sound. video: the face in NAME.mp4. file: NAME.npz, NAME.npy or folder NAME."""
    tracks: Path | None = None
    """Folder of the videos or tracks, named like the sequences."""
    fps: float | None = None
    """Frames a second of tracks that do not say it."""
    center: bool = False
    """Take each track relative to its mean: for cameras that did not look straight at the face."""
    gain: float = 1.0
    """Factor on every rotation."""
    sigma: float = 1.0
    """Of the Gaussian filter, frames; 0 for none."""
    window: int = 15
    """Of the filter, frames, odd."""
    seed: int = 0
    """Of prosody's random part."""
    plot: Path | None = None
    """Picture of the statistics of the poses (the paper's Fig. 4): .png, .svg or .pdf."""
    workers: int = 0
    """Processes; 0 takes one a core."""

    def __post_init__(self):
        if self.source != "prosody" and self.tracks is None:
            raise OptionError(f"--source {self.source} needs --tracks, the folder of the tracks")
        if self.gain < 0 or self.sigma < 0:
            raise OptionError(f"gain and sigma must not be negative, not {self.gain} and {self.sigma}")
        if self.window < 1 or self.window % 2 == 0:
            raise OptionError(f"window must be an odd number of frames, not {self.window}")


def augment_pose(options: AugmentPoseOptions, progress: bool = True) -> PoseStatistics:
    """Replace the pose of every sequence; give the statistics of all of them.

    New poses stand beside the old ones until all are made: a track that is damaged changes nothing, and a run
    with the same options goes on where one was interrupted.

    Raises
    ------
    FileFormatError
        If the data set, or the track of a sequence, is missing or damaged.
    """
    dataset = MeshanimDataset(options.directory)
    if options.plot is not None:
        check_writable(options.plot)
    for name in dataset.sequences:
        if options.source != "prosody":
            _track_file(options, name)
    begun = _begin(options, dataset)
    left = [name for name in dataset.sequences if not _new_pose(dataset, name).exists()]
    done = run_jobs(partial(_augment, options), left, options.workers)
    for _ in tqdm(
        done, "pose", len(dataset), initial=len(dataset) - len(left), unit="clip", disable=not progress
    ):
        pass
    for name in dataset.sequences:
        os.replace(_new_pose(dataset, name), dataset.directory / "sequences" / name / "pose.npy")
    path = dataset.directory / "dataset.json"
    record = json.loads(path.read_text(encoding="utf-8"))
    record["pose"] = {
        "source": options.source,
        "center": options.center,
        "gain": options.gain,
        "sigma_frames": options.sigma,
        "window_frames": options.window,
    }
    with written_whole(path) as temporary:
        temporary.write_text(json.dumps(record, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    begun.unlink()
    tracks = [PoseTrack(np.asarray(dataset.motion(name).pose), dataset.fps) for name in dataset.sequences]
    statistics = pose_statistics(tracks)
    if options.plot is not None:
        plot_statistics(statistics, options.plot)
    return statistics


def _new_pose(dataset: MeshanimDataset, name: str) -> Path:
    return dataset.directory / "sequences" / name / NEW_POSE


def _begin(options: AugmentPoseOptions, dataset: MeshanimDataset) -> Path:
    """The file that says what the new poses are; those of other options are deleted."""
    path = dataset.directory / BEGUN
    free = ("directory", "plot", "workers")
    wanted = json.dumps({key: str(value) for key, value in asdict(options).items() if key not in free})
    if not path.exists() or path.read_text(encoding="utf-8") != wanted:
        for name in dataset.sequences:
            _new_pose(dataset, name).unlink(missing_ok=True)
        with written_whole(path) as temporary:
            temporary.write_text(wanted, encoding="utf-8")
    return path


def _augment(options: AugmentPoseOptions, name: str) -> str:
    dataset = MeshanimDataset(options.directory)
    info = dataset.info(name)
    if options.source == "prosody":
        sound = dataset.audio(name)
        track = pose_from_prosody(
            info.frames,
            info.fps,
            # Each sequence its own wandering, the same in every run.
            options.seed * 1_000_003 + dataset.sequences.index(name),
            loudness(sound, PROSODY_RATE),
            pitch(sound, PROSODY_RATE),
            PROSODY_RATE,
        ).astype(np.float64)
    else:
        path = _track_file(options, name)
        found = pose_from_video(path) if options.source == "video" else load_pose_track(path, options.fps)
        try:
            track = resample_rotations(found.rotation, found.fps, info.fps, info.frames)
        except OptionError as error:
            raise FileFormatError(f"{path}: {error}") from error
    if options.center:
        track = center_rotations(track)
    if options.sigma > 0:
        track = smooth_rotations(track, options.sigma, options.window)
    with written_whole(_new_pose(dataset, name)) as temporary, open(temporary, "wb") as file:
        np.save(file, (options.gain * track).astype(np.float32))
    return name


def _track_file(options: AugmentPoseOptions, name: str) -> Path:
    """The video or track of a sequence."""
    assert options.tracks is not None
    endings = VIDEOS if options.source == "video" else TRACKS
    for ending in endings:
        path = options.tracks / f"{name}{ending}"
        if path.exists():
            return path
    kinds = ", ".join(ending or "folder" for ending in endings)
    raise FileFormatError(f"{options.tracks} has no {options.source} of {name} ({kinds})")


def plot_statistics(statistics: PoseStatistics, path: Path) -> None:
    """Draw the histogram of the modulus of rotation (GAVA, Fig. 4).

    Raises
    ------
    DependencyError
        Without matplotlib: the extra is `plots`.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise DependencyError("matplotlib", "plots") from error
    figure = Figure(figsize=(6, 3.5), layout="constrained")
    axes = figure.subplots()
    share = statistics.counts / statistics.counts.sum()
    axes.stairs(100 * share, np.degrees(statistics.edges), fill=True)
    axes.set_xlabel("head rotation, degrees")
    axes.set_ylabel("frames, %")
    degrees = np.degrees([statistics.mean, statistics.deviation, statistics.largest, statistics.speed])
    axes.set_title(
        f"mean {degrees[0]:.1f} ± {degrees[1]:.1f}°, largest {degrees[2]:.1f}°, speed {degrees[3]:.1f} °/s",
        fontsize=10,
    )
    with written_whole(path) as temporary:
        figure.savefig(temporary, format=path.suffix.removeprefix("."), dpi=150)
