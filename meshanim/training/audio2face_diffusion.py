"""Training of Audio2Face-3D's diffusion network: the run behind `meshanim train a2f-diffusion`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from accelerate import PartialState
from jaxtyping import Float, Float32, Int
from torch import Tensor, nn
from tyro.conf import UseAppendAction

from meshanim.audio import load_encoder
from meshanim.datasets.animation_states import AnimationStates, StateClip, at_positions
from meshanim.errors import OptionError
from meshanim.models.audio2face.diffusion import HEAD, Audio2FaceDiffusion, DiffusionConfig
from meshanim.models.audio2face.head_motion import head_of_rotation
from meshanim.models.audio2face.prompts import TextEncoder, load_text_encoder, prompts
from meshanim.motion.animation_state import Actors
from meshanim.training.audio2face_data import SpeechClip, felt, load_speech_clips
from meshanim.training.audio2face_losses import (
    CENTIMETRES,
    EYE_RADIUS,
    LipReader,
    acceleration_loss,
    lip_distance_loss,
    smoothness_loss,
)
from meshanim.training.diffusion_components import ComponentDiffusion, upper_shapes
from meshanim.training.trainer import TrainConfig, Trainer

__all__ = ["DiffusionTask", "DiffusionWeights", "Target", "TrainDiffusionOptions", "train_diffusion"]

LEVER = 10.0
"""Centimetres: an angle of the head counts as the way of its front."""


@dataclass(frozen=True)
class DiffusionWeights:
    """Weights of the terms; lengths in centimetres.

    Parameters
    ----------
    upper_face, lip_distance : float
        alpha of Eq. 9, as published.
    tongue, jaw, eyes, head : float
        Of these parts of the squared error; the skin's (or the rig's) is 1.
    acceleration : float
        Of the head's acceleration, Eq. 15; the paper gives none.
    gamma : float
        Of exp(-gamma opening), a centimetre.
    """

    upper_face: float = 25.0
    lip_distance: float = 1e-5
    tongue: float = 0.1
    jaw: float = 1.0
    eyes: float = 1.0
    head: float = 1.0
    acceleration: float = 1.0
    gamma: float = 10.0


@dataclass(frozen=True)
class TrainDiffusionOptions:
    """Train Audio2Face-3D's diffusion network (v3.0) on the animation states of one or more actors.

    Example: meshanim train a2f-diffusion --data corpus-a2f --output runs/a2f-diffusion
    """

    data: Path
    """Folder that `meshanim data a2f` wrote; the data set that it was made of must still be there."""
    output: Path = Path("runs/a2f-diffusion")
    """Gets checkpoints/, tensorboard/ and model/; an interrupted run with the same options is continued."""
    subject: UseAppendAction[tuple[str, ...]] = ()
    """Whom, given again for several; everybody if not given. Each is an identity of the network."""
    encoder: str = "visemes"
    """Speech encoder; the paper's is hubert:PATH."""
    target: Literal["vertices", "rig"] = "vertices"
    """Raw vertices, or the weights that the data set has as its curves (ARKit's 52)."""
    experts: int = 512
    """With target rig: hidden width of the experts by identity; 0 for none."""
    head_motion: bool = False
    """Generate the head's motion too; subjects whose heads never turn do not train it."""
    substitution: float = 0.3
    """Share of the segments of subjects with head motion that stand for one without, to teach it theirs."""
    text: bool = False
    """Tell the network emotions in sentences instead of by name."""
    text_encoder: str = "minilm"
    """With text: minilm (extra `text`), sentence:PATH or clip:PATH."""
    width: int = 256
    """Of projections, recurrent state and decoder."""
    dropout: float = 0.3
    """Between the layers of the GRU."""
    skin: Literal["vertices", "components"] = "vertices"
    """What a training step computes of the skin: every vertex, or coefficients of the data's components, of
    which the finished network makes vertices. It is the same network where these are all the motion."""
    segment: tuple[int, int] = (30, 600)
    """Fewest and most frames of a training segment."""
    batch: int = 1
    """Segments side by side, of the same length."""
    pure_noise: float = 0.5
    """Share of the segments of which only noise is seen, as in the first denoising step; the others are
    noised to any degree."""
    epochs: int = 400
    """Passes over the clips, a random segment of each; 0 leaves it to train.steps."""
    warmup_epochs: int = 10
    """Passes in which the learning rate rises."""
    weights: DiffusionWeights = field(default_factory=DiffusionWeights)
    """Of the loss."""
    train: TrainConfig = field(
        default_factory=lambda: TrainConfig(learning_rate=5e-5, schedule="cosine", floor=0.2, accumulation=4)
    )
    """The schedule: cosine from 5e-5 to 1e-5, four segments a step."""
    cache: Path | None = None
    """Where speech features are kept; DATA/features if not given."""
    cpu: bool = False
    """Stay on the CPU."""

    def __post_init__(self):
        if self.epochs < 0 or self.warmup_epochs < 0 or self.batch < 1:
            raise OptionError("epochs must not be negative, and a batch needs a segment")
        for name in ("substitution", "pure_noise"):
            if not 0 <= getattr(self, name) <= 1:
                raise OptionError(f"{name} is a share from 0 to 1, not {getattr(self, name)}")
        if self.skin == "components" and self.target == "rig":
            raise OptionError("a rig has weights, no components: leave out --skin")
        if not 2 <= self.segment[0] <= self.segment[1]:
            raise OptionError(
                f"segments of {self.segment[0]} to {self.segment[1]} frames; expected 2 or more"
            )


