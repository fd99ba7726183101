"""Training of Audio2Face-3D's regression network: the run behind `meshanim train a2f-regression`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from accelerate import PartialState
from jaxtyping import Float, Int
from torch import Tensor, nn

from meshanim.audio import load_encoder
from meshanim.datasets.animation_states import AnimationStates, at_positions
from meshanim.errors import OptionError
from meshanim.models.audio2face.regression import (
    STEP_TIMES,
    STEPS,
    WINDOW,
    Audio2FaceRegression,
    ImplicitClip,
    RegressionConfig,
)
from meshanim.models.audio2face.speech import RATE, Hearing, hearing
from meshanim.motion.animation_state import Actors
from meshanim.training.audio2face_data import SpeechClip, chosen_subjects, felt, load_speech_clips
from meshanim.training.audio2face_losses import (
    PRESETS,
    LipReader,
    RegressionWeights,
    implicit_emotion_loss,
    lip_distance_loss,
    lip_size_loss,
    motion_loss,
    phoneme_loss,
    phoneme_motion_loss,
    state_loss,
    state_units,
    volume_stability_loss,
)
from meshanim.training.sampling import WindowSampler
from meshanim.training.trainer import TrainConfig, Trainer

__all__ = ["RegressionLearner", "RegressionTask", "TrainRegressionOptions", "train_regression"]


@dataclass(frozen=True)
class TrainRegressionOptions:
    """Train Audio2Face-3D's regression network (v2.3) on one actor's animation states.

    Example: meshanim train a2f-regression --data corpus-a2f --subject S01 --output runs/a2f
    """

    data: Path
    """Folder that `meshanim data a2f` wrote."""
    output: Path = Path("runs/a2f-regression")
    """Gets checkpoints/, tensorboard/ and model/; an interrupted run with the same options is continued."""
    subject: str = ""
    """Whose; may be left out where there is one."""
    encoder: str = "visemes"
    """Speech encoder; the paper's is wav2vec2:PATH@4."""
    hearing: Literal["auto", "speech", "window"] = "auto"
    """Features of the whole speech, or of each 0.52 s window alone (the paper); auto takes windows for
    encoders that do not stream."""
    preset: Literal["james", "claire", "mark"] = "claire"
    """Published loss weights."""
    epochs: int = 50
    """Passes over all pairs of frames (James: 70); 0 leaves it to train.steps."""
    batch_pairs: int = 32
    """Pairs of adjacent frames a batch, on each process."""
    shift: float = 1.0
    """Frames by which a pair is moved in time at random, sound and states alike; 0 with windows."""
    train: TrainConfig = field(
        default_factory=lambda: TrainConfig(learning_rate=2e-4, schedule="steps", decay=0.994)
    )
    """The schedule; an epoch is a step of its decay."""
    cache: Path | None = None
    """Where speech features are kept; DATA/features if not given."""
    cpu: bool = False
    """Stay on the CPU."""

    def __post_init__(self):
        if self.epochs < 0 or self.batch_pairs < 1 or not 0 <= self.shift <= 1:
            raise OptionError("epochs must not be negative, batch_pairs at least 1 and shift within 0 to 1")


class RegressionLearner(nn.Module):
    """A regression network with its implicit emotions in one forward call, as DDP needs it."""

    def __init__(self, network: Audio2FaceRegression):
        super().__init__()
        self.network = network

    def forward(
        self,
        windows: Float[Tensor, "batch samples"],
        features: Float[Tensor, "batch steps dim"],
        explicit: Float[Tensor, "batch emotions"],
        rows: Int[Tensor, " batch"],
    ) -> tuple[Tensor, dict[str, Tensor], Tensor]:
        """States, logits by language, implicit emotions."""
        implicit = self.network.implicit(rows)
        states, logits = self.network(windows, features, explicit, implicit)
        return states, logits, implicit


