"""Two processes train as one with the double batch, and an interrupted run of two goes on where it was."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from corpus_small import write_small_corpus
from safetensors.torch import load_file
from test_batches import scalars_of

from meshanim.errors import OptionError
from meshanim.training import gava
from meshanim.training.trainer import TrainConfig
from meshanim.training.warm_start import WarmStart

STEPS = 10


def train(corpus, output, batch, share):
    """A run with an eye region on the sphere; `share` of the batch that two processes make up."""
    original = gava._task

    def with_eyes(*arguments):
        task = original(*arguments)
        task.eyes = torch.arange(30)
        return task

    gava._task = with_eyes
    try:
        gava.train_gava(
            gava.TrainGavaOptions(
                data=(Path(corpus),),
                output=Path(output),
                encoder="mel",
                width=16,
                heads=2,
                rank=12,
                variants=1,
                tokens=80,
                cpu=True,
                batch=batch,
                batch_windows=6 // share,
                batch_sequences=2 // share,
                warm=WarmStart(steps=4, batch_windows=8 // share, components=3, field_steps=6),
                train=TrainConfig(steps=STEPS, learning_rate=1e-3, log_every=1, save_every=5),
            ),
            progress=False,
        )
    finally:
        gava._task = original


def two_processes(corpus, output):
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    done = subprocess.run(
        [*command, __file__, str(corpus), str(output)],
        env=environment,
        capture_output=True,
        timeout=500,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-3000:]


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    corpus = write_small_corpus(folder / "sphere")
    two_processes(corpus, folder / "two")
    return corpus, folder / "two"


def result(run):
    return load_file(run / "model" / "model.safetensors")


@pytest.mark.parametrize("batch", ["windows", "sequences"])
def test_two_processes_train_as_one_with_the_double_batch(runs, tmp_path, batch):
    corpus, two = runs
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    train(corpus, tmp_path / "one", batch, 1)
    torch.set_num_threads(threads)
    curves = [scalars_of(run / "tensorboard")["loss"] for run in (two / batch, tmp_path / "one")]
    assert [step for step, _ in curves[0]] == list(range(1, STEPS + 1))
    for (_, a), (_, b) in zip(*curves):
        assert a == pytest.approx(b, rel=2e-3)
    found, expected = result(two / batch), result(tmp_path / "one")
    for name, value in expected.items():
        # Ten steps of Adam move a weight by up to 1e-2. Where a gradient is nothing but rounding, sums in
        # another order move it otherwise: by 1.2e-4 in the worst of all.
        torch.testing.assert_close(found[name], value, rtol=1e-3, atol=5e-4)


def test_an_interrupted_run_of_two_goes_on_where_it_was(runs, tmp_path):
    corpus, two = runs
    cut = shutil.copytree(two, tmp_path / "cut")
    for batch in ("windows", "sequences"):
        shutil.rmtree(cut / batch / "checkpoints" / f"{STEPS:07d}")
        shutil.rmtree(cut / batch / "model")
    shutil.rmtree(cut / "sequences" / "checkpoints")  # interrupted right after its warm start
    two_processes(corpus, cut)
    for batch in ("windows", "sequences"):
        whole, again = result(two / batch), result(cut / batch)
        assert all(torch.equal(whole[name], again[name]) for name in whole)
    with pytest.raises(OptionError, match="number of processes"):
        train(corpus, cut / "windows", "windows", 2)


if __name__ == "__main__":
    for kind in ("windows", "sequences"):
        train(sys.argv[1], Path(sys.argv[2]) / kind, kind, 2)
