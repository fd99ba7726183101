"""Measurements as rows, in one shape for every benchmark and evaluation."""

import json
import os
import platform
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path

from meshanim.errors import FileFormatError, OptionError
from meshanim.files import written_whole

__all__ = ["MetricValue", "Results", "Row", "aligned", "machine", "same_measure"]


@dataclass(frozen=True)
class MetricValue:
    """A metric's value and everything that decides what it may be compared with.

    Parameters
    ----------
    metric : str
        Name.
    value : float
        In `unit`.
    unit : str
        mm, m^2, biwi, share, deg, ...
    mask : str
        Name of the vertices that count; "all", or "none" for what is not of vertices.
    vertices : int
        How many those are.
    digest : str
        Fingerprint of which those are; empty for all.
    formula : str
        What was computed, in a line.
    pooled : str
        What a unit of weight is: frames, sequences, bilabials.
    frames, sequences : int
        How many were measured.
    per_sequence : mapping of str to (value, weight)
        By sequence; their weighted mean is `value`. Empty where a metric has none.
    """

    metric: str
    value: float
    unit: str
    mask: str
    vertices: int
    digest: str
    formula: str
    pooled: str
    frames: int
    sequences: int
    per_sequence: Mapping[str, tuple[float, float]] = field(default_factory=dict)


def same_measure(first: MetricValue, second: MetricValue) -> None:
    """Refuse to put two numbers of one name side by side that do not measure the same.

    Raises
    ------
    OptionError
        If their units, masks or formulas differ.
    """
    for what, one, other in (
        ("unit", first.unit, second.unit),
        ("mask", _mask(first), _mask(second)),
        ("formula", f"{first.formula} over {first.pooled}", f"{second.formula} over {second.pooled}"),
    ):
        if one != other:
            raise OptionError(
                f"{first.metric} cannot be compared: {what} {one} here, {other} there; measure both alike"
            )


def _mask(value: MetricValue) -> str:
    return f"{value.mask} ({value.vertices} vertices{', ' * bool(value.digest)}{value.digest})"


@dataclass(frozen=True)
class Row:
    """One number: what was measured (`case`), of what (`implementation`), which quantity, and its unit.

    `measured` says how, for the metrics of an evaluation; timings and the like have none.
    """

    case: str
    implementation: str
    metric: str
    value: float
    unit: str
    measured: MetricValue | None = None

    def record(self) -> dict[str, object]:
        """As JSON has it: what is known about a metric beside the five fields of every row."""
        known = {} if self.measured is None else asdict(self.measured)
        plain = {name: getattr(self, name) for name in ("case", "implementation", "metric", "value", "unit")}
        return plain | {name: value for name, value in known.items() if name not in plain}


