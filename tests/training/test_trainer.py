import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch import nn

from meshanim.errors import FileFormatError, OptionError
from meshanim.training.trainer import TrainConfig, Trainer, learning_rate_factor

QUICK = {"log_every": 1000, "save_every": 1000, "learning_rate": 1e-2}


class Regression:
    """Noise of the process's own generator in every step, so that a resumed run needs it back."""

    def batch(self, number, share=0, shares=1):
        generator = torch.Generator().manual_seed(number * shares + share)
        x = torch.randn(8, 4, generator=generator)
        return {"x": x, "y": x.sum(1, keepdim=True), "name": "kept as it is"}

    def loss(self, model, batch):
        error = model(batch["x"]) - batch["y"]
        noise = 1 + 0.1 * torch.rand(())
        return noise * error.square().mean(), {"error": error.abs().mean()}

    def save(self, model, directory):
        torch.save(model.state_dict(), directory / "weights.pt")


def network():
    torch.manual_seed(3)
    return nn.Sequential(nn.Linear(4, 8), nn.GELU(), nn.Dropout(0.2), nn.Linear(8, 1))


def parameters(model):
    return torch.cat([p.detach().flatten() for p in model.parameters()])


@pytest.mark.parametrize("options", [{}, {"accumulation": 2, "ema": 0.9, "schedule": "cosine", "warmup": 3}])
def test_an_interrupted_run_equals_an_uninterrupted_one(tmp_path, options):
    config = TrainConfig(steps=12, **QUICK, **options)
    whole = Trainer(network(), Regression(), config, tmp_path / "whole", cpu=True)
    expected = parameters(whole.run(progress=False))

    first = Trainer(network(), Regression(), config, tmp_path / "cut", cpu=True)
    first.run(until=7, progress=False)
    torch.manual_seed(999)  # another process knows nothing of the first
    torch.rand(5)
    second = Trainer(network(), Regression(), config, tmp_path / "cut", cpu=True)
    assert second.resume()
    assert second.step == 7
    assert torch.equal(parameters(second.run(progress=False)), expected)
    for name in whole.average:
        assert torch.equal(whole.average[name], second.average[name])
    results = [
        torch.load(tmp_path / run / "model" / "weights.pt", weights_only=True) for run in ("whole", "cut")
    ]
    assert all(torch.equal(results[0][name], results[1][name]) for name in results[0])


def test_training_learns_and_leaves_its_files(tmp_path):
    config = TrainConfig(steps=300, log_every=50, save_every=100, keep=2, learning_rate=1e-2)
    trainer = Trainer(nn.Linear(4, 1), Regression(), config, tmp_path, cpu=True)
    model = trainer.run(progress=False)
    assert (model.weight - 1).abs().max() < 0.05
    assert sorted(p.name for p in (tmp_path / "checkpoints").iterdir()) == ["0000200", "0000300"]
    assert any((tmp_path / "tensorboard").iterdir())
    assert (tmp_path / "model" / "weights.pt").is_file()
    saved = json.loads((tmp_path / "checkpoints" / "0000300" / "trainer.json").read_text())
    assert saved["step"] == 300


def test_the_result_holds_the_averaged_weights(tmp_path):
    config = TrainConfig(steps=5, ema=0.99, **QUICK)
    trainer = Trainer(nn.Linear(4, 1), Regression(), config, tmp_path, cpu=True)
    model = trainer.run(progress=False)
    saved = torch.load(tmp_path / "model" / "weights.pt", weights_only=True)
    assert torch.equal(saved["weight"], trainer.average["weight"])
    assert not torch.equal(saved["weight"], model.weight)


def test_resume_refuses_what_does_not_fit(tmp_path):
    config = TrainConfig(steps=2, **QUICK)
    assert not Trainer(network(), Regression(), config, tmp_path, cpu=True).resume()
    Trainer(network(), Regression(), config, tmp_path, cpu=True).run(progress=False)
    other = TrainConfig(steps=2, **(QUICK | {"learning_rate": 1e-3}))
    with pytest.raises(OptionError, match="learning_rate"):
        Trainer(network(), Regression(), other, tmp_path, cpu=True).resume()
    (tmp_path / "checkpoints" / "0000002" / "trainer.safetensors").write_bytes(b"no")
    with pytest.raises(FileFormatError, match="0000002"):
        Trainer(network(), Regression(), config, tmp_path, cpu=True).resume()


def test_a_loss_that_is_not_finite_stops_the_run(tmp_path):
    class Broken(Regression):
        def loss(self, model, batch):
            loss, terms = super().loss(model, batch)
            return loss * torch.nan, terms

    config = TrainConfig(steps=2, log_every=1, save_every=1000)
    with pytest.raises(FloatingPointError, match="step 1"):
        Trainer(network(), Broken(), config, tmp_path, cpu=True).run(progress=False)


def test_schedules():
    config = TrainConfig(steps=100, warmup=10, schedule="cosine")
    factors = [learning_rate_factor(config, step) for step in range(101)]
    assert factors[0] == pytest.approx(0.1)
    assert factors[10] == pytest.approx(1)
    assert factors[55] == pytest.approx(0.5)
    assert factors[100] == pytest.approx(0, abs=1e-12)
    assert learning_rate_factor(TrainConfig(), 60_000) == 1
    ends = TrainConfig(steps=100, warmup=10, schedule="cosine", floor=0.2)
    assert [learning_rate_factor(ends, step) for step in (10, 55, 100)] == pytest.approx([1, 0.6, 0.2])
    steps = TrainConfig(schedule="steps", decay=0.994, decay_steps=30)
    found = [learning_rate_factor(steps, step) for step in (0, 29, 30, 1500)]
    assert found == pytest.approx([1, 1, 0.994, 0.994**50])
    for options in ({"steps": 0}, {"learning_rate": 0.0}, {"ema": 1.0}, {"decay": 0.0}, {"floor": -1.0}):
        with pytest.raises(OptionError):
            TrainConfig(**options)


SCRIPT = """
import sys
import torch
sys.path.insert(0, sys.argv[2])
from test_trainer import Plain, linear
from meshanim.training.trainer import TrainConfig, Trainer
config = TrainConfig(steps=3, learning_rate=1e-2, accumulation=int(sys.argv[3]), log_every=1000)
Trainer(linear(), Plain(), config, sys.argv[1], cpu=True).run(progress=False)
"""


class Plain(Regression):
    def loss(self, model, batch):
        error = model(batch["x"]) - batch["y"]
        return error.square().mean(), {}


def linear():
    torch.manual_seed(3)
    return nn.Linear(4, 1)


def test_two_processes_equal_one_that_accumulates(tmp_path):
    script = tmp_path / "run.py"
    script.write_text(SCRIPT)
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "MASTER_PORT": "29713"}
    command = [
        sys.executable,
        "-m",
        "torch.distributed.run",
        "--nproc-per-node",
        "2",
        "--master-port",
        "29713",
    ]
    command += [str(script), str(tmp_path / "two"), str(Path(__file__).parent), "1"]
    subprocess.run(command, check=True, env=environment, capture_output=True, timeout=300)
    config = TrainConfig(steps=3, learning_rate=1e-2, accumulation=2, log_every=1000)
    one = Trainer(linear(), Plain(), config, tmp_path / "one", cpu=True).run(progress=False)
    two = torch.load(tmp_path / "two" / "model" / "weights.pt", weights_only=True)
    torch.testing.assert_close(two["weight"], one.weight.detach(), rtol=1e-5, atol=1e-7)
