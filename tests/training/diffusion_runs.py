"""Short runs of the diffusion network's training, and what they would train."""

from meshanim.training import audio2face_diffusion as training
from meshanim.training.audio2face_diffusion import TrainDiffusionOptions, train_diffusion
from meshanim.training.trainer import TrainConfig


def options(states, output, **changes):
    defaults = {
        "data": states,
        "output": output,
        "encoder": "mel",
        "epochs": 0,
        "width": 32,
        "cpu": True,
        "train": TrainConfig(steps=4, learning_rate=3e-3, log_every=1000, save_every=1000),
    }
    return TrainDiffusionOptions(**(defaults | changes))


def task_of(states, monkeypatch, tmp_path, **changes):
    """The task, the network and the settings of a run that does not run."""
    kept = {}

    class Still(training.Trainer):
        def run(self, progress=True):
            kept.update(task=self.task, model=self.bare, config=self.config)

    with monkeypatch.context() as patched:
        patched.setattr(training, "Trainer", Still)
        train_diffusion(options(states, tmp_path / "still", **changes), progress=False)
    return kept["task"], kept["model"], kept["config"]
