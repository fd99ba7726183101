"""Results side by side: differences of metrics with paired bootstrap confidence intervals over sequences."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from jaxtyping import Float
from scipy.stats import bootstrap

from meshanim.errors import OptionError
from meshanim.results import MetricValue, Results, aligned, same_measure

__all__ = [
    "CompareOptions",
    "Difference",
    "compare",
    "comparison_results",
    "comparison_table",
    "paired_bootstrap",
]

Values = Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class CompareOptions:
    """Put what other evaluations wrote side by side, with confidence intervals of the differences.

    Example: meshanim evaluate compare ours.json theirs.json --metrics "lip vertex error" FDD
    """

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Files that meshanim evaluate wrote with --json."""
    reference: str = ""
    """The implementation that all others are compared with; the first one of the first file if not given."""
    metrics: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAMES")] = ()
    """Which metrics; all if not given."""
    level: float = 0.95
    """Of the intervals."""
    resamples: int = 10_000
    """Bootstrap resamples of the sequences."""
    seed: int = 0
    """Of the resampling."""
    json: Path | None = None
    """Where to write the rows."""

    def __post_init__(self):
        if not self.runs:
            raise OptionError("no results given; meshanim evaluate gava --json RUN.json writes some")
        if not 0 < self.level < 1 or self.resamples < 100:
            raise OptionError(
                f"level must lie between 0 and 1 and resamples be at least 100,"
                f" not {self.level} and {self.resamples}"
            )


@dataclass(frozen=True)
class Difference:
    """One metric of an implementation beside that of the reference.

    Parameters
    ----------
    case : str
        Such as the split.
    implementation : str
        Which.
    measured : MetricValue
        Of the implementation, over all its sequences.
    difference : float
        Less the reference's, over the common sequences.
    interval : (low, high), optional
        Of the difference; None where the metric has no number of each sequence, or there is one sequence.
    common : int
        Sequences that both have.
    is_reference : bool
        Whether it is the reference itself: no difference, no interval.
    """

    case: str
    implementation: str
    measured: MetricValue
    difference: float
    interval: tuple[float, float] | None
    common: int
    is_reference: bool = False

    @property
    def excludes_zero(self) -> bool:
        """Whether the whole interval lies on one side of zero."""
        return self.interval is not None and (self.interval[0] > 0 or self.interval[1] < 0)


