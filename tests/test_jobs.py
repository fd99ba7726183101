"""Jobs on local processes and on a Dask cluster: every result once, whatever dies."""

import itertools
import os
import signal
import time
from functools import partial

import pytest

from meshanim.errors import JobError, MeshError, OptionError
from meshanim.jobs import run_jobs


def square(number):
    return number * number


def fail_at_three(number):
    if number == 3:
        raise MeshError("mesh 3 is open: close it")
    return number


def die_once(folder, number):
    """Kills its process the first time that job 2 runs; counts what runs."""
    if number == 2 and not (folder / "died").exists():
        (folder / "died").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    (folder / f"result{number}").write_text(str(number))
    return number


def always_die(_):
    os.kill(os.getpid(), signal.SIGKILL)


def slow(folder, number):
    time.sleep(0.1)
    (folder / f"result{number}").write_text(f"{number} was here")
    return number


@pytest.fixture(scope="module")
def cluster():
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=2, processes=True, dashboard_address=None
    ) as running:
        yield running


def results(folder):
    return {path.name: path.read_text() for path in folder.glob("result*")}


@pytest.mark.parametrize("workers", [1, 2])
def test_every_result_comes_once(workers):
    assert sorted(run_jobs(square, range(7), workers)) == [n * n for n in range(7)]
    assert list(run_jobs(square, [], workers)) == []


def test_a_killed_process_loses_nothing(tmp_path):
    assert sorted(run_jobs(partial(die_once, tmp_path), range(6), 2)) == list(range(6))
    assert results(tmp_path) == {f"result{n}": str(n) for n in range(6)}
    with pytest.raises(JobError, match="2 of 2 jobs"):
        list(run_jobs(always_die, range(2), 2))


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_in_a_job_is_the_error_of_the_run(workers):
    with pytest.raises(MeshError, match="mesh 3 is open"):
        list(run_jobs(fail_at_three, range(6), workers))


def test_a_cluster_gives_the_same_and_survives_a_killed_worker(cluster, tmp_path):
    jobs = partial(slow, tmp_path)
    done = []
    for number in run_jobs(jobs, range(30), dask=cluster.scheduler_address):
        done.append(number)
        if len(done) == 4:
            victim = next(iter(cluster.workers.values()))
            os.kill(victim.pid, signal.SIGKILL)
    assert sorted(done) == list(range(30))
    assert results(tmp_path) == {f"result{n}": f"{n} was here" for n in range(30)}
    with pytest.raises(MeshError, match="mesh 3 is open"):
        list(run_jobs(fail_at_three, range(6), dask=cluster.scheduler_address))


def test_one_job_at_a_time_in_a_process(cluster):
    """Two threads a worker: the voices' global state allows one."""
    spans = list(run_jobs(_span, range(8), dask=cluster.scheduler_address))
    for pid in {span[0] for span in spans}:
        own = sorted(span[1:] for span in spans if span[0] == pid)
        assert all(before[1] <= after[0] for before, after in itertools.pairwise(own))


def _span(_):
    start = time.monotonic()
    time.sleep(0.05)
    return os.getpid(), start, time.monotonic()


def test_no_scheduler_is_one_line(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("meshanim.jobs.PATIENCE", 0.5)
    with pytest.raises(OptionError, match="no Dask scheduler answers at tcp://127"):
        list(run_jobs(square, range(3), dask="tcp://127.0.0.1:9"))
