"""`meshanim bench`: measurements that anyone can repeat."""

from importlib.resources import as_file, files
from pathlib import Path

from meshanim.animation_benchmark import AnimationBenchmark
from meshanim.attention.benchmark import BenchmarkOptions
from meshanim.cli.demo import CLIP
from meshanim.gaussians.binding_benchmark import BindingBenchmark
from meshanim.gaussians.loss_benchmark import LossBenchmark
from meshanim.gaussians.splat.benchmark import SplatBenchmark
from meshanim.realtime_benchmark import RealtimeBenchmark
from meshanim.results import Results
from meshanim.solve_benchmark import SolveBenchmark

__all__ = ["COMMANDS"]


def _attention(options: BenchmarkOptions) -> None:
    from meshanim.attention import benchmark

    _report(benchmark.run(options), options.json)


def _animate(options: AnimationBenchmark) -> None:
    from meshanim import animation_benchmark
    from meshanim.render import benchmark

    with as_file(files("meshanim").joinpath(CLIP)) as clip:
        results = animation_benchmark.run(options, clip)
    results.rows.extend(benchmark.run(options.frames, options.size).rows)
    _report(results, options.json)


def _binding(options: BindingBenchmark) -> None:
    from meshanim.gaussians import binding_benchmark

    _report(binding_benchmark.run(options), options.json)


def _image_loss(options: LossBenchmark) -> None:
    from meshanim.gaussians import loss_benchmark

    _report(loss_benchmark.run(options), options.json)


def _realtime(options: RealtimeBenchmark) -> None:
    from meshanim import realtime_benchmark

    with as_file(files("meshanim").joinpath(CLIP)) as clip:
        _report(realtime_benchmark.run(options, clip), options.json)


def _solve(options: SolveBenchmark) -> None:
    from meshanim import solve_benchmark

    with as_file(files("meshanim").joinpath(CLIP)) as clip:
        _report(solve_benchmark.run(options, clip), options.json)


def _splat(options: SplatBenchmark) -> None:
    from meshanim.gaussians.splat import benchmark

    _report(benchmark.run(options), options.json)


def _report(results: Results, path: Path | None) -> None:
    print(results.table())
    print(", ".join(f"{key} {value}" for key, value in results.machine.items()))
    if path is not None:
        results.save(path)


COMMANDS = {
    "attention": _attention,
    "animate": _animate,
    "binding": _binding,
    "image-loss": _image_loss,
    "realtime": _realtime,
    "solve": _solve,
    "splat": _splat,
}
