"""What `meshanim evaluate gava-ablation` runs: the networks of GAVA's Table IV, alike but for their name."""

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from meshanim.audio import load_encoder
from meshanim.datasets.meshanim_format import MeshanimDataset
from meshanim.errors import FileFormatError, OptionError
from meshanim.files import written_whole
from meshanim.heads import load_head
from meshanim.models.gava import Gava
from meshanim.results import MetricValue, Results
from meshanim.training.gava import TrainGavaOptions, train_gava
from meshanim.training.gava_evaluation import held_still, measure, speaker
from meshanim.training.motion_evaluation import MotionEvaluation, masks_of_head
from meshanim.training.trainer import TrainConfig
from meshanim.training.warm_start import WarmStart

__all__ = ["ORDERINGS", "VARIANTS", "AblationOptions", "Variant", "ablation_table", "gava_ablation"]


class Variant(NamedTuple):
    """Which features a network reads, and what makes vertices of them."""

    features: Literal["LG", "L", "G"]
    decoder: Literal["gava", "sa", "mlp"]


VARIANTS = {
    f"{features}+{decoder.upper()}": Variant(features, decoder)  # type: ignore[arg-type]
    for features, decoder in (
        ("LG", "gava"),
        ("L", "gava"),
        ("LG", "sa"),
        ("L", "mlp"),
        ("LG", "mlp"),
        ("G", "gava"),
        ("G", "mlp"),
    )
}
"""Table IV, best first by the paper's E_vl on VOCASET."""

ORDERINGS = (
    ("LG+GAVA", "L+GAVA"),
    ("L+GAVA", "G+GAVA"),
    ("LG+GAVA", "G+GAVA"),
    ("L+MLP", "LG+MLP"),
    ("LG+MLP", "G+MLP"),
    ("L+MLP", "G+MLP"),
    ("LG+GAVA", "LG+SA"),
    ("LG+SA", "LG+MLP"),
    ("LG+GAVA", "LG+MLP"),
    ("L+GAVA", "L+MLP"),
    ("G+GAVA", "G+MLP"),
)
"""Pairs that differ in one thing, the one with the smaller E_vl in Table IV first: features by decoder, then
decoders by features. L+MLP is before LG+MLP there."""

SHOWN = ("lip vertex error", "eye vertex error", "FDD", "AFDD", "mean vertex error")
"""Columns of the printed table; the rows have every metric."""
ORDERED_BY = ("lip vertex error", "mean vertex error")
"""What the orderings are judged by: the first one that is measured."""


