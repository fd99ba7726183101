"""Audio2Face-3D's diffusion network (v3.0): noise and speech to raw vertices, for many identities."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from meshanim.errors import OptionError, ShapeError
from meshanim.models.audio2face.checkpoint import ActorCheckpoint
from meshanim.models.audio2face.schedule import CosineSchedule, FrameNoise
from meshanim.motion.animation_state import Actors, FacePose

__all__ = ["REACH", "Audio2FaceDiffusion", "DiffusionConfig", "IdentityExperts", "Part"]

KERNEL = 9
REACH = KERNEL // 2
"""Frames before and after that a frame's inputs are mixed with."""
NARROW = 32
HEAD = 9
"""Numbers of the head's motion: two joints of three Euler angles, and a translation (Sec. 9.2)."""


@dataclass(frozen=True)
class DiffusionConfig:
    """What a diffusion network is made of.

    Parameters
    ----------
    feature_dim : int
        Speech features a step (HuBERT base: 768).
    encoder : str
        As `load_encoder` takes it; the paper's is hubert:PATH.
    identities : sequence of str
        Whom it can be, one-hot.
    emotions : sequence of str
        But neutral; a strength for each in every frame.
    width : int
        Of projections, recurrent state and decoder (256).
    layers : int
        Of the GRU (2).
    dropout : float
        Between its layers (0.3).
    steps : int
        T of the schedule.
    sampling : int
        Denoising steps when it speaks (2).
    fps : float
        Frames a second; a recurrent network knows no other.
    head : str
        As `load_head` takes it, or "".
    target : "vertices" or "rig"
        Raw vertices, or the weights of a rig (Sec. 9.3).
    rig : sequence of str
        Names of the rig's weights.
    experts : int
        Hidden width of a feed-forward layer over the speech features with an expert for each identity
        (Eqs. 16 and 17); 0 for none.
    head_motion : bool
        Whether the head's motion is generated, too (Sec. 9.2).
    text : int
        Numbers of a sentence embedding that takes the place of emotions (Sec. 9.1); 0 for emotions.
    text_encoder : str
        As `load_text_encoder` takes it.

    Raises
    ------
    OptionError
        If a number is out of range.
    """

    feature_dim: int
    encoder: str = "visemes"
    identities: Sequence[str] = ("",)
    emotions: Sequence[str] = ()
    width: int = 256
    layers: int = 2
    dropout: float = 0.3
    steps: int = 1000
    sampling: int = 2
    fps: float = 30.0
    head: str = ""
    target: Literal["vertices", "rig"] = "vertices"
    rig: Sequence[str] = ()
    experts: int = 0
    head_motion: bool = False
    text: int = 0
    text_encoder: str = ""

    def __post_init__(self):
        for name in ("feature_dim", "width", "layers", "steps", "sampling"):
            if getattr(self, name) < 1:
                raise OptionError(f"{name} must be at least 1, not {getattr(self, name)}")
        if not self.identities or not self.fps > 0 or self.sampling > self.steps:
            raise OptionError("a network needs an identity, positive fps, and no more sampling than steps")
        if "neutral" in self.emotions:
            raise OptionError("neutral is the absence of emotions, not one of them")
        if (self.target == "rig") != bool(self.rig):
            raise OptionError('target "rig" needs the names of its weights, and "vertices" has none')
        if self.text and self.emotions:
            raise OptionError("a network is told emotions or sentences, not both")
        object.__setattr__(self, "rig", tuple(self.rig))
        object.__setattr__(self, "identities", tuple(self.identities))
        object.__setattr__(self, "emotions", tuple(self.emotions))

    @property
    def mood(self) -> int:
        """Numbers a frame that say the emotion: strengths, or a sentence embedding."""
        return self.text or len(self.emotions)


class Part(NamedTuple):
    """A component of what is generated: its numbers in a frame."""

    name: str
    columns: slice
    projected: int

    @property
    def size(self) -> int:
        return self.columns.stop - self.columns.start


