"""Measurements as rows, in one shape for every benchmark and evaluation."""

import json
import os
import platform
from dataclasses import asdict, dataclass, field
from pathlib import Path

from meshanim.files import written_whole

__all__ = ["Results", "Row", "machine"]


@dataclass(frozen=True)
class Row:
    """One number: what was measured (`case`), of what (`implementation`), which quantity, and its unit."""

    case: str
    implementation: str
    metric: str
    value: float
    unit: str


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

    def value(self, case: str, implementation: str, metric: str) -> float:
        """The number of one row; KeyError if there is none."""
        for row in self.rows:
            if (row.case, row.implementation, row.metric) == (case, implementation, metric):
                return row.value
        raise KeyError((case, implementation, metric))

    def save(self, path: str | Path) -> None:
        """Write {"name", "machine", "rows": [{"case", "implementation", "metric", "value", "unit"}, ...]}."""
        with written_whole(path) as temporary:
            temporary.write_text(json.dumps(asdict(self), indent=1, allow_nan=True) + "\n", encoding="utf-8")

    def table(self) -> str:
        """The rows as aligned text, a line a case and implementation, a column a metric."""
        metrics = list(dict.fromkeys(f"{row.metric} [{row.unit}]" for row in self.rows))
        lines: dict[tuple[str, str], dict[str, str]] = {}
        for row in self.rows:
            cells = lines.setdefault((row.case, row.implementation), {})
            cells[f"{row.metric} [{row.unit}]"] = f"{row.value:.4g}"
        table = [["case", "implementation", *metrics]]
        table += [[*name, *(values.get(metric, "") for metric in metrics)] for name, values in lines.items()]
        widths = [max(map(len, column)) for column in zip(*table)]
        return "\n".join(
            "  ".join(
                cell.ljust(width) if column < 2 else cell.rjust(width)
                for column, (cell, width) in enumerate(zip(line, widths))
            ).rstrip()
            for line in table
        )


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