class Target:
    """What a network learns to make of a clip: the numbers of its frames, metres and radians.

    Parameters
    ----------
    states : AnimationStates
        The data.
    config : DiffusionConfig
        Says which numbers.
    components : bool
        Coefficients of the skin in place of vertices.
    """

    def __init__(self, states: AnimationStates, config: DiffusionConfig, components: bool = False):
        self.states, self.config, self.components = states, config, components
        self.motions: dict[str, tuple[Tensor | None, Tensor | None]] = {}

    def motion(self, sequence: str) -> tuple[Tensor | None, Tensor | None]:
        """Curves and head motion of a sequence of the source."""
        if sequence not in self.motions:
            arrays = self.states.source.motion(sequence)
            curves = None
            if self.config.target == "rig":
                names = self.states.source.curve_names
                assert arrays.curves is not None
                curves = torch.from_numpy(
                    np.array(arrays.curves[:, [names.index(n) for n in self.config.rig]])
                )
            head = None
            if self.config.head_motion:
                given = arrays.coefficients.get("head_motion")
                if given is not None:
                    head = torch.from_numpy(np.array(given, np.float32))
                elif arrays.pose is not None:
                    head = head_of_rotation(torch.from_numpy(np.array(arrays.pose)))
                else:
                    head = torch.zeros(len(arrays.vertices), HEAD)
            self.motions[sequence] = (curves, head)
        return self.motions[sequence]

    def frames(self, clip: SpeechClip, first: int, last: int) -> Float32[Tensor, "frames numbers"]:
        """Frames of a clip, parts in the network's order."""
        rows = slice(first, last)
        timeline = clip.arrays.timeline[rows]
        curves, head = self.motion(clip.clip.sequence)
        parts = []
        if curves is not None:
            parts.append(torch.from_numpy(at_positions(curves.numpy(), timeline)))
        elif self.components:
            parts.append(torch.from_numpy(clip.arrays.state[rows]))
        else:
            basis = self.states.basis
            vertices = torch.from_numpy(self.states.vertices(clip.clip.name, timeline))
            template = self.states.templates[clip.clip.subject]
            parts.append((vertices - template)[:, basis.parts.skin].flatten(1))
            parts.append(torch.from_numpy(clip.arrays.state[rows])[:, basis.sizes["skin"] :])
        if head is not None:
            parts.append(torch.from_numpy(at_positions(head.numpy(), timeline)))
        return torch.cat(parts, dim=1).float()

    def turns(self, subject: str) -> bool:
        """Whether a subject's head ever moves."""
        for clip in self.states.clips.values():
            if clip.subject == subject and clip.made == "recorded":
                head = self.motion(clip.sequence)[1]
                if head is not None and bool(head.abs().max() > 1e-4):
                    return True
        return False


def _draw(chance: torch.Generator, low: int, high: int) -> int:
    return int(torch.randint(low, high + 1, (), generator=chance))