def paired_bootstrap(
    first: Float[np.ndarray, "sequences 2"],
    second: Float[np.ndarray, "other_sequences 2"],
    level: float = 0.95,
    resamples: int = 10_000,
    seed: int = 0,
) -> tuple[float, tuple[float, float]]:
    """Difference of two weighted means over the same sequences and its percentile interval.

    Sequences are drawn with replacement, both numbers of a sequence together, so that what makes a sequence
    hard for everybody cancels (Efron and Tibshirani 1993, Ch. 13; scipy.stats.bootstrap).

    Parameters
    ----------
    first, second : (S, 2)
        Value and weight of each sequence, in the same order; S of at least 2.
    level : float
        Of the interval.
    resamples : int
        How often.
    seed : int
        Of the draws; the same seed gives the same interval.

    Returns
    -------
    difference : float
        Second less first.
    interval : (float, float)
        Low and high.

    Raises
    ------
    OptionError
        If there are fewer than two sequences or the arrays differ in length.
    """
    if len(first) != len(second) or len(first) < 2:
        raise OptionError(f"{len(first)} and {len(second)} sequences: the same ones, at least 2, are needed")

    def difference(*columns: np.ndarray, axis: int = -1):
        value_a, weight_a, value_b, weight_b = columns
        means = [
            (value * weight).sum(axis) / weight.sum(axis)
            for value, weight in ((value_a, weight_a), (value_b, weight_b))
        ]
        return means[1] - means[0]

    columns = (*first.T, *second.T)
    found = bootstrap(
        columns,
        difference,
        paired=True,
        vectorized=True,
        n_resamples=resamples,
        batch=max(1, 2_000_000 // len(first)),
        confidence_level=level,
        method="percentile",
        random_state=np.random.default_rng(seed),
    )
    low, high = found.confidence_interval
    return float(difference(*columns)), (float(low), float(high))


def compare(options: CompareOptions) -> list[Difference]:
    """Each metric of each implementation beside the reference's, in the order of the files.

    Raises
    ------
    FileFormatError
        If a file holds no results.
    OptionError
        If there is nothing to compare, names are unknown, or runs differ in unit, mask or formula.
    """
    table = _merged(options.runs)
    names = list(dict.fromkeys(name for cells in table.values() for name in cells))
    reference = options.reference or names[0]
    if reference not in names:
        raise OptionError(f"no implementation {reference!r}; there are {', '.join(names)}")
    known = list(dict.fromkeys(metric for _, metric in table))
    unknown = [metric for metric in options.metrics if metric not in known]
    if unknown:
        raise OptionError(f"no metric {', '.join(unknown)}; there are {', '.join(known)}")
    found = []
    for (case, metric), cells in table.items():
        if reference not in cells or len(cells) < 2 or (options.metrics and metric not in options.metrics):
            continue
        base = cells[reference]
        found.append(Difference(case, reference, base, 0.0, None, base.sequences, True))
        for name, measured in cells.items():
            if name != reference:
                found.append(_difference(case, name, base, measured, options))
    if not found:
        cases = {
            name: sorted({case for (case, _), cells in table.items() if name in cells}) for name in names
        }
        told = "; ".join(f"{name} on {', '.join(where)}" for name, where in cases.items())
        raise OptionError(f"nothing is measured as {reference} is: {told}")
    return found


def _difference(
    case: str, name: str, base: MetricValue, measured: MetricValue, options: CompareOptions
) -> Difference:
    same_measure(base, measured)
    if not (base.per_sequence and measured.per_sequence):
        return Difference(case, name, measured, measured.value - base.value, None, 0)
    common = [sequence for sequence in base.per_sequence if sequence in measured.per_sequence]
    if not common:
        raise OptionError(f"{case}: {name} and the reference have no sequence in common")
    first, second = (np.array([values.per_sequence[s] for s in common]) for values in (base, measured))
    if len(common) == 1:
        return Difference(case, name, measured, float(second[0, 0] - first[0, 0]), None, 1)
    difference, interval = paired_bootstrap(first, second, options.level, options.resamples, options.seed)
    return Difference(case, name, measured, difference, interval, len(common))


def _merged(paths: Sequence[Path]) -> dict[tuple[str, str], dict[str, MetricValue]]:
    """Measured rows of all files by case and metric, then by implementation.

    What two files measure alike, such as a baseline, is there once; what differs but has one name is told
    apart by the file.
    """
    runs = [(path, Results.load(path)) for path in paths]
    seen: dict[str, list[tuple[Path, dict[tuple[str, str], MetricValue]]]] = {}
    for path, results in runs:
        for row in results.rows:
            if row.measured is None:
                continue
            entries = seen.setdefault(row.implementation, [])
            if not entries or entries[-1][0] != path:
                entries.append((path, {}))
            entries[-1][1][row.case, row.metric] = row.measured
    if not seen:
        raise OptionError(f"{', '.join(map(str, paths))}: no metrics in there; meshanim evaluate writes them")
    table: dict[tuple[str, str], dict[str, MetricValue]] = {}
    for name, entries in seen.items():
        different = [entry for k, entry in enumerate(entries) if all(entry[1] != e[1] for e in entries[:k])]
        labels = [f"{path.stem}: {name}" for path, _ in different] if len(different) > 1 else [name]
        if len(set(labels)) < len(labels):
            labels = [f"{path}: {name}" for path, _ in different]
        for label, (_, values) in zip(labels, different):
            for key, measured in values.items():
                table.setdefault(key, {})[label] = measured
    return table


def comparison_table(differences: Sequence[Difference], level: float = 0.95) -> str:
    """Aligned text: value, difference from the reference, interval, and whether it excludes zero."""
    head = ["case", "metric", "unit", "implementation", "value", "difference", f"{level:.0%} interval"]
    table = [[*head, "excludes zero", "sequences"]]
    for entry in differences:
        measured = entry.measured
        line = [entry.case, measured.metric, measured.unit, entry.implementation, f"{measured.value:.4g}"]
        if entry.interval is not None:
            low, high = entry.interval
            verdict = "yes" if entry.excludes_zero else "no"
            line += [f"{entry.difference:+.4g}", f"[{low:+.4g}, {high:+.4g}]", verdict]
        elif entry.is_reference:
            line += ["", "reference", ""]
        else:
            line += [f"{entry.difference:+.4g}", "none", ""]
        table.append([*line, str(entry.common or measured.sequences)])
    return aligned(table, 4)


def comparison_results(differences: Sequence[Difference]) -> Results:
    """The same as rows: the value, its difference, and the interval's ends."""
    results = Results("evaluate compare")
    for entry in differences:
        measured = entry.measured
        results.add(entry.case, entry.implementation, measured.metric, measured.value, measured.unit)
        parts = {} if entry.is_reference else {"difference": entry.difference}
        if entry.interval is not None:
            parts |= {"low": entry.interval[0], "high": entry.interval[1]}
            parts |= {"sequences": float(entry.common)}
        for part, value in parts.items():
            unit = "sequences" if part == "sequences" else measured.unit
            results.add(entry.case, entry.implementation, f"{measured.metric}: {part}", value, unit)
    return results
