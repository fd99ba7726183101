"""Training Audio2Emotion's classifier: crops of emotional speech, alone and behind a neutral sample."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from accelerate import PartialState
from torch import Tensor, nn
from torch.nn import functional as F
from tqdm import tqdm
from tyro.conf import OmitArgPrefixes

from meshanim.audio import Waveform, load_encoder, load_waveform
from meshanim.datasets.emotional import EmotionalClip, read_emotional, split_speakers
from meshanim.errors import OptionError, ShapeError
from meshanim.models.audio2emotion.detection import QUIET, load_audio2emotion
from meshanim.models.audio2emotion.features import RATE, EmotionFeatures, feature_width
from meshanim.models.audio2emotion.network import Audio2Emotion, Audio2EmotionConfig
from meshanim.motion.emotions import HEARD_EMOTIONS
from meshanim.training.trainer import TrainConfig, Trainer

__all__ = [
    "EmotionCrops",
    "EmotionTask",
    "EmotionalClip",
    "TrainEmotionOptions",
    "fine_tuned",
    "train_emotion",
]

LONGEST = 10.0
"""Seconds of a clip that are heard (App. A.2)."""


@dataclass(frozen=True)
class TrainEmotionOptions:
    """Train a classifier of emotions in speech: frozen encoder, six classes, no speaker in both halves.

    Example: meshanim train audio2emotion --data RAVDESS CREMA-D --output runs/emotion
    """

    data: tuple[Path, ...]
    """Corpora of emotional speech: RAVDESS, CREMA-D, JL, EMO-DB, Emozionalmente, TESS, SAVEE, IEMOCAP, or
    folders SPEAKER/EMOTION/*.wav such as `meshanim data emotional-speech` writes."""
    output: Path = Path("runs/audio2emotion")
    """Gets checkpoints/, results.json and model/; an interrupted run with the same options goes on."""
    held_out: float = 0.2
    """Share of each corpus's speakers that are tested on and not trained on."""
    start: str = ""
    """A classifier to go on from: fine-tuning on a speaker, with a few clips an emotion (App. A.4) and
    --held-out 0."""
    encoder: str = "visemes:hidden"
    """Frozen speech features; the paper's are wav2vec2:PATH of facebook/wav2vec2-large-lv60."""
    prosody: bool = True
    """Whether pitch, voicing and loudness stand beside them."""
    crops: int = 4
    """Stretches of 0.625 s that are taken from each clip."""
    with_neutral: float = 0.5
    """Share of the crops that are heard behind neutral speech of the same speaker."""
    epochs: int = 20
    """Passes over all crops."""
    batch: int = 16
    """Crops a step, on each process."""
    smoothing: float = 0.1
    """Of the labels."""
    train: OmitArgPrefixes[TrainConfig] = field(
        default_factory=lambda: TrainConfig(
            learning_rate=5e-4, schedule="linear", floor=0.1, weight_decay=0.01, save_every=5000
        )
    )
    """The schedule; the learning rate falls linearly from 5e-4 to 5e-5."""
    cpu: bool = False
    """Stay on the CPU where there is a GPU."""

    def __post_init__(self):
        if self.epochs < 1 or self.batch < 1 or self.crops < 1:
            raise OptionError("epochs, batch and crops must be at least 1")
        if not (0 <= self.with_neutral <= 1 and 0 <= self.smoothing < 1):
            raise OptionError("with_neutral and smoothing must be within 0 to 1")


class EmotionCrops:
    """Features of crops of every clip, computed once; 16-bit floats in files where a folder is given.

    Parameters
    ----------
    clips : sequence of EmotionalClip
    features : EmotionFeatures
    crops : int
        A clip; spread evenly over what is not silent.
    seed : int
        Of which neutral clip of the speaker stands before a crop: another one than the clip itself.
    folder : Path, optional
        Where arrays are kept for the next run of the same clips and mapped from; memory if not given.
    progress : bool

    Raises
    ------
    FileFormatError
        If a sound cannot be read.
    ShapeError
        If there is no clip.
    """

    def __init__(
        self,
        clips: Sequence[EmotionalClip],
        features: EmotionFeatures,
        crops: int = 4,
        seed: int = 0,
        folder: Path | None = None,
        progress: bool = False,
    ):
        if not clips:
            raise ShapeError("there are no clips to train on")
        self.clips = list(clips)
        self.labels = np.repeat([HEARD_EMOTIONS.index(clip.emotion) for clip in clips], crops)
        count, dim = len(self.labels), features.config.feature_dim
        steps, long = features.steps, features.reference_steps
        kept = _Kept(folder, [str(features.config), crops, seed, *map(str, clips)])
        self.alone = kept.array("alone", (count, steps, dim), np.float16)
        self.behind = kept.array("behind", (count, steps, dim), np.float16)
        self.reference = kept.array("reference", (count, long, dim), np.float16)
        self.known = kept.array("known", (count,), np.bool_)
        if kept.whole:
            return
        neutral: dict[str, list[EmotionalClip]] = {}
        for clip in clips:
            if clip.emotion == "neutral":
                neutral.setdefault(clip.speaker, []).append(clip)
        generator = np.random.default_rng([seed, 0xA2E])
        row = 0
        for clip in tqdm(self.clips, desc="features", unit="clip", disable=not progress):
            samples = heard_samples(load_waveform(clip.path))
            others = [one for one in neutral.get(clip.speaker, []) if one.path != clip.path]
            before = None
            if others:
                before = load_waveform(others[int(generator.integers(len(others)))].path).samples
            last = max(0, len(samples) - features.crop)
            for start in np.linspace(0, last, crops).round().astype(int):
                part = samples[start : start + features.crop]
                self.alone[row] = features.alone(part).numpy()
                if before is not None:
                    heard, reference = features.after(part, before)
                    self.behind[row], self.reference[row], self.known[row] = heard, reference, True
                row += 1
        kept.finish()

    def __len__(self) -> int:
        return len(self.labels)


def heard_samples(waveform: Waveform) -> np.ndarray:
    """Samples between the first and the last that are not silent, of the first ten seconds."""
    samples = waveform.samples[: round(LONGEST * RATE)]
    loud = np.flatnonzero(np.abs(samples) > max(QUIET, 0.02 * float(np.abs(samples).max())))
    return samples[loud[0] : loud[-1] + 1] if len(loud) else samples


class _Kept:
    """Arrays in memory, or mapped from a folder that a finished run of the same content left."""

    def __init__(self, folder: Path | None, content: list[Any]):
        self.folder = folder
        self.digest = hashlib.sha256(repr(content).encode()).hexdigest()
        self.mark = None if folder is None else folder / "content"
        self.whole = self.mark is not None and self.mark.is_file() and self.mark.read_text() == self.digest
        if folder is not None and self.mark is not None and not self.whole:
            folder.mkdir(parents=True, exist_ok=True)
            self.mark.unlink(missing_ok=True)

    def array(self, name: str, shape: tuple[int, ...], dtype: type) -> np.ndarray:
        if self.folder is None:
            return np.zeros(shape, dtype)
        path = self.folder / f"{name}.npy"
        return np.lib.format.open_memmap(
            path, mode="r" if self.whole else "w+", dtype=np.dtype(dtype), shape=shape
        )

    def finish(self) -> None:
        if self.mark is not None:
            self.mark.write_text(self.digest)


class EmotionTask:
    """Batches of crops in an order of the seed, and the cross-entropy.

    Parameters
    ----------
    crops : EmotionCrops
    batch : int
    with_neutral, smoothing : float
        As of `TrainEmotionOptions`.
    seed : int
    """

    def __init__(self, crops: EmotionCrops, batch: int, with_neutral: float, smoothing: float, seed: int):
        self.crops, self.size, self.with_neutral = crops, batch, with_neutral
        self.smoothing, self.seed = smoothing, seed
        counts = np.bincount(crops.labels, minlength=len(HEARD_EMOTIONS))
        balance = np.where(counts > 0, counts.sum() / np.maximum(counts, 1), 0.0)
        self.weights = torch.from_numpy((balance / balance[counts > 0].mean()).astype(np.float32))

    def epoch(self, shares: int = 1) -> int:
        """Batches that see every crop once."""
        return -(-len(self.crops) // (self.size * shares))

    def batch(self, number: int, share: int = 0, shares: int = 1) -> Mapping[str, Any]:
        """Crops of an epoch's permutation, some of them behind neutral speech."""
        round_, place = divmod(number, self.epoch(shares))
        order = np.random.default_rng([self.seed, round_]).permutation(len(self.crops))
        first = (place * shares + share) * self.size
        rows = np.sort(np.take(order, np.arange(first, first + self.size), mode="wrap"))
        generator = np.random.default_rng([self.seed, number, share])
        known = self.crops.known[rows] & (generator.random(len(rows)) < self.with_neutral)
        features = np.where(known[:, None, None], self.crops.behind[rows], self.crops.alone[rows])
        return {
            "features": torch.from_numpy(features.astype(np.float32)),
            "reference": torch.from_numpy(self.crops.reference[rows].astype(np.float32)),
            "known": torch.from_numpy(known.astype(np.float32)),
            "labels": torch.from_numpy(self.crops.labels[rows]),
        }

    def loss(self, model: nn.Module, batch: Mapping[str, Any]) -> tuple[Tensor, dict[str, Tensor]]:
        """Cross-entropy, classes weighted by how rare they are; the share of right crops for the log."""
        logits = model(batch["features"], batch["reference"], batch["known"])
        loss = F.cross_entropy(
            logits, batch["labels"], self.weights.to(logits), label_smoothing=self.smoothing
        )
        return loss, {"right": (logits.argmax(1) == batch["labels"]).float().mean()}

    def save(self, model: nn.Module, directory: Path) -> None:
        assert isinstance(model, Audio2Emotion)
        model.save_pretrained(directory)


def set_statistics(network: Audio2Emotion, crops: EmotionCrops) -> None:
    """Mean and deviation of the features into the network's buffers."""
    rows = slice(None, None, max(1, len(crops) // 2000))
    features = crops.alone[rows].reshape(-1, network.config.feature_dim).astype(np.float64)
    deviation = features.std(0)
    network.feature_mean.copy_(torch.from_numpy(features.mean(0)))
    network.feature_scale.copy_(torch.from_numpy(np.maximum(deviation, 0.05 * deviation.mean() + 1e-6)))


def train_emotion(options: TrainEmotionOptions, progress: bool = True) -> list[EmotionalClip]:
    """Train, and give the clips of the held-out speakers; the model is in `options.output / "model"`.

    Raises
    ------
    FileFormatError, OptionError, ShapeError
        If a corpus or a sound cannot be read, or an option does not fit.
    """
    everything = [clip for folder in options.data for clip in read_emotional(folder)]
    clips, held = split_speakers(everything, options.held_out)
    torch.manual_seed(options.train.seed)
    state = PartialState(cpu=options.cpu)
    progress = progress and state.is_main_process
    if options.start:
        network = load_audio2emotion(options.start)
    else:
        encoder = load_encoder(options.encoder)
        width = feature_width(encoder, options.prosody)
        network = Audio2Emotion(
            Audio2EmotionConfig(feature_dim=width, encoder=options.encoder, prosody=options.prosody)
        )
    features = EmotionFeatures(network.config)
    folder = options.output / "features" / str(state.process_index)
    crops = EmotionCrops(clips, features, options.crops, options.train.seed, folder, progress)
    if not options.start:
        set_statistics(network, crops)
    task = EmotionTask(crops, options.batch, options.with_neutral, options.smoothing, options.train.seed)
    train = replace(options.train, steps=options.epochs * task.epoch(state.num_processes))
    trainer = Trainer(network, task, train, options.output, cpu=options.cpu)
    trainer.resume()
    trainer.run(progress=progress)
    return held


def fine_tuned(
    network: Audio2Emotion,
    features: EmotionFeatures,
    clips: Sequence[EmotionalClip],
    epochs: int = 20,
    rate: float = 2e-4,
    seed: int = 0,
) -> Audio2Emotion:
    """A copy that knows a speaker: a few passes over one to three clips an emotion (App. A.4).

    Parameters
    ----------
    network : Audio2Emotion
        Stays as it is.
    features : EmotionFeatures
        Of its config.
    clips : sequence of EmotionalClip
        Of one speaker.
    epochs, rate, seed
        Passes, learning rate of AdamW, and what is random.
    """
    copy = Audio2Emotion(network.config)
    copy.load_state_dict(network.state_dict())
    task = EmotionTask(EmotionCrops(clips, features, seed=seed), 16, 0.0, 0.1, seed)
    optimizer = torch.optim.AdamW(copy.parameters(), lr=rate, weight_decay=0.01)
    copy.train()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        for number in range(epochs * task.epoch()):
            loss, _ = task.loss(copy, task.batch(number))
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    return copy.eval()