def _waves(steps: int, width: int) -> Float[Tensor, "steps width"]:
    """Cosines and sines of one to 64 half turns over the steps."""
    turns = torch.arange(steps)[:, None] / steps * 2.0 ** (torch.arange(width) // 2 % 7)
    return torch.cos(torch.pi * (turns + 0.5 * (torch.arange(width) % 2)))


class IdentityExperts(nn.Module):
    """A feed-forward layer whose first half is an expert for each identity: h + W gelu(M_i h + b_i).

    One-hot identities choose, mixtures of them mix (Eqs. 16 and 17).

    Parameters
    ----------
    width, hidden, experts : int
        Numbers of a step, numbers between, and identities.
    """

    def __init__(self, width: int, hidden: int, experts: int):
        super().__init__()
        one = nn.Linear(width, hidden)
        # All begin as the same: what sets identities apart is learned.
        self.matrices = nn.Parameter(one.weight.detach().repeat(experts, 1, 1))
        self.offsets = nn.Parameter(one.bias.detach().repeat(experts, 1))
        self.second = nn.Linear(hidden, width)

    def forward(
        self, steps: Float[Tensor, "batch steps width"], identities: Float[Tensor, "batch experts"]
    ) -> Float[Tensor, "batch steps width"]:
        matrices = torch.einsum("bi,ihw->bhw", identities, self.matrices)
        hidden = steps @ matrices.transpose(1, 2) + (identities @ self.offsets)[:, None]
        return steps + self.second(functional.gelu(hidden))


class Audio2FaceDiffusion(ActorCheckpoint):
    """X_0 = f(audio, X_t, t, emotion a frame, identity): Eq. 6.

    What is generated has, in every frame, the displacements of all skin vertices, the coefficients of the
    tongue, the jaw's points and the angles of the eyes, each component about its mean in units of its
    deviation. Every input has a projection of its own; geometry and speech are mixed over nine frames; all of
    it goes through a GRU and a decoder, whose last layers start at zero: the mean face.

    Parameters
    ----------
    config : DiffusionConfig
        The network.
    actors : Actors
        Basis of tongue, jaw and eyes, and the neutral face of every identity.

    Notes
    -----
    The paper names the projections, the GRU and the decoder; sizes are the public code's. With target "rig"
    the noisy weights go into the GRU as they are, and a linear layer decodes (Sec. 9.3.2). Ours are:

    - Speech mixed over nine frames: HuBERT's features know what comes, those of streaming encoders in part.
    - `trust`, a factor on what is noisy for each time; it begins as the share of the signal, so that pure
      noise does not drown the speech.
    - `manner`: emotion and identity scale and shift the decoder's hidden numbers (FiLM; Perez et al., AAAI
      2018), besides being inputs of the GRU.
    - The mixed geometry goes to the last layers directly, too: what can be seen need not be remembered.
    """

    title = "Audio2Face-3D diffusion network"
    config: DiffusionConfig
    feature_mean: Tensor
    feature_scale: Tensor
    mean: Tensor
    scale: Tensor

    def __init__(self, config: DiffusionConfig, actors: Actors):
        super().__init__()
        self.config, self.actors = config, actors
        self.schedule = CosineSchedule(config.steps)
        self.parts = tuple(self._parts())
        width = config.width
        self.numbers = self.parts[-1].columns.stop
        self.speech = nn.Linear(config.feature_dim, width)
        self.speech_mix = nn.Conv1d(width, width, KERNEL, padding=REACH)
        rig = config.target == "rig"
        self.experts = None
        if config.experts:
            self.experts = IdentityExperts(config.feature_dim, config.experts, len(config.identities))
        self.geometry, self.geometry_mix = nn.ModuleList(), None
        if not rig:
            self.geometry.extend(nn.Linear(part.size, part.projected) for part in self.parts)
            projected = sum(part.projected for part in self.parts)
            self.geometry_mix = nn.Conv1d(projected, width, KERNEL, padding=REACH)
        self.time = nn.Embedding(config.steps, width)
        self.trust = nn.Embedding(config.steps, 1)
        self.emotion = nn.Linear(max(config.mood, 1), NARROW)
        self.identity = nn.Embedding(len(config.identities), NARROW)
        self.recurrent = nn.GRU(
            2 * width + (self.numbers if rig else width) + 2 * NARROW,
            width,
            config.layers,
            batch_first=True,
            dropout=config.dropout if config.layers > 1 else 0.0,
        )
        self.hidden = nn.Identity() if rig else nn.Sequential(nn.Linear(width, width), nn.Mish())
        self.outputs = nn.ModuleList(nn.Linear(width, part.size) for part in self.parts)
        self.manner = nn.Linear(2 * NARROW, 2 * width)
        with torch.no_grad():
            for parameter in (*self.outputs.parameters(), *self.manner.parameters()):
                parameter.zero_()
            # Times that are near begin alike; noise counts for nothing where there is nothing else.
            self.time.weight.copy_(_waves(config.steps, width))
            self.trust.weight.copy_(torch.from_numpy(self.schedule.kept).sqrt()[:, None])
            # As large as the embeddings beside it.
            self.emotion.weight.normal_()
        self.register_buffer("feature_mean", torch.zeros(config.feature_dim))
        self.register_buffer("feature_scale", torch.ones(config.feature_dim))
        self.register_buffer("mean", torch.zeros(self.numbers))
        self.register_buffer("scale", torch.ones(self.numbers))

    def _parts(self) -> Iterator[Part]:
        first = 0
        own = self.actors.basis.sizes
        sizes = {
            "skin": 3 * len(self.actors.basis.parts.skin),
            **{n: own[n] for n in ("tongue", "jaw", "eyes")},
        }
        if self.config.target == "rig":
            sizes = {"rig": len(self.config.rig)}
        if self.config.head_motion:
            sizes["head"] = HEAD
        for name, size in sizes.items():
            if size:
                yield Part(name, slice(first, first + size), self.config.width if name == "skin" else NARROW)
                first += size

    def part(self, name: str) -> Part | None:
        """A component by name; None where there is none."""
        return next((part for part in self.parts if part.name == name), None)

    def encode(
        self,
        features: Float[Tensor, "batch frames dim"],
        noisy: Float[Tensor, "batch frames numbers"],
        times: Int[Tensor, " batch"],
        emotions: Float[Tensor, "batch frames emotions"],
        identities: Int[Tensor, " batch"],
    ) -> Float[Tensor, "batch frames inputs"]:
        """What the GRU reads. The first and last frames see zeros where there are no frames."""
        steps = (features - self.feature_mean) / self.feature_scale
        if self.experts is not None:
            chosen = functional.one_hot(identities, len(self.config.identities)).to(steps)
            steps = self.experts(steps, chosen)
        spoken = self.speech(steps)
        spoken = functional.mish(self.speech_mix(spoken.mT).mT)
        shape = noisy = self.trust(times)[:, None] * noisy
        if self.geometry_mix is not None:
            parts = zip(self.parts, self.geometry)
            shape = torch.cat([layer(noisy[..., part.columns]) for part, layer in parts], -1)
            shape = self.geometry_mix(shape.mT).mT
        if not self.config.mood:
            emotions = spoken.new_zeros(*spoken.shape[:2], 1)
        still = torch.cat([functional.mish(self.time(times)), self.identity(identities)], dim=-1)
        still = still[:, None].expand(-1, spoken.shape[1], -1)
        return torch.cat([spoken, shape, still, self.emotion(emotions)], dim=-1)

    def decode(
        self, hidden: Float[Tensor, "batch frames width"], inputs: Float[Tensor, "batch frames inputs"]
    ) -> Float[Tensor, "batch frames numbers"]:
        """X_0, about the mean, in deviations, of the GRU's output and what it read."""
        gain, offset = self.manner(inputs[..., -2 * NARROW :]).chunk(2, dim=-1)
        hidden = (1 + gain) * self.hidden(hidden) + offset
        if self.geometry_mix is not None:
            hidden = hidden + inputs[..., self.config.width : 2 * self.config.width]
        return torch.cat([layer(hidden) for layer in self.outputs], dim=-1)

    def forward(
        self,
        features: Float[Tensor, "batch frames dim"],
        noisy: Float[Tensor, "batch frames numbers"],
        times: Int[Tensor, " batch"],
        emotions: Float[Tensor, "batch frames emotions"],
        identities: Int[Tensor, " batch"],
    ) -> Float[Tensor, "batch frames numbers"]:
        """Denoised frames (Eq. 6).

        Parameters
        ----------
        features : (B, T, F)
            Speech features at the frames' times.
        noisy : (B, T, D)
            X_t, about the mean, in deviations.
        times : (B,)
            Steps of the schedule, 0 to T - 1.
        emotions : (B, T, E)
            Strengths in every frame, zeros are neutral; or sentence embeddings.
        identities : (B,)
            Rows of the identities.

        Raises
        ------
        ShapeError
            If an input has another width than the network's.
        """
        if features.shape[2] != self.config.feature_dim or noisy.shape[2] != self.numbers:
            raise ShapeError(
                f"features have width {features.shape[2]} and frames {noisy.shape[2]}; expected "
                f"{self.config.feature_dim} and {self.numbers}"
            )
        inputs = self.encode(features, noisy, times, emotions, identities)
        return self.decode(self.recurrent(inputs)[0], inputs)

    @torch.inference_mode()
    def sample(
        self,
        features: Float[Tensor, "frames dim"],
        emotions: Float[Tensor, "frames emotions"],
        identity: int = 0,
        noise: FrameNoise | None = None,
        steps: int | None = None,
    ) -> Float[Tensor, "frames numbers"]:
        """Whole speech at once: frames in metres and radians.

        Parameters
        ----------
        features : (T, F)
            At the frames' times.
        emotions : (T, E)
            Strengths.
        identity : int
            Row of the identities.
        noise : FrameNoise, optional
            That of seed 0 if not given.
        steps : int, optional
            Denoising steps; the config's if not given.

        Raises
        ------
        ShapeError
            If there are no frames.
        """
        if not len(features):
            raise ShapeError("there is no frame to make: the speech is empty")
        plan = self.schedule.sampling(self.config.sampling if steps is None else steps)
        noise = FrameNoise(len(plan), self.numbers) if noise is None else noise
        drawn = noise.frames(0, len(features)).to(self.device)[:, None]
        who = torch.tensor([identity], device=self.device)
        x = drawn[0]
        for number, step in enumerate(plan):
            time = torch.tensor([step.time], device=self.device)
            clean = self(features[None].to(self.device), x, time, emotions[None].to(self.device), who)
            x = step.clean * clean + step.noisy * x
            if number + 1 < len(plan):
                x = x + step.deviation * drawn[number + 1]
        return self.mean + x[0] * self.scale

    def normalized(self, frames: Float[Tensor, "*batch numbers"]) -> Float[Tensor, "*batch numbers"]:
        """Frames in metres and radians about their mean, in deviations."""
        return (frames - self.mean) / self.scale

    def pose(self, frames: Float[Tensor, "frames numbers"]) -> FacePose:
        """Frames in metres and radians as displacements and angles.

        Raises
        ------
        OptionError
            If the network makes rig weights.
        """
        if self.config.target == "rig":
            raise OptionError("this network makes rig weights (`rig_weights`), not vertices")
        basis, count = self.actors.basis, len(frames)
        sizes = {"tongue": basis.sizes["tongue"], "jaw": 15, "eyes": 4}
        found = {}
        for name, size in sizes.items():
            part = self.part(name)
            found[name] = frames.new_zeros(count, size) if part is None else frames[:, part.columns]
        skin = frames[:, self.parts[0].columns].unflatten(1, (-1, 3))
        tongue = basis.tongue_mean.to(frames) + torch.einsum(
            "tk,kvc->tvc", found["tongue"], basis.tongue_components.to(frames)
        )
        return FacePose(skin, tongue, found["jaw"].unflatten(1, (5, 3)), found["eyes"].unflatten(1, (2, 2)))

    def rig_weights(self, frames: Float[Tensor, "frames numbers"]) -> Float[Tensor, "frames weights"]:
        """Weights of `config.rig` in [0, 1].

        Raises
        ------
        OptionError
            If the network makes vertices.
        """
        if self.config.target != "rig":
            raise OptionError("this network makes vertices (`vertices`), not rig weights")
        return frames[:, self.parts[0].columns].clamp(0, 1)

    def head_motion(self, frames: Float[Tensor, "frames numbers"]) -> Float[Tensor, "frames 9"]:
        """Angles of neck and head (x, y, z each), radians, and translation, metres; zeros without it."""
        part = self.part("head")
        return frames.new_zeros(len(frames), HEAD) if part is None else frames[:, part.columns]

    def vertices(
        self, frames: Float[Tensor, "frames numbers"], identity: str | int = 0
    ) -> Float[Tensor, "frames vertices 3"]:
        """The whole face of an identity: its neutral face and the motion that was generated."""
        name = self.config.identities[identity] if isinstance(identity, int) else identity
        if name not in self.actors.templates:
            raise OptionError(f"no identity {name!r}; there are {', '.join(self.actors.templates)}")
        return self.actors.basis.posed(self.pose(frames), self.actors.templates[name].to(frames))