class RegressionTask:
    """Batches of pairs of adjacent frames with open eyes, and the loss of Eq. 1.

    Parameters
    ----------
    config : RegressionConfig
        The network's; its clips say which row of implicit emotions a frame has.
    actors : Actors
        Of the states.
    clips : sequence of SpeechClip
        Training data.
    rate : float
        Feature steps a second of whole speech.
    weights : RegressionWeights
        Of the terms.
    pairs : int
        A batch.
    shift : float
        Frames by which pairs are moved in time.
    seed : int
        Of the order and the shifts.
    """

    def __init__(
        self,
        config: RegressionConfig,
        actors: Actors,
        clips: Sequence[SpeechClip],
        rate: float,
        weights: RegressionWeights = PRESETS["claire"],
        pairs: int = 32,
        shift: float = 1.0,
        seed: int = 0,
    ):
        self.config, self.clips, self.rate, self.weights = config, clips, rate, weights
        self.shift = shift if config.hearing == "speech" else 0.0
        self.units = state_units(actors.basis)
        self.lips = LipReader(actors)
        self.people = list(actors.templates)
        first = {clip.name: clip.first for clip in config.spans}
        self.rows = [first[implicit_name(clip)] for clip in clips]
        self.runs = [(k, *run) for k, clip in enumerate(clips) for run in open_runs(clip.arrays.open)]
        if not self.runs:
            raise OptionError("no two adjacent frames have open eyes: is the neutral face's a blink?")
        self.sampler = WindowSampler([count for *_, count in self.runs], 2, pairs, seed)

    @property
    def epoch(self) -> float:
        """Batches that see every pair once."""
        return len(self.sampler.slots) / self.sampler.windows

    def batch(self, number: int, share: int = 0, shares: int = 1) -> dict[str, Any]:
        """Pairs one after the other: (2 B, ...) inputs and truth."""
        parts: dict[str, list[Tensor]] = {}
        for span in self.sampler.spans(number, share, shares):
            k, begun, _ = self.runs[span.clip]
            clip = self.clips[k]
            frames = begun + span.first + np.arange(2)
            moved = (2 * span.coin - 1) * self.shift
            positions = (frames + moved).clip(0, len(clip) - 1)
            times = (positions + 0.5) / self.config.fps
            steps = times[:, None] + STEP_TIMES
            if self.config.hearing == "window":
                read = torch.from_numpy(clip.features[frames[0] : frames[1] + 1].astype(np.float32))
                features = read.unflatten(1, (STEPS, -1))
            else:
                features = clip.features_at(self.rate, torch.from_numpy(steps))
            explicit = torch.zeros(2, len(self.config.emotions))
            if clip.clip.emotion in self.config.emotions:
                explicit[:, self.config.emotions.index(clip.clip.emotion)] = clip.clip.intensity
            known = clip.clip.language in self.config.languages
            labels = clip.phonemes_at(steps) if known else np.full(steps.shape, -1)
            starts = [round(time * RATE - WINDOW / 2) for time in times]
            row = {
                "windows": clip.sound(starts, WINDOW),
                "features": features,
                "explicit": explicit,
                "rows": torch.from_numpy(self.rows[k] + frames),
                "state": torch.from_numpy(at_positions(clip.arrays.state, positions)),
                "labels": torch.from_numpy(labels),
                "speaks": torch.full((2,), self.config.languages.index(clip.clip.language) if known else -1),
                "subject": torch.full((2,), self.people.index(clip.clip.subject)),
            }
            for name, value in row.items():
                parts.setdefault(name, []).append(value)
        return {name: torch.cat(values) for name, values in parts.items()}

    def loss(self, model: nn.Module, batch: Mapping[str, Any]) -> tuple[Tensor, dict[str, Tensor]]:
        """Eq. 1 and its terms, unweighted."""
        states, logits, implicit = model(
            batch["windows"], batch["features"], batch["explicit"], batch["rows"]
        )
        self.lips.to(states.device)
        weights, units = self.weights, self.units.to(states.device)

        def pairs(values: Tensor) -> Tensor:
            return values.unflatten(0, (-1, 2))

        found, true = pairs(states * units), pairs(batch["state"] * units)
        opening, size = self.lips.of_states(states, batch["subject"])
        with torch.no_grad():
            true_opening, true_size = self.lips.of_states(batch["state"], batch["subject"])
        volume = pairs(batch["windows"]).square().mean((1, 2)).sqrt()
        terms = {
            "state": state_loss(found, true),
            "motion": motion_loss(found, true),
            "phoneme": states.new_zeros(()),
            "phoneme_motion": states.new_zeros(()),
            "volume": volume_stability_loss(found, volume, weights.beta),
            "emotion": implicit_emotion_loss(pairs(implicit)),
            "lip_distance": lip_distance_loss(opening, true_opening, weights.gamma),
            "lip_size": lip_size_loss(size, true_size),
        }
        for k, language in enumerate(self.config.languages):
            labels = torch.where((batch["speaks"] == k)[:, None], batch["labels"], -1)
            terms["phoneme"] = terms["phoneme"] + phoneme_loss(logits[language], labels)
            change = phoneme_motion_loss(pairs(logits[language]), pairs(labels))
            terms["phoneme_motion"] = terms["phoneme_motion"] + change
        loss = sum((getattr(weights, name) * value for name, value in terms.items()), states.new_zeros(()))
        return loss, terms

    def save(self, model: nn.Module, directory: Path) -> None:
        network = model.network
        assert isinstance(network, Audio2FaceRegression)
        network.deployed().save_pretrained(directory)


