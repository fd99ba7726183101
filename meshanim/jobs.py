"""The same jobs on the processes of this machine or on the machines of a Dask cluster.

A job is a function of one argument that writes its own result whole and gives back a short one, such as a
name. It may run again after its worker was lost, so it does nothing where its result is already there.
"""

import importlib
import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import TypeVar

from meshanim import __version__
from meshanim.errors import DependencyError, JobError, OptionError

__all__ = ["run_jobs"]

Argument = TypeVar("Argument")
Result = TypeVar("Result")

LOSSES = 3
"""Times that workers may be lost before a run gives up; Dask's own number for one job."""
PATIENCE = 30.0
"""Seconds to wait for a scheduler and for its first worker."""
_TURN = threading.Lock()


def run_jobs(
    function: Callable[[Argument], Result], arguments: Sequence[Argument], workers: int = 0, dask: str = ""
) -> Iterator[Result]:
    """Call a function with each argument; results come as they are finished, in any order.

    The jobs of a worker that is killed run again on the others. An error in a job ends the run: jobs that
    have not begun are dropped.

    Parameters
    ----------
    function : callable
        Of a module that workers can import, here and on every machine of the cluster.
    arguments : sequence
        One a job; pickled, so files are named by absolute paths.
    workers : int
        Local processes; 0 takes one a core, 1 this process.
    dask : str
        Address of a Dask scheduler (tcp://HOST:8786); its workers see the same files. Local if empty.

    Raises
    ------
    MeshanimError
        What a job raised.
    JobError
        If workers are lost again and again: killed, out of memory, crashed.
    OptionError
        If there is no scheduler at the address, or its workers do not fit.
    DependencyError
        Without dask.distributed: the extra is `cluster`.
    """
    if dask:
        yield from _on_cluster(function, arguments, dask)
        return
    workers = min(workers or os.cpu_count() or 1, len(arguments))
    if workers <= 1:
        yield from map(function, arguments)
        return
    yield from _on_processes(function, arguments, workers)


def _on_processes(
    function: Callable[[Argument], Result], arguments: Sequence[Argument], workers: int
) -> Iterator[Result]:
    left = dict(enumerate(arguments))
    for _ in range(LOSSES + 1):
        pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"))
        try:
            numbers = {pool.submit(function, argument): number for number, argument in left.items()}
            waiting = set(numbers)
            while waiting:
                finished, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                for future in finished:
                    result = future.result()
                    del left[numbers[future]]
                    yield result
            return
        except BrokenProcessPool:
            continue
        finally:
            pool.shutdown(cancel_futures=True)
    raise JobError(
        f"worker processes were killed {LOSSES + 1} times, {len(left)} of {len(arguments)} jobs are left: is "
        "memory short? What is finished is kept; run again with fewer workers"
    )


def _on_cluster(
    function: Callable[[Argument], Result], arguments: Sequence[Argument], address: str
) -> Iterator[Result]:
    try:
        distributed = importlib.import_module("distributed")
    except ImportError as error:
        raise DependencyError("dask.distributed", "cluster") from error
    try:
        client = distributed.Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise OptionError(f"no Dask scheduler answers at {address}: {error}") from error
    try:
        _check_workers(client, address)
        futures = client.map(_in_turn, [(function, argument) for argument in arguments], pure=False)
        try:
            for future in distributed.as_completed(futures, loop=client.loop):
                yield future.result()
        except distributed.KilledWorker as error:
            raise JobError(
                f"a job killed {error.allowed_failures + 1} workers of {address}: is their memory short?"
            ) from error
        finally:
            client.cancel(futures)
    finally:
        client.close()


def _check_workers(client, address: str) -> None:
    try:
        client.wait_for_workers(1, timeout=PATIENCE)
    except TimeoutError as error:
        raise OptionError(f"the Dask scheduler at {address} has no workers: start `dask worker`") from error
    try:
        versions = client.run(_version)
    except ImportError as error:
        raise OptionError(f"the Dask workers at {address} cannot import meshanim") from error
    for worker, version in versions.items():
        if version != __version__:
            raise OptionError(f"Dask worker {worker} has meshanim {version}, here it is {__version__}")


def _version() -> str:
    return __version__


def _in_turn(job: tuple[Callable[[Argument], Result], Argument]) -> Result:
    """One job at a time in a process, however many threads its worker has: voices keep global state."""
    function, argument = job
    with _TURN:
        return function(argument)