@dataclass(frozen=True)
class AblationOptions:
    """Train the seven networks of GAVA's Table IV with one budget and print the table.

    Example: meshanim evaluate gava-ablation --data corpus --output runs/ablation --json ablation.json
    """

    data: Path
    """Folder of a data set; docs/gava-ablation.md has the commands of its table."""
    output: Path = Path("runs/gava-ablation")
    """Gets a folder a network; what is finished or begun there with the same options is not done again."""
    steps: int = 4000
    """Optimiser steps of each network."""
    seeds: tuple[int, ...] = (0,)
    """Trainings of each network; the table has their mean and their spread."""
    variants: tuple[str, ...] = tuple(VARIANTS)
    """Which networks."""
    tokens: int = 400
    """Vertices that the networks work on, so that all-pairs attention can be paid; 0 for all of them."""
    width: int = 48
    """Features a token."""
    layers: int = 3
    """Attention blocks."""
    heads: int = 3
    """Attention heads."""
    rings: int = 1
    """Mesh edges that GAVA's attention crosses in one block."""
    rank: int = 96
    """Codes that modulate the vertex embeddings."""
    encoder: str = "visemes"
    """Speech encoder."""
    batch_windows: int = 4
    """Windows a batch."""
    window_frames: int = 4
    """Consecutive frames a window; 4 x 4 is the paper's batch of 16 frames."""
    learning_rate: float = 1e-3
    """Peak of a cosine schedule after 2 % of warm-up steps."""
    warm_steps: int = 0
    """Steps of a warm start from principal components; 0 for none, as in the paper."""
    split: str = "test"
    """Held-out sequences."""
    save_every: int = 250
    """Steps between checkpoints: what an interruption can cost."""
    json: Path | None = None
    """Where to write the rows."""

    def __post_init__(self):
        unknown = [name for name in self.variants if name not in VARIANTS]
        if unknown or not self.variants:
            raise OptionError(
                f"no networks {', '.join(unknown) or 'chosen'}; there are {', '.join(VARIANTS)}"
            )
        if not self.seeds or len(set(self.seeds)) < len(self.seeds):
            raise OptionError(f"seeds must be different numbers, at least one, not {self.seeds}")

    @property
    def budget(self) -> dict[str, object]:
        """What every network of a folder has in common."""
        free = ("output", "json", "seeds", "variants", "save_every", "data")
        return {name: value for name, value in asdict(self).items() if name not in free}

    def training(self, name: str, seed: int) -> TrainGavaOptions:
        """The training of one network, as `meshanim train gava` takes it.

        The pose token is left out, as in the paper's ablation (Sec. IV-C); sounds are clean, no weight is on
        the lips, so that nothing but the name of the network differs from one row to the next.
        """
        variant = VARIANTS[name]
        return TrainGavaOptions(
            data=(self.data,),
            output=self.output / f"{name}-{seed}",
            encoder=self.encoder,
            features=variant.features,
            decoder=variant.decoder,
            width=self.width,
            layers=self.layers,
            heads=self.heads,
            rings=self.rings,
            tokens=self.tokens,
            rank=self.rank,
            pose=False,
            batch_windows=self.batch_windows,
            window_frames=self.window_frames,
            variants=0,
            warm=WarmStart(steps=self.warm_steps, components=min(32, self.rank // 3)),
            train=TrainConfig(
                steps=self.steps,
                learning_rate=self.learning_rate,
                warmup=self.steps // 50,
                schedule="cosine",
                gradient_clip=1.0,
                seed=seed,
                log_every=20,
                save_every=self.save_every,
                keep=1,
            ),
            cache=self.output / "features",
        )


def gava_ablation(options: AblationOptions, progress: bool = True) -> Results:
    """Train what is missing, measure what is not measured, and give the table.

    Rows: every metric of every network on the held-out sequences and on as many training sequences (means
    over the seeds, and largest minus smallest where there are several), two baselines, parameters and minutes
    of training, and for each pair of `ORDERINGS` the difference of E_vl. Rows hold each sequence's numbers,
    so that `meshanim evaluate compare` can give intervals.

    Raises
    ------
    OptionError
        If the folder holds networks of another budget.
    FileFormatError
        If the data set or a file of an earlier run cannot be read.
    """
    dataset = MeshanimDataset(options.data)
    held_out, trained = dataset.split(options.split), dataset.split("train")
    stride = max(1, len(trained) // max(len(held_out), 1))
    sets = {options.split: held_out, "train": trained[::stride][: len(held_out)]}
    _claim(options, dataset)
    runs: dict[str, list[Results]] = {name: [] for name in options.variants}
    for seed in options.seeds:
        for name in options.variants:
            runs[name].append(_trained_and_measured(options, dataset, sets, name, seed, progress))
    results = Results("evaluate gava-ablation")
    for what, amount in _size(options, dataset).items():
        results.add("size", "data and budget", what, amount, "")
    for split, names in sets.items():
        for name, seeds in runs.items():
            columns = [[row.measured for row in run.rows if row.case == split] for run in seeds]
            for values in zip(*columns):
                found = _mean([value for value in values if value is not None])
                results.add_measured(split, name, found)
                if len(values) > 1:
                    spread = float(np.ptp([value.value for value in values if value is not None]))
                    results.add(split, name, f"{found.metric}, spread", spread, found.unit)
        for label, predict in held_still(dataset).items():
            for value in measure(
                dataset, names, predict, _evaluation(dataset), f"{split}: {label}", progress
            ):
                results.add_measured(split, label, value)
    for name, seeds in runs.items():
        for quantity, unit in (("parameters", ""), ("training time", "min")):
            mean = np.mean([run.value("training", name, quantity) for run in seeds])
            results.add("training", name, quantity, float(mean), unit)
    _add_orderings(results, runs, options.split)
    if options.json is not None:
        results.save(options.json)
    return results


def ablation_table(results: Results) -> str:
    """The results as text: the size, Table IV with its companions, training, and the pairs."""
    parts = []
    for case in dict.fromkeys(row.case for row in results.rows):
        rows = [row for row in results.rows if row.case == case]
        if any(row.measured for row in rows):
            rows = [row for row in rows if row.metric.removesuffix(", spread") in SHOWN]
        parts.append(Results(results.name, rows, results.machine).table())
    return "\n\n".join(parts)


def _size(options: AblationOptions, dataset: MeshanimDataset) -> dict[str, float]:
    splits = {"training": dataset.split("train"), "held-out": dataset.split(options.split)}
    frames = {name: sum(dataset.info(s).frames for s in split) for name, split in splits.items()}
    return {
        "training subjects": len({dataset.info(name).subject for name in splits["training"]}),
        **{f"{name} sequences": len(split) for name, split in splits.items()},
        **{f"{name} minutes": count / dataset.fps / 60 for name, count in frames.items()},
        "vertices": dataset.surface.n_vertices,
        "tokens": options.tokens or dataset.surface.n_vertices,
        "steps": options.steps,
        "frames a step": options.batch_windows * options.window_frames,
        "warm start steps": options.warm_steps,
        "seeds": len(options.seeds),
    }


def _claim(options: AblationOptions, dataset: MeshanimDataset) -> None:
    """Write what the folder's networks have in common, or check that it is the same."""
    names = [name for split in ("train", options.split) for name in dataset.split(split)]
    frames = {name: dataset.info(name).frames for name in names}
    common = {**options.budget, "data": dataset.name, "frames": frames}
    path = options.output / "ablation.json"
    if not path.exists():
        options.output.mkdir(parents=True, exist_ok=True)
        _write(path, common)
        return
    earlier = _read(path)
    other = [name for name in common if earlier.get(name) != common[name]]
    if other:
        raise OptionError(
            f"{options.output} holds networks trained with another {', '.join(other)}: "
            "use the same options, or another --output"
        )


def _write(path: Path, content: Mapping[str, object]) -> None:
    with written_whole(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n")


def _read(path: Path) -> dict:
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise FileFormatError(f"{path} is damaged ({error}): delete it to have it made again") from error


def _evaluation(dataset: MeshanimDataset) -> MotionEvaluation:
    return MotionEvaluation(masks_of_head(load_head(dataset.head) if dataset.head else None), dataset.fps)


def _trained_and_measured(
    options: AblationOptions,
    dataset: MeshanimDataset,
    sets: Mapping[str, Sequence[str]],
    name: str,
    seed: int,
    progress: bool,
) -> Results:
    training = options.training(name, seed)
    path = training.output / "measured.json"
    if path.exists():
        return Results.load(path)
    clock, folder = training.output / "seconds.json", training.output / "model"
    if not folder.exists():
        before = float(_read(clock)["seconds"]) if clock.exists() else 0.0
        training.output.mkdir(parents=True, exist_ok=True)
        begun = time.monotonic()
        try:
            train_gava(training, progress)
        finally:  # what an interrupted training took counts too
            _write(clock, {"seconds": before + time.monotonic() - begun})
    model = Gava.from_pretrained(folder)
    predict = speaker(model, load_encoder(model.config.encoder), dataset, None)
    results = Results(f"{name}, seed {seed}")
    for split, names in sets.items():
        label = f"{name}, seed {seed}: {split}"
        for value in measure(dataset, names, predict, _evaluation(dataset), label, progress):
            results.add_measured(split, name, value)
    results.add("training", name, "parameters", sum(p.numel() for p in model.parameters()), "")
    results.add("training", name, "training time", _read(clock)["seconds"] / 60, "min")
    results.save(path)
    return results


def _mean(values: Sequence[MetricValue]) -> MetricValue:
    """Of the seeds, sequence by sequence; the weights are the sequences' own."""
    per_sequence = {
        name: (float(np.mean([value.per_sequence[name][0] for value in values])), weight)
        for name, (_, weight) in values[0].per_sequence.items()
    }
    return replace(values[0], value=float(np.mean([v.value for v in values])), per_sequence=per_sequence)


def _add_orderings(results: Results, runs: Mapping[str, list[Results]], split: str) -> None:
    metric = next(name for name in ORDERED_BY if any(row.metric == name for row in results.rows))
    for better, worse in ORDERINGS:
        if better not in runs or worse not in runs:
            continue
        pairs = [
            [run.value(split, name, metric) for name, run in ((better, first), (worse, second))]
            for first, second in zip(runs[better], runs[worse])
        ]
        differences = [first - second for first, second in pairs]
        case = f"{better} - {worse}"
        results.add("order", case, f"{metric}: difference", float(np.mean(differences)), "mm")
        for what, value in (("smallest", min(differences)), ("largest", max(differences))):
            if len(differences) > 1:
                results.add("order", case, f"{metric}: {what} of the seeds", value, "mm")
