"""How the packaged viseme encoder was made, in two commands:

python -m meshanim.audio.viseme_training speak CORPUS
python -m meshanim.audio.viseme_training train CORPUS RUN
"""

import json
import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, cast

import numpy as np
import torch
import tyro
from jaxtyping import Float32, Int64
from torch import Tensor
from torch.nn import functional as F
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from tqdm import tqdm

from meshanim.audio.augmentation import degrade, mask_features, resample_clip
from meshanim.audio.features import DEFAULT_MEL, mel_filters, power_frames, utterance_normalization
from meshanim.audio.phonemes import PHONEMES, VISEME_OF_PHONEME, VISEMES
from meshanim.audio.viseme_corpus import HOP, Utterance, load_corpus, speak_corpus
from meshanim.audio.visemes import MEMORY, VisemeNet, VisemeNetConfig, save_viseme_net
from meshanim.errors import FileFormatError
from meshanim.files import written_whole

__all__ = ["TrainingConfig", "VisemeBatches", "train"]

RATE = 16000
WARPS = tuple(np.linspace(0.82, 1.2, 20).round(4).tolist())


@dataclass(frozen=True)
class TrainingConfig:
    """Training of the viseme net.

    Parameters
    ----------
    steps : int
        Optimiser steps.
    batch : int
        Clips a step.
    seconds : float
        Length of a clip.
    rate : float
        Learning rate at the top of its cosine.
    warmup : int
        Steps of linear rise.
    decay : float
        AdamW's weight decay.
    smoothing : float
        Label smoothing.
    balance : float
        Classes weigh count ** -balance.
    average : float
        Decay of the exponential average of the weights that is saved.
    seed : int
        Decides batches, augmentation, initial weights and dropout.
    save_every : int
        Steps between checkpoints.
    threads : int
        Of torch.
    half : bool
        Convolutions in bfloat16 (twice as fast on processors that have it).
    """

    steps: int = 2000
    batch: int = 16
    seconds: float = 3.2
    rate: float = 2e-3
    warmup: int = 50
    decay: float = 1e-2
    smoothing: float = 0.05
    balance: float = 0.3
    average: float = 0.99
    seed: int = 0
    save_every: int = 100
    threads: int = 1
    half: bool = True