def open_runs(opened: np.ndarray) -> list[tuple[int, int]]:
    """First frame and length of every run of at least two frames with open eyes."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], opened > 0, [0]]).astype(np.int8)))
    return [(int(a), int(b - a)) for a, b in zip(edges[::2], edges[1::2]) if b - a >= 2]


def implicit_name(clip: SpeechClip) -> str:
    """Other voices of one performance share its implicit emotions."""
    return clip.clip.sequence if clip.clip.made in ("recorded", "pitch", "voice") else clip.clip.name


def implicit_clips(clips: Sequence[SpeechClip]) -> tuple[ImplicitClip, ...]:
    """Rows for every performance, one after the other."""
    found: dict[str, ImplicitClip] = {}
    first = 0
    for clip in clips:
        name = implicit_name(clip)
        if name not in found:
            found[name] = ImplicitClip(name, clip.clip.emotion, first, len(clip))
            first += len(clip)
    return tuple(found.values())


def train_regression(options: TrainRegressionOptions, progress: bool = True) -> Path:
    """Train, and give the folder of the finished model.

    Raises
    ------
    FileFormatError, OptionError
        If the data cannot be read or an option does not fit them.
    """
    torch.manual_seed(options.train.seed)
    state = PartialState(cpu=options.cpu)
    progress = progress and state.is_main_process
    states = AnimationStates(options.data)
    subjects = chosen_subjects(states, options.subject)
    encoder = load_encoder(options.encoder)
    heard: Hearing = hearing(encoder) if options.hearing == "auto" else options.hearing
    with state.main_process_first():
        clips = load_speech_clips(
            states,
            states.of(subjects),
            encoder,
            heard,
            options.cache or options.data / "features",
            (WINDOW, STEP_TIMES + WINDOW / 2 / RATE),
            progress,
        )
    spoken = {
        clip.clip.language for clip in clips if clip.clip.made != "silence" and clip.clip.labels != "none"
    }
    config = RegressionConfig(
        feature_dim=encoder.dim,
        encoder=options.encoder,
        hearing=heard,
        emotions=felt(clips),
        languages=sorted(spoken),
        clips=implicit_clips(clips),
        subject=subjects[0],
        fps=states.fps,
        head=states.head,
    )
    actors = Actors(states.basis, {name: states.templates[name] for name in subjects}, states.faces)
    network = Audio2FaceRegression(config, actors)
    set_statistics(network, clips)
    task = RegressionTask(
        config,
        actors,
        clips,
        encoder.rate,
        PRESETS[options.preset],
        options.batch_pairs,
        options.shift,
        options.train.seed,
    )
    epoch = max(1, round(task.epoch / state.num_processes / options.train.accumulation))
    train = replace(options.train, decay_steps=epoch)
    if options.epochs:
        train = replace(train, steps=options.epochs * epoch)
    trainer = Trainer(RegressionLearner(network), task, train, options.output, cpu=options.cpu)
    trainer.resume()
    trainer.run(progress=progress)
    return options.output / "model"


def set_statistics(network: Audio2FaceRegression, clips: Sequence[SpeechClip]) -> None:
    """Put means and deviations of features and states into the network's buffers."""
    stride = max(1, len(clips) // 256)
    rows = [torch.from_numpy(clip.features[:].astype(np.float32)) for clip in clips[::stride]]
    features = torch.cat([row.reshape(-1, network.config.feature_dim) for row in rows]).double()
    network.encoder.feature_mean.copy_(features.mean(0))
    deviation = features.std(0, correction=0)
    network.encoder.feature_scale.copy_(deviation.clamp_min(0.1 * float(features.std()) + 1e-6))
    states = torch.cat([torch.from_numpy(clip.arrays.state) for clip in clips]).double()
    network.state_mean.copy_(states.mean(0))
    network.state_scale.copy_(states.std(0, correction=0).clamp_min(1e-6))