class DiffusionTask:
    """Random segments of clips with noise, and the loss of Eq. 9.

    Parameters
    ----------
    network : Audio2FaceDiffusion
        Says what is made, about which mean and in which deviations.
    target : Target
        The truth.
    clips : sequence of SpeechClip
        Training data.
    rate : float
        Feature steps a second.
    weights : DiffusionWeights
        Of the terms.
    segment : (int, int)
        Fewest and most frames.
    sentences : mapping of clip names to (N, text) tensors, optional
        Embeddings of what may be said of a clip, with a network that is told sentences.
    turning : sequence of str
        Identities with head motion.
    substitution : float
        Share of their segments that stand for an identity without it.
    size : int
        Segments side by side.
    pure_noise : float
        Share of the segments at the last time of the schedule.
    seed : int
        Of everything random.
    """

    def __init__(
        self,
        network: Audio2FaceDiffusion,
        target: Target,
        clips: Sequence[SpeechClip],
        rate: float,
        weights: DiffusionWeights = DiffusionWeights(),
        segment: tuple[int, int] = (30, 600),
        sentences: Mapping[str, Tensor] | None = None,
        turning: Sequence[str] = (),
        substitution: float = 0.3,
        size: int = 1,
        pure_noise: float = 0.5,
        seed: int = 0,
    ):
        self.config, self.parts, self.schedule = network.config, network.parts, network.schedule
        self.mean, self.scale = network.mean.clone(), network.scale.clone()
        self.target, self.clips, self.rate, self.weights = target, clips, rate, weights
        self.segment, self.sentences, self.seed = segment, sentences or {}, seed
        self.turning, self.substitution = set(turning), substitution
        self.size, self.pure_noise = size, pure_noise
        self.still = [k for k, name in enumerate(self.config.identities) if name not in self.turning]
        self.lips = LipReader(network.actors)
        self.people = list(network.actors.templates)
        basis, self.components = network.actors.basis, isinstance(network, ComponentDiffusion)
        parts = basis.parts
        self.upper = torch.from_numpy(
            np.searchsorted(parts.skin, np.intersect1d(parts.upper_face, parts.skin))
        )
        self.upper_shapes = upper_shapes(basis, self.upper) if self.components else None
        self.units = torch.full((network.numbers,), CENTIMETRES)
        for part in self.parts:
            if part.name == "tongue" or (part.name == "skin" and self.components):
                # Coefficients so that their mean square is that of the vertices' displacements.
                self.units[part.columns] *= (part.size / (3 * len(getattr(parts, part.name)))) ** 0.5
            elif part.name == "eyes":
                self.units[part.columns] = EYE_RADIUS
            elif part.name == "rig":
                self.units[part.columns] = 1.0
            elif part.name == "head":
                self.units[part.columns][:6] = LEVER

    def batch(self, number: int, share: int = 0, shares: int = 1) -> dict[str, Any]:
        """Segments of the clips whose turn it is; an epoch is a permutation of the clips."""
        first = (number * shares + share) * self.size
        clips = [self._clip(place) for place in range(first, first + self.size)]
        chances = [
            torch.Generator().manual_seed((self.seed + 1) * 7_000_003 + first + k) for k in range(self.size)
        ]
        shortest = min(map(len, clips))
        fewest, most = (min(bound, shortest) for bound in self.segment)
        counts = [_draw(chance, fewest, most) for chance in chances]
        rows = [self._segment(clip, counts[0], chance) for clip, chance in zip(clips, chances)]
        return {name: torch.stack([row[name] for row in rows]) for name in rows[0]}

    def _clip(self, place: int) -> SpeechClip:
        epoch, turn = divmod(place, len(self.clips))
        order = torch.randperm(
            len(self.clips), generator=torch.Generator().manual_seed(self.seed * 1_000_003 + epoch)
        )
        return self.clips[int(order[turn])]

    def _segment(self, clip: SpeechClip, count: int, chance: torch.Generator) -> dict[str, Tensor]:
        first = _draw(chance, 0, len(clip) - count)
        times = (torch.arange(first, first + count, dtype=torch.float64) + 0.5) / self.config.fps
        clean = self.target.frames(clip, first, first + count)
        identity = list(self.config.identities).index(clip.clip.subject)
        turns = clip.clip.subject in self.turning
        coin = float(torch.rand((), generator=chance))
        other = _draw(chance, 0, max(len(self.still) - 1, 0))
        only_head = turns and bool(self.still) and coin < self.substitution
        pure = float(torch.rand((), generator=chance)) < self.pure_noise
        return {
            "features": clip.features_at(self.rate, times),
            "clean": clean,
            "noise": torch.randn(count, clean.shape[1], generator=chance),
            "times": torch.tensor(self.config.steps - 1 if pure else _draw(chance, 0, self.config.steps - 1)),
            "emotions": self._mood(clip.clip, count, chance),
            "identities": torch.tensor(self.still[other] if only_head else identity),
            "subject": torch.tensor(self.people.index(clip.clip.subject)),
            "head": torch.tensor(turns),
            "face": torch.tensor(not only_head),
        }

    def _mood(self, clip: StateClip, count: int, chance: torch.Generator) -> Tensor:
        if self.config.text:
            rows = self.sentences[clip.name]
            return rows[_draw(chance, 0, len(rows) - 1)].expand(count, -1)
        strengths = torch.zeros(count, len(self.config.emotions))
        if clip.emotion in self.config.emotions:
            strengths[:, self.config.emotions.index(clip.emotion)] = clip.intensity
        return strengths

    def loss(self, model: nn.Module, batch: Mapping[str, Any]) -> tuple[Tensor, dict[str, Tensor]]:
        """Eq. 9 and its terms, unweighted; with head motion, the head's squared error and Eq. 15."""
        truth = batch["clean"]
        mean, scale, units = (t.to(truth.device) for t in (self.mean, self.scale, self.units))
        noisy = self.schedule.noised((truth - mean) / scale, batch["noise"], batch["times"])
        found = mean + scale * model(
            batch["features"], noisy, batch["times"], batch["emotions"], batch["identities"]
        )
        error = ((found - truth) * units).square()
        weights = self.weights
        # What does not count is multiplied by zero: every parameter gets a gradient on every process.
        face, head = batch["face"].to(error), batch["head"].to(error)
        terms, loss = {}, found.sum() * 0
        for part in self.parts:
            weight, counted = getattr(weights, part.name, 1.0), head if part.name == "head" else face
            terms[part.name] = (error[..., part.columns].mean((1, 2)) * counted).mean()
            loss = loss + weight * terms[part.name]
        if self.parts[0].name == "skin":
            columns = self.parts[0].columns
            if len(self.upper):
                smooth = smoothness_loss(self._upper_face(found[..., columns]) * CENTIMETRES)
                terms["upper_face"] = (smooth * face).mean()
                loss = loss + weights.upper_face * terms["upper_face"]
            self.lips.to(found.device)
            subject = batch["subject"][:, None].expand(found.shape[:2])
            opening, true_opening = (self._openings(x[..., columns], subject) for x in (found, truth))
            opening = torch.where(batch["face"][:, None, None], opening, true_opening)
            terms["lip_distance"] = lip_distance_loss(opening, true_opening, weights.gamma)
            loss = loss + weights.lip_distance * terms["lip_distance"]
        if self.config.head_motion:
            motion = (found * units)[..., self.parts[-1].columns]
            terms["acceleration"] = (
                (acceleration_loss(motion) * head).mean() if motion.shape[1] > 2 else 0 * loss
            )
            loss = loss + weights.acceleration * terms["acceleration"]
        return loss, terms

    def _upper_face(self, skin: Float[Tensor, "batch frames numbers"]) -> Float[Tensor, "batch frames upper"]:
        """Displacements of the upper face, or numbers with the same mean square differences."""
        if self.upper_shapes is not None:
            return skin @ self.upper_shapes.to(skin)
        return skin.unflatten(2, (-1, 3))[:, :, self.upper.to(skin.device)].flatten(2)

    def _openings(
        self, skin: Float[Tensor, "batch frames numbers"], subject: Int[Tensor, "batch frames"]
    ) -> Float[Tensor, "batch frames lips"]:
        if self.components:
            return self.lips.of_states(skin, subject)[0]
        return self.lips.of_skin(skin.unflatten(2, (-1, 3)), subject)[0]

    def save(self, model: nn.Module, directory: Path) -> None:
        assert isinstance(model, Audio2FaceDiffusion)
        (model.folded() if isinstance(model, ComponentDiffusion) else model).save_pretrained(directory)