class VisemeBatches:
    """Augmented clips of the corpus; step k is the same whenever it is asked for.

    Parameters
    ----------
    corpus : list of Utterance
        Families of voices are drawn with equal probability.
    config : TrainingConfig
        Sizes and seed.
    """

    def __init__(self, corpus: list[Utterance], config: TrainingConfig):
        self.config = config
        self.families = [
            [u for u in corpus if u.family == name] for name in sorted({u.family for u in corpus})
        ]
        self.samples = int(config.seconds * RATE) // (2 * HOP) * 2 * HOP
        counts = np.bincount(np.concatenate([u.labels for u in corpus]), minlength=len(PHONEMES))
        self.phoneme_counts = counts.astype(np.float64)

    def clip(
        self, generator: np.random.Generator, speed: float
    ) -> tuple[Float32[np.ndarray, " samples"], Int64[np.ndarray, " frames"]]:
        """Utterances of one family joined with random pauses, played at `speed`, with a label each 10 ms."""
        needed = int(self.samples * speed) + 2 * HOP
        family = self.families[int(generator.integers(len(self.families)))]
        samples: list[np.ndarray] = []
        labels: list[np.ndarray] = []
        total = 0
        while total < needed:
            utterance = family[int(generator.integers(len(family)))]
            pause = int(generator.integers(0, 50)) if generator.random() < 0.7 else 0
            start = 0
            if not samples and len(utterance.samples) > needed // 2:
                start = int(generator.integers(0, (len(utterance.samples) - needed // 2) // HOP + 1))
                pause = 0
            samples += [np.zeros(pause * HOP, np.int16), utterance.samples[start * HOP :]]
            labels += [np.zeros(pause, np.uint8), utterance.labels[start:]]
            total += pause * HOP + len(utterance.samples) - start * HOP
        joined = np.concatenate(samples).astype(np.float32) / 32768
        times = (np.arange(self.samples // HOP) * speed).astype(np.int64)
        return resample_clip(joined, self.samples, speed), np.concatenate(labels)[times].astype(np.int64)

    def _babble(self, generator: np.random.Generator, count: int) -> Float32[np.ndarray, " samples"]:
        voices = [self.clip(generator, 1.0)[0] for _ in range(int(generator.integers(3, 7)))]
        return np.sum([generator.uniform(0.3, 1) * v for v in voices], axis=0).astype(np.float32)[:count]

    def log_mel(
        self, step: int
    ) -> tuple[Float32[Tensor, "batch frames bands"], Int64[Tensor, "batch frames"]]:
        """Log-mel of augmented clips before normalisation, and a label each 10 ms."""
        return self._log_mel(np.random.default_rng((self.config.seed, step)))

    def _log_mel(
        self, generator: np.random.Generator
    ) -> tuple[Float32[Tensor, "batch frames bands"], Int64[Tensor, "batch frames"]]:
        config = self.config
        speeds = [
            generator.uniform(0.85, 1.18) if generator.random() < 0.7 else 1.0 for _ in range(config.batch)
        ]
        clips, labels = zip(*[self.clip(generator, speed) for speed in speeds])
        sound = degrade(np.stack(clips), generator, self._babble)
        power = power_frames(F.pad(sound, (DEFAULT_MEL.margin, DEFAULT_MEL.margin)), DEFAULT_MEL)
        warps = [WARPS[int(generator.integers(len(WARPS)))] for _ in range(config.batch)]
        filters = torch.stack([mel_filters(DEFAULT_MEL, warp) for warp in warps])
        return torch.log(power @ filters + DEFAULT_MEL.floor), torch.from_numpy(np.stack(labels))

    def __call__(
        self, step: int, net: VisemeNet
    ) -> tuple[Float32[Tensor, "batch bands mel_frames"], Int64[Tensor, "batch frames"]]:
        """Normalised log-mel of a step and the phoneme at each output frame.

        The normalisation varies: running, from a prior worth 0.1 to 2 s or from the clip's own statistics (a
        stream that has been on for long), or the statistics of the clip (a file).
        """
        generator = np.random.default_rng((self.config.seed, step))
        mel, labels = self._log_mel(generator)
        normal = torch.empty_like(mel)
        for clip, out in zip(mel, normal):
            kind = generator.random()
            if kind < 0.25:
                out[:] = utterance_normalization(clip)
                continue
            running = net.running_normalization(float(np.exp(generator.uniform(np.log(10), np.log(200)))))
            if kind < 0.45:
                running.mean, running.variance = clip.double().mean(0).numpy(), clip.double().var(0).numpy()
                running.count = MEMORY
            out[:] = torch.from_numpy(running(clip.numpy()))
        mask_features(normal, generator)
        return normal.transpose(1, 2), labels[:, 1::2]


def _learning_rate(config: TrainingConfig, step: int) -> float:
    rise = min(1.0, (step + 1) / config.warmup)
    return config.rate * rise * 0.5 * (1 + math.cos(math.pi * step / config.steps)) + 1e-5


def _class_weights(counts: np.ndarray, balance: float) -> Float32[Tensor, " classes"]:
    counts = counts + 50.0
    return torch.from_numpy((counts.mean() / counts) ** balance).float()


def train(corpus: str | Path, folder: str | Path, config: TrainingConfig = TrainingConfig()) -> Path:
    """Train the net, or go on where an earlier run of the same configuration stopped: the result is the same.

    Parameters
    ----------
    corpus : str or Path
        Folder of `speak_corpus`.
    folder : str or Path
        Gets checkpoint.pt, log.jsonl, and visemes.safetensors with its json at every checkpoint.
    config : TrainingConfig
        Sizes and rates.

    Returns
    -------
    Path
        The weights.

    Raises
    ------
    FileFormatError
        If the corpus is missing or the checkpoint is of another configuration.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed)
    utterances = load_corpus(corpus)
    batches = VisemeBatches(utterances, config)
    net = VisemeNet(VisemeNetConfig())
    optimizer = torch.optim.AdamW(net.parameters(), lr=config.rate, weight_decay=config.decay)
    averaged = AveragedModel(net, multi_avg_fn=get_ema_multi_avg_fn(config.average), use_buffers=True)
    checkpoint = folder / "checkpoint.pt"
    first = 0
    if checkpoint.exists():
        state = torch.load(checkpoint, weights_only=True)
        if state["config"] != asdict(replace(config, save_every=0, threads=0)):
            raise FileFormatError(
                f"{checkpoint} is of another configuration; choose another folder or delete it"
            )
        net.load_state_dict(state["net"])
        averaged.load_state_dict(state["averaged"])
        optimizer.load_state_dict(state["optimizer"])
        first = state["step"]
    else:
        mel = torch.cat([batches.log_mel(config.steps + k)[0].flatten(0, 1) for k in range(8)])
        net.prior_mean.copy_(mel.mean(0))
        net.prior_variance.copy_(mel.var(0))

    weights = _class_weights(batches.phoneme_counts, config.balance)
    viseme_counts = np.bincount(VISEME_OF_PHONEME, batches.phoneme_counts, minlength=len(VISEMES))
    viseme_weights = _class_weights(viseme_counts, config.balance)
    viseme_of = torch.from_numpy(VISEME_OF_PHONEME)
    net.train()
    window: list[tuple[float, float]] = []
    for step in tqdm(
        range(first, config.steps), initial=first, total=config.steps, desc="train", mininterval=5
    ):
        torch.manual_seed(config.seed * 1_000_003 + step)
        for group in optimizer.param_groups:
            group["lr"] = _learning_rate(config, step)
        mel, labels = batches(step, net)
        with torch.autocast("cpu", torch.bfloat16, enabled=config.half):
            phonemes, visemes = (logits.float() for logits in net(mel))
        loss = F.cross_entropy(phonemes, labels, weight=weights, label_smoothing=config.smoothing)
        loss = loss + F.cross_entropy(
            visemes, viseme_of[labels], weight=viseme_weights, label_smoothing=config.smoothing
        )
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), 2.0)
        optimizer.step()
        averaged.update_parameters(net)
        window.append((loss.item(), (visemes.argmax(1) == viseme_of[labels]).float().mean().item()))
        if (step + 1) % config.save_every == 0 or step + 1 == config.steps:
            with written_whole(checkpoint) as path:
                torch.save(
                    {
                        "config": asdict(replace(config, save_every=0, threads=0)),
                        "step": step + 1,
                        "net": net.state_dict(),
                        "averaged": averaged.state_dict(),
                        "optimizer": optimizer.state_dict(),
                    },
                    path,
                )
            about = {"steps": step + 1, "hours": _hours(utterances), "config": asdict(config)}
            save_viseme_net(cast(VisemeNet, averaged.module), folder / "visemes.safetensors", about)
            mean_loss, accuracy = np.mean(window, axis=0)
            window.clear()
            with (folder / "log.jsonl").open("a") as log:
                log.write(
                    json.dumps({"step": step + 1, "loss": mean_loss, "viseme_accuracy": accuracy}) + "\n"
                )
    return folder / "visemes.safetensors"


def _hours(utterances: list[Utterance]) -> dict[str, float]:
    hours: dict[str, float] = {}
    for utterance in utterances:
        hours[utterance.family] = hours.get(utterance.family, 0.0) + len(utterance.samples) / RATE / 3600
    return {family: round(value, 3) for family, value in hours.items()}


@dataclass(frozen=True)
class Speak:
    """Generate the training speech: about ten minutes for three hours of it on two cores."""

    folder: tyro.conf.Positional[Path]
    hours: float = 3.0
    seed: int = 0
    processes: int = 2


@dataclass(frozen=True)
class Train:
    """Train the viseme encoder; run it again after an interruption and it goes on."""

    corpus: tyro.conf.Positional[Path]
    folder: tyro.conf.Positional[Path]
    config: Annotated[TrainingConfig, tyro.conf.arg(name="")] = TrainingConfig()


def main() -> None:
    job = tyro.cli(Speak | Train)
    if isinstance(job, Speak):
        speak_corpus(job.folder, job.hours, job.seed, job.processes)
    else:
        print(train(job.corpus, job.folder, job.config))


if __name__ == "__main__":
    main()
