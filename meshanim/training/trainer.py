"""One trainer for all models, on Hugging Face Accelerate.

Batches are a function of their number alone, so a run is a function of its seed: an interrupted and resumed
run takes the same steps as one that was never interrupted.
"""

import json
import math
import shutil
import time
from collections.abc import Generator, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

import torch
from accelerate import Accelerator
from accelerate.utils import DistributedDataParallelKwargs
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset, get_worker_info
from tqdm import tqdm

from meshanim.errors import FileFormatError, MeshanimError, OptionError
from meshanim.files import written_whole

__all__ = ["TrainConfig", "Trainer", "TrainingTask", "last_checkpoint", "learning_rate_factor"]


@dataclass(frozen=True)
class TrainConfig:
    """How a model is trained; what it is trained on is the task's.

    Parameters
    ----------
    steps : int
        Optimiser steps of the whole run; GAVA: 70,000.
    learning_rate : float
        Peak of the schedule.
    warmup : int
        Steps of linear warm-up.
    schedule : "constant", "cosine", "linear" or "steps"
        After the warm-up; cosine and linear end at `floor`, steps multiplies by `decay` every `decay_steps`
        steps.
    floor : float
        Factor on the learning rate that cosine and linear end at.
    decay, decay_steps : float, int
        Of the schedule "steps".
    weight_decay : float
        Decoupled (AdamW); 0 is the paper's Adam.
    gradient_clip : float
        Largest norm of the gradient; 0 for no limit.
    accumulation : int
        Batches an optimiser step, on each process.
    ema : float
        Decay of the moving average of the weights that is saved as the result; 0 for none.
    mixed_precision : "no", "bf16" or "fp16"
        Autocast of forward passes.
    seed : int
        Of everything random.
    log_every, save_every : int
        Steps between lines of the log, and between checkpoints.
    keep : int
        Checkpoints kept, the newest.
    workers : int
        Processes that make batches ahead of time, for each training process; 0 makes them between steps.

    Raises
    ------
    OptionError
        If a number is out of range.
    """

    steps: int = 70_000
    learning_rate: float = 1e-4
    warmup: int = 0
    schedule: Literal["constant", "cosine", "linear", "steps"] = "constant"
    floor: float = 0.0
    decay: float = 1.0
    decay_steps: int = 1
    weight_decay: float = 0.0
    gradient_clip: float = 0.0
    accumulation: int = 1
    ema: float = 0.0
    mixed_precision: Literal["no", "bf16", "fp16"] = "no"
    seed: int = 0
    log_every: int = 50
    save_every: int = 1000
    keep: int = 2
    workers: int = 0

    def __post_init__(self):
        for name in ("steps", "accumulation", "log_every", "save_every", "keep", "decay_steps"):
            if getattr(self, name) < 1:
                raise OptionError(f"{name} must be at least 1, not {getattr(self, name)}")
        if self.workers < 0:
            raise OptionError(f"workers must not be negative, not {self.workers}")
        if not self.learning_rate > 0:
            raise OptionError(f"learning_rate must be positive, not {self.learning_rate}")
        if not (0 < self.decay <= 1 and 0 <= self.floor <= 1):
            raise OptionError(f"decay {self.decay} and floor {self.floor} must be in (0, 1] and [0, 1]")
        if not 0 <= self.ema < 1:
            raise OptionError(f"ema must be in [0, 1), not {self.ema}")


@runtime_checkable
class TrainingTask(Protocol):
    """What a trainer needs to know of a model's data and loss."""

    def batch(self, number: int, share: int = 0, shares: int = 1) -> Mapping[str, Any]:
        """A share of the batch of a number: the same one whenever it is asked for.

        The `shares` processes of a run take one each, all of the same size: together the batch is as many
        times as large. Tensors are moved to the device.
        """

    def loss(self, model: nn.Module, batch: Mapping[str, Any]) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss of a batch, and its terms for the log."""

    def save(self, model: nn.Module, directory: Path) -> None:
        """Write the model into a folder that exists."""


def learning_rate_factor(config: TrainConfig, step: int) -> float:
    """Factor on the learning rate at a step, counted from 0."""
    if step < config.warmup:
        return (step + 1) / config.warmup
    if config.schedule == "constant":
        return 1.0
    if config.schedule == "steps":
        return config.decay ** ((step - config.warmup) // config.decay_steps)
    progress = (step - config.warmup) / max(config.steps - config.warmup, 1)
    if config.schedule == "linear":
        return 1 + (config.floor - 1) * min(progress, 1.0)
    return config.floor + (1 - config.floor) * 0.5 * (1 + math.cos(math.pi * min(progress, 1.0)))


def last_checkpoint(directory: str | Path) -> Path | None:
    """The newest checkpoint of a run's folder; None where there is none."""
    return max((Path(directory) / "checkpoints").glob("[0-9]*"), default=None)