def train_diffusion(options: TrainDiffusionOptions, progress: bool = True) -> Path:
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
    people = options.subject or tuple(states.templates)
    encoder = load_encoder(options.encoder)
    rig = tuple(states.source.curve_names) if options.target == "rig" else ()
    if options.target == "rig" and not rig:
        raise OptionError(f"the data set of {options.data} has no curves to learn: solve its weights first")
    told = load_text_encoder(options.text_encoder) if options.text else None
    with state.main_process_first():
        clips = load_speech_clips(
            states,
            states.of(people),
            encoder,
            "speech",
            options.cache or options.data / "features",
            progress=progress,
        )
    config = DiffusionConfig(
        feature_dim=encoder.dim,
        encoder=options.encoder,
        identities=people,
        emotions=() if told else felt(clips),
        width=options.width,
        dropout=options.dropout,
        fps=states.fps,
        head=states.head,
        target=options.target,
        rig=rig,
        experts=options.experts if rig else 0,
        head_motion=options.head_motion,
        text=told.dim if told else 0,
        text_encoder=options.text_encoder if told else "",
    )
    actors = Actors(states.basis, {name: states.templates[name] for name in people}, states.faces)
    components = options.skin == "components"
    network = (ComponentDiffusion if components else Audio2FaceDiffusion)(config, actors)
    target = Target(states, config, components)
    turning = [name for name in people if options.head_motion and target.turns(name)]
    if options.head_motion and not turning:
        raise OptionError(f"no head turns in {options.data}: leave out --head-motion")
    set_statistics(network, target, clips, turning)
    task = DiffusionTask(
        network,
        target,
        clips,
        encoder.rate,
        options.weights,
        options.segment,
        _sentences(states, clips, told) if told else None,
        turning,
        options.substitution,
        options.batch,
        options.pure_noise,
        options.train.seed,
    )
    epoch = len(clips) / state.num_processes / options.train.accumulation / options.batch
    train = options.train
    if options.epochs:
        warmup = round(options.warmup_epochs * epoch)
        train = replace(train, steps=max(1, round(options.epochs * epoch)), warmup=warmup)
    trainer = Trainer(network, task, train, options.output, cpu=options.cpu)
    trainer.resume()
    trainer.run(progress=progress)
    return options.output / "model"


