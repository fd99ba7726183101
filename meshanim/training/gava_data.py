"""The data sets of a training run, gathered by topology."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from meshanim.audio import SpeechEncoder
from meshanim.datasets.meshanim_format import MeshanimDataset
from meshanim.geometry import TriangleMesh
from meshanim.heads import load_head
from meshanim.models.gava import Topology
from meshanim.training.feature_cache import FeatureCache, cache_folder
from meshanim.training.speech_motion import Clip, load_clips

__all__ = ["TrainingSurface", "load_surfaces"]


@dataclass(frozen=True)
class TrainingSurface:
    """All training data of one topology.

    Parameters
    ----------
    topology : Topology
        Name, head and frame rate: of the first data set that has it.
    mesh : TriangleMesh
        Its reference geometry.
    clips : list of Clip
        Of all data sets with these faces.
    templates : (S, V, 3)
        Of all their subjects, metres.
    lips, eyes : int
        Vertices; empty where the head is unknown.
    posed : bool
        Whether any head turns; without it, the data says nothing of poses.
    """

    topology: Topology
    mesh: TriangleMesh
    clips: list[Clip]
    templates: Float[Tensor, "subjects vertices 3"]
    lips: Int[Tensor, " lips"]
    eyes: Int[Tensor, " eyes"]
    posed: bool


def load_surfaces(
    directories: Sequence[Path],
    encoder: SpeechEncoder,
    cache: Path | None,
    output: Path,
    variants: int,
    seed: int,
    process: tuple[int, int],
    progress: bool,
) -> tuple[list[TrainingSurface], tuple[str, ...], tuple[str, ...]]:
    """Read the training splits of data sets; give them by topology, with the names of styles and emotions.

    Parameters
    ----------
    directories : sequence of Path
        Data sets in the project's format. Those with the same faces become one topology.
    encoder : SpeechEncoder
        Of the features.
    cache : Path, optional
        Where features are kept; each data set's own `features` folder, or the one of `output`, if not given.
    output : Path
        Folder of the run.
    variants, seed : int
        Degraded variants of each sound, and the seed of the degradation.
    process : (int, int)
        Which process of how many this is; they share the making of features.
    progress : bool
        Whether to show bars.
    """
    datasets = [MeshanimDataset(directory) for directory in directories]
    folders = _distinct([directory.resolve().name for directory in directories])
    infos = [[dataset.info(name) for name in dataset.split("train")] for dataset in datasets]
    people = [sorted({info.subject for info in part}) for part in infos]
    shared = Counter(name for names in people for name in names)
    # A name that two data sets use belongs to two persons.
    styles = tuple(
        f"{folder}/{name}" if shared[name] > 1 else name
        for folder, names in zip(folders, people)
        for name in names
    )
    emotions = ("neutral", *sorted({info.emotion for part in infos for info in part} - {"neutral"}))
    surfaces: list[TrainingSurface] = []
    begun = 0
    for directory, dataset, folder, names in zip(directories, datasets, folders, people):
        place = cache or cache_folder(directory)
        if cache is None and not place.is_dir():
            place = output / "features"
        features = FeatureCache(place, encoder, seed)
        split = dataset.split("train")
        clips = load_clips(dataset, split, features, names, emotions, variants, progress, *process)
        clips = [replace(clip, style=clip.style + begun) for clip in clips]
        begun += len(names)
        templates = np.stack([subject.template for subject in dataset.subjects.values()])
        _add(surfaces, dataset, folder, clips, torch.from_numpy(templates))
    return surfaces, styles, emotions


def _add(
    surfaces: list[TrainingSurface],
    dataset: MeshanimDataset,
    folder: str,
    clips: list[Clip],
    templates: Tensor,
) -> None:
    """Join the surface with the same faces, or begin another."""
    posed = any(bool(np.any(clip.pose)) for clip in clips)
    for k, known in enumerate(surfaces):
        if known.mesh.n_vertices == dataset.surface.n_vertices and np.array_equal(
            known.mesh.faces, dataset.surface.faces
        ):
            rows = len(known.templates)
            moved = [replace(clip, subject=clip.subject + rows) for clip in clips]
            surfaces[k] = replace(
                known,
                clips=known.clips + moved,
                templates=torch.cat([known.templates, templates]),
                posed=known.posed or posed,
            )
            return
    regions = load_head(dataset.head).regions if dataset.head else {}
    lips = np.asarray(regions.get("lips", []), np.int64)
    eyes = np.union1d(regions.get("eyelids", []), regions.get("eyes", [])).astype(np.int64)
    surfaces.append(
        TrainingSurface(
            Topology(folder, dataset.head, dataset.fps),
            dataset.surface,
            clips,
            templates,
            torch.from_numpy(lips),
            torch.from_numpy(eyes),
            posed,
        )
    )


def _distinct(names: Sequence[str]) -> list[str]:
    """The names, numbered from the second of each on."""
    seen: Counter[str] = Counter()
    result = []
    for name in names:
        seen[name] += 1
        result.append(name if seen[name] == 1 else f"{name}-{seen[name]}")
    return result