@dataclass
class Results:
    """A named list of rows and the machine they were measured on.

    Parameters
    ----------
    name : str
        The benchmark or evaluation.
    rows : list of Row
        In the order of measurement; ratios are rows of their own, unit "x".
    machine : dict
        `machine()` of the process that measured.
    """

    name: str
    rows: list[Row] = field(default_factory=list)
    machine: dict[str, str | int | bool] = field(default_factory=lambda: machine())

    def add(self, case: str, implementation: str, metric: str, value: float | int, unit: str) -> None:
        """Append one row."""
        self.rows.append(Row(case, implementation, metric, float(value), unit))

    def add_measured(self, case: str, implementation: str, measured: MetricValue) -> None:
        """Append one metric, refused if the same metric of another row has another unit, mask or formula."""
        for row in self.rows:
            if row.metric == measured.metric and row.measured is not None:
                same_measure(row.measured, measured)
        self.rows.append(Row(case, implementation, measured.metric, measured.value, measured.unit, measured))

    def value(self, case: str, implementation: str, metric: str) -> float:
        """The number of one row; KeyError if there is none."""
        for row in self.rows:
            if (row.case, row.implementation, row.metric) == (case, implementation, metric):
                return row.value
        raise KeyError((case, implementation, metric))

    def save(self, path: str | Path) -> None:
        """Write {"name", "machine", "rows": [{"case", "implementation", "metric", "value", "unit"}, ...]}.

        Rows of `add_measured` have the other fields of `MetricValue` too.
        """
        record = {"name": self.name, "rows": [row.record() for row in self.rows], "machine": self.machine}
        with written_whole(path) as temporary:
            temporary.write_text(json.dumps(record, indent=1, allow_nan=True) + "\n", encoding="utf-8")

    @classmethod
    def load(cls, path: str | Path) -> "Results":
        """Read what `save` wrote.

        Raises
        ------
        FileFormatError
            If the file is missing or is something else.
        """
        try:
            record = json.loads(Path(path).read_text(encoding="utf-8"))
            rows = [_row(entry) for entry in record["rows"]]
            return cls(str(record["name"]), rows, dict(record["machine"]))
        except OSError as error:
            raise FileFormatError(f"cannot read {path}: {error.strerror or error}") from error
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise FileFormatError(f"{path} holds no results of meshanim: {error!r}") from error

    def metrics_table(self) -> str:
        """The measured rows as aligned text: a line a case and metric, a column an implementation.

        Unit and mask stand beside each metric, its formula and counts below the table.
        """
        rows = [(row, row.measured) for row in self.rows if row.measured is not None]
        names = list(dict.fromkeys(row.implementation for row, _ in rows))
        lines: dict[tuple[str, ...], dict[str, str]] = {}
        for row, measured in rows:
            mask = f"{measured.mask} ({measured.vertices})" if measured.vertices else measured.mask
            cells = lines.setdefault((row.case, row.metric, row.unit, mask), {})
            cells[row.implementation] = f"{row.value:.4g}"
        table = [["case", "metric", "unit", "mask (vertices)", *names]]
        table += [[*key, *(cells.get(name, "") for name in names)] for key, cells in lines.items()]
        formulas = {row.metric: f"{row.metric}: {m.formula}, over {m.pooled}" for row, m in rows}
        counts: dict[str, str] = {}
        for row, m in rows:
            counts.setdefault(row.case, f"{row.case}: {m.sequences} sequences, {m.frames} frames")
        return "\n".join([aligned(table, 4), "", *formulas.values(), "", *counts.values()])

    def table(self) -> str:
        """The rows as aligned text, a line a case and implementation, a column a metric."""
        metrics = list(dict.fromkeys(f"{row.metric} [{row.unit}]" for row in self.rows))
        lines: dict[tuple[str, str], dict[str, str]] = {}
        for row in self.rows:
            cells = lines.setdefault((row.case, row.implementation), {})
            cells[f"{row.metric} [{row.unit}]"] = f"{row.value:.4g}"
        table = [["case", "implementation", *metrics]]
        table += [[*name, *(values.get(metric, "") for metric in metrics)] for name, values in lines.items()]
        return aligned(table, 2)


def aligned(table: list[list[str]], left: int) -> str:
    """Columns of text, the first `left` of them flush left, the others flush right."""
    widths = [max(map(len, column)) for column in zip(*table)]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if column < left else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(line, widths))
        ).rstrip()
        for line in table
    )


def _row(entry: dict) -> Row:
    plain = Row(*(entry[name] for name in ("case", "implementation", "metric", "value", "unit")))
    if "mask" not in entry:
        return plain
    known = {part.name: entry[part.name] for part in fields(MetricValue)}
    known["per_sequence"] = {name: (float(v), float(w)) for name, (v, w) in known["per_sequence"].items()}
    return replace(plain, measured=MetricValue(**known))


def machine() -> dict[str, str | int | bool]:
    """Processor, cores, threads, GPU and versions of this process."""
    import torch

    from meshanim import __version__

    try:
        from meshanim import _native

        native = _native.instruction_set()
    except ImportError:
        native = "not built"
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else "none"
    return {
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1,
        "threads": torch.get_num_threads(),
        "gpu": gpu,
        "native": native,
        "platform": platform.platform(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "meshanim": __version__,
    }


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