def _sentences(
    states: AnimationStates, clips: Sequence[SpeechClip], encoder: TextEncoder
) -> dict[str, Tensor]:
    """Embeddings of the prompts of every clip, by its label and the mean of its ARKit weights."""
    names = states.source.curve_names
    means: dict[str, dict[str, float]] = {}
    found: dict[tuple[str, ...], Tensor] = {}
    sentences = {}
    for clip in clips:
        about = clip.clip
        if about.sequence not in means:
            curves = states.source.motion(about.sequence).curves
            values = [] if curves is None or not len(names) else curves.mean(0).tolist()
            means[about.sequence] = dict(zip(names, values))
        said = prompts(
            about.emotion, about.intensity, {} if about.made == "silence" else means[about.sequence]
        )
        if said not in found:
            found[said] = encoder(said)
        sentences[about.name] = found[said]
    return sentences


def set_statistics(
    network: Audio2FaceDiffusion, target: Target, clips: Sequence[SpeechClip], turning: Sequence[str]
) -> None:
    """Put means and deviations of features and frames into the network's buffers.

    The skin's mean is that of its components, its one deviation that of all its numbers; another part has one
    deviation too, angles and translation of the head one each.
    """
    stride = max(1, len(clips) // 256)
    features = torch.cat([torch.from_numpy(clip.features[:].astype(np.float32)) for clip in clips[::stride]])
    network.feature_mean.copy_(features.mean(0))
    deviation = features.std(0, correction=0)
    network.feature_scale.copy_(deviation.clamp_min(0.1 * float(features.std()) + 1e-6))
    basis = network.actors.basis
    states = torch.cat([torch.from_numpy(clip.arrays.state) for clip in clips]).double()
    at = basis.columns
    for part in network.parts:
        columns = part.columns
        if part.name == "skin":
            count = 3 * len(basis.parts.skin)
            if not isinstance(network, ComponentDiffusion):
                network.mean[columns] = basis.skin_mean.flatten()
            spread = states[:, at["skin"]].square().sum(1).mean() / count
            network.scale[columns] = float(spread.sqrt().clamp_min(1e-6))
            if isinstance(network, ComponentDiffusion):
                sizes = states[:, at["skin"]].square().mean(0).sqrt() / network.scale[columns]
                network.gain[columns] = sizes.clamp_min(1).float()
            continue
        if part.name in ("rig", "head"):
            chosen = [c for c in clips if c.clip.made == "recorded"]
            if part.name == "head":
                chosen = [c for c in chosen if c.clip.subject in turning]
            which = 0 if part.name == "rig" else 1
            rows = [target.motion(c.clip.sequence)[which] for c in chosen]
            values = torch.cat([row for row in rows if row is not None]).double()
        else:
            values = states[:, at[part.name]]
        network.mean[columns] = values.mean(0).float()
        groups = (slice(0, 6), slice(6, 9)) if part.name == "head" else (slice(0, part.size),)
        for group in groups:
            spread = (values[:, group] - values[:, group].mean(0)).square().mean().sqrt()
            network.scale[columns][group] = float(spread.clamp_min(1e-4))
