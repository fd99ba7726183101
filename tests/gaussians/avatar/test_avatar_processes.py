"""Two processes draw different pictures and keep one avatar between them, through refinements too."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from made_capture import write_capture
from safetensors.torch import load_file

from meshanim.gaussians.avatar import fit
from meshanim.gaussians.avatar.tracking import Tracking
from meshanim.training.trainer import TrainConfig

STEPS = 12


def train(capture: Path, output: Path) -> fit.AvatarTrainer:
    """A run with refinements at steps 4, 6 and 8 of twelve."""
    opened = fit.open_capture(capture)
    settings = fit.preset("small", 20, STEPS)
    settings = replace(
        settings, density=replace(settings.density, start=1 / 3, stop=0.7, every=1 / 6, limit=100)
    )
    torch.manual_seed(0)
    config = fit.AvatarConfig(head=opened.head_name, background=opened.background)
    avatar = fit.Avatar(config, opened.head, scale=settings.scale, opacity=settings.opacity)
    learner = fit.AvatarLearner(avatar, Tracking(opened.parameters, 4), refine_tracking=True)
    task = fit.AvatarTask(fit.PictureStore(opened), opened.split("train"), settings, seed=0)
    train = TrainConfig(steps=STEPS, save_every=STEPS)
    trainer = fit.AvatarTrainer(learner, task, train, output, settings, extent=1.0, cpu=True)
    trainer.run(progress=False)
    return trainer


def test_two_processes_agree_and_average_their_pictures(tmp_path):
    write_capture(tmp_path / "ball")
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    done = subprocess.run(
        [*command, __file__, str(tmp_path / "ball"), str(tmp_path / "two")],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        timeout=500,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    states = [np.load(tmp_path / f"two{rank}.npz") for rank in range(2)]
    for name in states[0].files:
        assert np.array_equal(states[0][name], states[1][name]), name
    assert len(states[0]["avatar.means"]) == 100
    assert torch.equal(
        load_file(tmp_path / "two" / "model" / "avatar.safetensors")["means"],
        torch.from_numpy(states[0]["avatar.means"]),
    )
    alone = train(tmp_path / "ball", tmp_path / "one").bare.avatar.means
    assert not np.array_equal(states[0]["avatar.means"], alone.detach().numpy())


if __name__ == "__main__":
    trainer = train(Path(sys.argv[1]), Path(sys.argv[2]))
    # What was observed since the last refinement is each process's own.
    state = {k: v.numpy() for k, v in trainer.bare.state_dict().items() if not k.startswith("statistics")}
    np.savez(f"{sys.argv[2]}{trainer.accelerator.process_index}.npz", **state)