class _Batches(Dataset):
    """One process's batches by number, for worker processes: an error that a user can mend is given back."""

    def __init__(self, task: TrainingTask, share: int, shares: int):
        self.task, self.share, self.shares = task, share, shares

    def __getitem__(self, number: int) -> Mapping[str, Any] | MeshanimError:
        if get_worker_info() is None:
            return self.task.batch(number, self.share, self.shares)
        try:
            return self.task.batch(number, self.share, self.shares)
        except MeshanimError as error:
            return error


class _Clock:
    """Time of training steps, and the share of it that was spent waiting for data."""

    def __init__(self) -> None:
        self.start, self.waited, self.steps = time.perf_counter(), 0.0, 0

    @contextmanager
    def waiting(self) -> Iterator[None]:
        begun = time.perf_counter()
        yield
        self.waited += time.perf_counter() - begun
        self.steps += 1

    def read(self) -> dict[str, float]:
        """Since the last reading: seconds a batch, and the share of them for data."""
        passed = max(time.perf_counter() - self.start, 1e-9)
        values = {"seconds": passed / max(self.steps, 1), "data_share": self.waited / passed}
        self.start, self.waited, self.steps = time.perf_counter(), 0.0, 0
        return values


class Trainer:
    """Runs a task's loss to the end of its schedule, with checkpoints.

    Parameters
    ----------
    model : nn.Module
        What learns. Its parameters are changed in place.
    task : TrainingTask
        Batches and loss.
    config : TrainConfig
        The schedule.
    directory : Path
        Gets `checkpoints/STEP/`, `tensorboard/` and, at the end, `model/`.
    cpu : bool
        Stay on the CPU where there is a GPU.
    find_unused : bool
        Some parameters get no gradient (ablations); only matters with several processes.
    """

    def __init__(
        self,
        model: nn.Module,
        task: TrainingTask,
        config: TrainConfig,
        directory: str | Path,
        cpu: bool = False,
        find_unused: bool = False,
    ):
        self.task, self.config, self.directory = task, config, Path(directory)
        self.accelerator = Accelerator(
            mixed_precision=config.mixed_precision,
            gradient_accumulation_steps=config.accumulation,
            cpu=cpu,
            kwargs_handlers=[DistributedDataParallelKwargs(find_unused_parameters=find_unused)],
        )
        torch.manual_seed(config.seed)
        self.model, self.optimizer = self._prepare(model)
        self.step = 0
        self.average: dict[str, Tensor] = {}
        self.reset_average()

    def _prepare(self, model: nn.Module) -> tuple[Any, Any]:
        """The model on its device, with the wrappers of distributed training, and its optimiser."""
        rate, decay = self.config.learning_rate, self.config.weight_decay
        optimizer = torch.optim.AdamW(model.parameters(), lr=rate, weight_decay=decay)
        return self.accelerator.prepare(model, optimizer)

    @property
    def bare(self) -> nn.Module:
        """The model without the wrappers of distributed training."""
        return self.accelerator.unwrap_model(self.model)

    def reset_average(self) -> None:
        """Start the moving average from the weights as they are."""
        if self.config.ema:
            self.average = {name: p.detach().clone() for name, p in self.bare.named_parameters()}

    def run(self, until: int | None = None, progress: bool = True) -> nn.Module:
        """Train from where the run stands to the last step (or to step `until`), and save.

        Returns
        -------
        nn.Module
            The model; with `ema`, the averaged weights are in `directory/model`, the model keeps its own.

        Raises
        ------
        FloatingPointError
            If the loss is not finite.
        """
        config, accelerator = self.config, self.accelerator
        last = config.steps if until is None else min(until, config.steps)
        writer = self._writer()
        bar = tqdm(
            total=config.steps,
            initial=self.step,
            unit="step",
            disable=not (progress and accelerator.is_main_process),
        )
        self.model.train()
        clock = _Clock()
        batches = self._batches(last)
        while self.step < last:
            logs = self._optimizer_step(batches, clock)
            self.step += 1
            bar.update()
            if self.step % config.log_every == 0 or self.step == last:
                values = self._logged(logs) | clock.read()
                if not all(map(math.isfinite, values.values())):
                    raise FloatingPointError(f"the loss of step {self.step} is not finite: {values}")
                bar.set_postfix({name: f"{value:.4g}" for name, value in values.items()})
                if writer is not None:
                    self._report(writer, values)
            if self.step % config.save_every == 0 or self.step == last:
                self.save_checkpoint()
        batches.close()
        bar.close()
        if writer is not None:
            writer.close()
        if self.step == config.steps and accelerator.is_main_process:
            self._save_result()
        accelerator.wait_for_everyone()
        return self.bare

    def _report(self, writer: Any, values: Mapping[str, float]) -> None:
        """What the main process writes for TensorBoard at every line of the log."""
        for name, value in values.items():
            writer.add_scalar(name, value, self.step)

    def _logged(self, logs: Mapping[str, Tensor]) -> dict[str, float]:
        """Means over the processes."""
        values = torch.stack([value.float() for value in logs.values()])
        reduced = self.accelerator.reduce(values, reduction="mean")
        assert isinstance(reduced, Tensor)
        return dict(zip(logs, reduced.tolist(), strict=True))

    def _batches(self, last: int) -> Generator[Mapping[str, Any], None, None]:
        """This process's batches from here to step `last`, made in worker processes if there are any."""
        accumulation, accelerator = self.config.accumulation, self.accelerator
        numbers = range(self.step * accumulation, last * accumulation)
        source = _Batches(self.task, accelerator.process_index, accelerator.num_processes)
        if not self.config.workers or not numbers:
            yield from map(source.__getitem__, numbers)
            return
        loader = DataLoader(
            source,
            batch_size=None,
            sampler=numbers,
            num_workers=self.config.workers,
            prefetch_factor=4,
            pin_memory=accelerator.device.type == "cuda",
            multiprocessing_context="spawn",
        )
        for batch in loader:
            if isinstance(batch, MeshanimError):
                raise batch
            yield batch

    def _optimizer_step(self, batches: Iterator[Mapping[str, Any]], clock: "_Clock") -> dict[str, Tensor]:
        config, accelerator = self.config, self.accelerator
        for group in self.optimizer.param_groups:
            group["lr"] = config.learning_rate * learning_rate_factor(config, self.step)
        logs: dict[str, Tensor] = {}
        for _ in range(config.accumulation):
            with clock.waiting():
                batch = self._to_device(next(batches))
            with accelerator.accumulate(self.model):
                with accelerator.autocast():
                    loss, terms = self.task.loss(self.model, batch)
                accelerator.backward(loss)
                if accelerator.sync_gradients and config.gradient_clip:
                    accelerator.clip_grad_norm_(self.model.parameters(), config.gradient_clip)
                self.optimizer.step()
                self.optimizer.zero_grad()
            for name, value in {"loss": loss, **terms}.items():
                logs[name] = logs.get(name, 0) + value.detach() / config.accumulation
        if self.average:
            # The average of a young run forgets its random start sooner.
            decay = min(config.ema, (1 + self.step) / (10 + self.step))
            with torch.no_grad():
                for name, parameter in self.bare.named_parameters():
                    self.average[name].lerp_(parameter, 1 - decay)
        return logs

    def _to_device(self, batch: Mapping[str, Any]) -> dict[str, Any]:
        device = self.accelerator.device
        return {k: v.to(device, non_blocking=True) if isinstance(v, Tensor) else v for k, v in batch.items()}

    def _writer(self):
        if not self.accelerator.is_main_process:
            return None
        from torch.utils.tensorboard import SummaryWriter

        return SummaryWriter(str(self.directory / "tensorboard"), purge_step=self.step + 1)

    # -- checkpoints --------------------------------------------------------------------------------------

    def save_checkpoint(self) -> None:
        """Write `checkpoints/STEP/`: the model, and all that a resumed run needs; whole or not at all."""
        # Each process has its own random state.
        state = torch.get_rng_state().to(self.accelerator.device)
        states = self.accelerator.gather(state[None]).cpu()
        if self.accelerator.is_main_process:
            folder = self.directory / "checkpoints"
            folder.mkdir(parents=True, exist_ok=True)
            temporary = folder / f".{self.step:07d}"
            shutil.rmtree(temporary, ignore_errors=True)
            temporary.mkdir()
            self.task.save(self.bare, temporary)
            tensors = {f"random.{rank}": row.contiguous() for rank, row in enumerate(states)}
            tensors |= {f"average.{name}": value.cpu() for name, value in self.average.items()}
            tensors |= {f"model.{name}": value.cpu() for name, value in self.bare.state_dict().items()}
            optimizer = self.optimizer.state_dict()
            for index, entries in optimizer["state"].items():
                tensors |= {f"optimizer.{index}.{name}": value.cpu() for name, value in entries.items()}
            if torch.cuda.is_available():
                tensors["random.cuda"] = torch.cuda.get_rng_state()
            save_file(
                {name: value.clone().contiguous() for name, value in tensors.items()},
                temporary / "trainer.safetensors",
            )
            scaler = self.accelerator.scaler
            described = {
                "step": self.step,
                "processes": self.accelerator.num_processes,
                "config": asdict(self.config),
                "scaler": scaler.state_dict() if scaler is not None else None,
            }
            with written_whole(temporary / "trainer.json") as file:
                file.write_text(json.dumps(described, indent=1) + "\n")
            final = folder / f"{self.step:07d}"
            shutil.rmtree(final, ignore_errors=True)
            temporary.rename(final)
            for old in sorted(folder.glob("[0-9]*"))[: -self.config.keep]:
                shutil.rmtree(old)
        self.accelerator.wait_for_everyone()

    def resume(self) -> bool:
        """Go on from the newest checkpoint of the directory; False where there is none.

        Raises
        ------
        OptionError
            If it was made with another configuration or number of processes.
        FileFormatError
            If it is damaged.
        """
        found = last_checkpoint(self.directory)
        if found is None:
            return False
        try:
            described = json.loads((found / "trainer.json").read_text())
            tensors = load_file(found / "trainer.safetensors")
        except (OSError, ValueError, SafetensorError) as error:
            raise FileFormatError(f"{found} is not a checkpoint of a training run: {error}") from error
        fixed = asdict(self.config)
        # Options that are younger than the checkpoint had their defaults.
        described["config"] = asdict(TrainConfig()) | described["config"]
        for name in ("log_every", "save_every", "keep", "workers"):
            fixed.pop(name), described["config"].pop(name, None)
        changed = [name for name in fixed if described["config"].get(name) != fixed[name]]
        if changed or described["processes"] != self.accelerator.num_processes:
            raise OptionError(
                f"{found} was made with another {', '.join(changed) or 'number of processes'}: "
                "use the same options, or another directory"
            )

        def part(prefix: str) -> dict[str, Tensor]:
            return {n.removeprefix(prefix): t for n, t in tensors.items() if n.startswith(prefix)}

        self.bare.load_state_dict(part("model."))
        for name, value in part("average.").items():
            self.average[name].copy_(value)
        state: dict[int, dict[str, Tensor]] = {}
        for name, value in part("optimizer.").items():
            index, key = name.split(".", 1)
            state.setdefault(int(index), {})[key] = value
        groups = self.optimizer.state_dict()["param_groups"]
        self.optimizer.load_state_dict({"state": state, "param_groups": groups})
        if self.accelerator.scaler is not None:
            self.accelerator.scaler.load_state_dict(described["scaler"])
        torch.set_rng_state(tensors[f"random.{self.accelerator.process_index}"].cpu())
        if "random.cuda" in tensors and torch.cuda.is_available():
            torch.cuda.set_rng_state(tensors["random.cuda"])
        self.step = described["step"]
        return True

    def _save_result(self) -> None:
        model = self.bare
        own = {name: parameter.detach().clone() for name, parameter in model.named_parameters()}
        temporary = self.directory / ".model"
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir(parents=True)
        with torch.no_grad():
            for name, parameter in model.named_parameters():
                parameter.copy_(self.average.get(name, parameter))
            self.task.save(model, temporary)
            for name, parameter in model.named_parameters():
                parameter.copy_(own[name])
        final = self.directory / "model"
        shutil.rmtree(final, ignore_errors=True)
        temporary.rename(final)
