"""Audio2Face-3D's regression network (v2.3): half a second of sound to one animation state."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from meshanim.errors import OptionError, ShapeError
from meshanim.models.audio2face.checkpoint import ActorCheckpoint
from meshanim.models.audio2face.speech import Hearing
from meshanim.motion.animation_state import Actors

__all__ = [
    "STEPS",
    "STEP_TIMES",
    "WINDOW",
    "Audio2FaceRegression",
    "ImplicitClip",
    "RegressionConfig",
    "RegressionOutput",
    "window_autocorrelation",
]

WINDOW = 8320
"""Samples at 16 kHz around a frame: 0.52 s (Sec. 4.1)."""
STEPS = 25
"""Steps of a window, 20 ms apart: the autocorrelation's windows of 640 samples, 320 apart."""
SHORT, HOP, LAGS, SCALE = 640, 320, 32, 8.912
STEP_TIMES = (np.arange(STEPS) - STEPS // 2) * (HOP / 16000)
"""Seconds from the frame to each step's middle."""
FREQUENCY_CHANNELS = (72, 108, 162, 243, 256)
TIME_LAYERS = 4
CHANNELS = 256


@dataclass(frozen=True)
class ImplicitClip:
    """Rows of the implicit emotions that belong to one training clip."""

    name: str
    emotion: str
    first: int
    count: int


@dataclass(frozen=True)
class RegressionConfig:
    """What a regression network is made of.

    Parameters
    ----------
    feature_dim : int
        Speech features a step (wav2vec 2.0 base: 768).
    encoder : str
        As `load_encoder` takes it; the paper's is wav2vec2:PATH@4.
    hearing : "speech" or "window"
        Features of the whole speech, or of each window of 8,320 samples alone (the paper).
    emotions : sequence of str
        Explicit emotions but neutral.
    implicit : int
        Numbers of an implicit emotion (16).
    emotion_width : int
        Numbers that explicit emotions are embedded in (8).
    languages : sequence of str
        Phoneme heads, one a language; none in a deployed network.
    phonemes : int
        Classes of a phoneme head.
    clips : sequence of ImplicitClip
        Whose implicit emotions were learned; their frames are the rows.
    subject : str
        Who it was trained on.
    fps : float
        Frames a second in training; any rate can be asked for.
    head : str
        As `load_head` takes it, or "".

    Raises
    ------
    OptionError
        If a number is out of range.
    """

    feature_dim: int
    encoder: str = "visemes"
    hearing: Hearing = "speech"
    emotions: Sequence[str] = ()
    implicit: int = 16
    emotion_width: int = 8
    languages: Sequence[str] = ("en",)
    phonemes: int = 40
    clips: Sequence[ImplicitClip | Mapping[str, Any]] = ()
    subject: str = ""
    fps: float = 30.0
    head: str = ""

    def __post_init__(self):
        for name in ("feature_dim", "implicit", "emotion_width", "phonemes"):
            if getattr(self, name) < 1:
                raise OptionError(f"{name} must be at least 1, not {getattr(self, name)}")
        if "neutral" in self.emotions:
            raise OptionError("neutral is the absence of emotions, not one of them")
        clips = (ImplicitClip(**clip) if isinstance(clip, Mapping) else clip for clip in self.clips)
        object.__setattr__(self, "clips", tuple(clips))
        object.__setattr__(self, "emotions", tuple(self.emotions))
        object.__setattr__(self, "languages", tuple(self.languages))

    @property
    def spans(self) -> tuple[ImplicitClip, ...]:
        """The clips."""
        return tuple(clip for clip in self.clips if isinstance(clip, ImplicitClip))

    @property
    def rows(self) -> int:
        """Frames that have an implicit emotion; at least one."""
        return max([clip.first + clip.count for clip in self.spans], default=1)


class RegressionOutput(NamedTuple):
    """States in metres and radians, and phoneme logits by language (empty in a deployed network)."""

    states: Float[Tensor, "batch state"]
    phonemes: dict[str, Float[Tensor, "batch steps phonemes"]]


def window_autocorrelation(windows: Float[Tensor, "batch samples"]) -> Float[Tensor, "batch steps lags"]:
    """32 autocorrelation coefficients of each of a window's 25 parts of 640 samples.

    The same as `meshanim.audio.autocorrelation`, by products instead of a transform, so that it can be
    exported. Source: Karras et al., SIGGRAPH 2017, Sec. 3.2.
    """
    first = HOP * torch.arange(STEPS, device=windows.device)[:, None]
    parts = windows[:, first + torch.arange(SHORT, device=windows.device)]
    hann = torch.hann_window(SHORT, periodic=False, dtype=windows.dtype, device=windows.device)
    parts = (parts - parts.mean(-1, keepdim=True)) * hann
    sums = [(parts[..., : SHORT - lag] * parts[..., lag:]).sum(-1) for lag in range(LAGS)]
    return torch.stack(sums, dim=-1) * (SCALE / SHORT)


class HybridEncoder(nn.Module):
    """Autocorrelation and speech features of a window: (B, 512, 25).

    Autocorrelation goes through five convolutions over the lags (Karras et al.), the frozen encoder's
    features through a linear layer.
    """

    feature_mean: Tensor
    feature_scale: Tensor

    def __init__(self, feature_dim: int):
        super().__init__()
        sizes = (1, *FREQUENCY_CHANNELS)
        self.frequency = nn.ModuleList(
            nn.Conv2d(a, b, (1, 3), stride=(1, 2), padding=(0, 1)) for a, b in pairwise(sizes)
        )
        self.features = nn.Linear(feature_dim, CHANNELS)
        self.register_buffer("feature_mean", torch.zeros(feature_dim))
        self.register_buffer("feature_scale", torch.ones(feature_dim))

    def forward(
        self, windows: Float[Tensor, "batch samples"], features: Float[Tensor, "batch steps dim"]
    ) -> Float[Tensor, "batch channels steps"]:
        heard = window_autocorrelation(windows)[:, None]
        for layer in self.frequency:
            heard = functional.relu(layer(heard))
        spoken = functional.relu(self.features((features - self.feature_mean) / self.feature_scale))
        return torch.cat([heard[..., 0], spoken.transpose(1, 2)], dim=1)


class Audio2FaceRegression(ActorCheckpoint):
    """Half a second of sound, its speech features and an emotion to the animation state of its middle.

    Parameters
    ----------
    config : RegressionConfig
        The network.
    actors : Actors
        The basis of the states, and the neutral face.

    Notes
    -----
    The paper names the parts and the public code their sizes: autocorrelation through 72 to 256 channels, the
    encoder's features through 256, four convolutions over time with stride 2, the emotion (16 implicit and 8
    embedded explicit numbers) beside the input of each, a linear layer, and two linear outputs: skin, and
    tongue with jaw and eyes. Outputs are scaled by the mean and deviation of the training states.
    """

    title = "Audio2Face-3D regression network"
    config: RegressionConfig
    state_mean: Tensor
    state_scale: Tensor

    def __init__(self, config: RegressionConfig, actors: Actors):
        super().__init__()
        self.config, self.actors = config, actors
        sizes = actors.basis.sizes
        self.encoder = HybridEncoder(config.feature_dim)
        self.emotion = nn.Linear(max(len(config.emotions), 1), config.emotion_width)
        self.implicit = nn.Embedding(config.rows, config.implicit)
        extra = config.implicit + config.emotion_width
        self.time = nn.ModuleList(
            nn.Conv1d((CHANNELS if k else 2 * CHANNELS) + extra, CHANNELS, 3, stride=2, padding=1)
            for k in range(TIME_LAYERS)
        )
        steps = STEPS
        for _ in range(TIME_LAYERS):
            steps = (steps - 1) // 2 + 1
        self.joint = nn.Linear(steps * CHANNELS + extra, CHANNELS)
        self.skin = nn.Linear(CHANNELS, sizes["skin"])
        self.rest = nn.Linear(CHANNELS, actors.basis.width - sizes["skin"])
        self.heads = nn.ModuleDict(
            {
                language: nn.Sequential(
                    nn.Conv1d(2 * CHANNELS, 128, 3, padding=1), nn.ReLU(), nn.Conv1d(128, config.phonemes, 1)
                )
                for language in config.languages
            }
        )
        self.register_buffer("state_mean", torch.zeros(actors.basis.width))
        self.register_buffer("state_scale", torch.ones(actors.basis.width))

    def forward(
        self,
        windows: Float[Tensor, "batch samples"],
        features: Float[Tensor, "batch steps dim"],
        explicit: Float[Tensor, "batch emotions"],
        implicit: Float[Tensor, "batch implicit"],
    ) -> RegressionOutput:
        """States of a batch of frames.

        Parameters
        ----------
        windows : (B, 8320)
            Sound around each frame, 16 kHz.
        features : (B, 25, D)
            Speech features at `STEP_TIMES` around each frame.
        explicit : (B, E)
            Strengths of the explicit emotions, 0 to 1; zeros are neutral.
        implicit : (B, 16)
            Rows of `implicit`, or mixtures of them.

        Raises
        ------
        ShapeError
            If an input has another shape than the network's.
        """
        config = self.config
        if windows.shape[1:] != (WINDOW,) or features.shape[1:] != (STEPS, config.feature_dim):
            raise ShapeError(
                f"windows have shape {tuple(windows.shape)} and features {tuple(features.shape)}; expected "
                f"(batch, {WINDOW}) and (batch, {STEPS}, {config.feature_dim})"
            )
        heard = self.encoder(windows, features)
        if not config.emotions:
            explicit = implicit.new_zeros(len(implicit), 1)
        mood = torch.cat([implicit, self.emotion(explicit)], dim=1)
        x = heard
        for layer in self.time:
            x = functional.relu(layer(torch.cat([x, mood[:, :, None].expand(-1, -1, x.shape[2])], dim=1)))
        x = functional.relu(self.joint(torch.cat([x.flatten(1), mood], dim=1)))
        states = torch.cat([self.skin(x), self.rest(x)], dim=1)
        logits = {language: head(heard).mT for language, head in self.heads.items()}
        return RegressionOutput(self.state_mean + states * self.state_scale, logits)

    def implicit_of(
        self, emotion: str = "neutral", clip: str | None = None, frame: int | None = None
    ) -> Float[Tensor, " implicit"]:
        """An implicit emotion: of one training frame, or the mean of a clip, or of all clips of an emotion.

        Parameters
        ----------
        emotion : str
            Where no clip is named; the mean of all frames where no clip has it.
        clip : str, optional
            Name of a training clip.
        frame : int, optional
            Of the clip.

        Raises
        ------
        OptionError
            If there is no such clip or frame.
        """
        spans = self.config.spans
        rows = self.implicit.weight.detach()
        if clip is None:
            chosen = [span for span in spans if span.emotion == emotion] or list(spans)
            parts = [rows[span.first : span.first + span.count] for span in chosen]
            return torch.cat(parts).mean(0) if parts else rows.mean(0)
        found = next((span for span in spans if span.name == clip), None)
        if found is None:
            raise OptionError(
                f"no training clip {clip!r}; there are {', '.join(span.name for span in spans[:8])}"
            )
        if frame is not None and not 0 <= frame < found.count:
            raise OptionError(f"clip {clip} has frames 0 to {found.count - 1}, not {frame}")
        part = rows[found.first : found.first + found.count]
        return part.mean(0) if frame is None else part[frame]

    def deployed(self) -> "Audio2FaceRegression":
        """The network without phoneme heads, which only training needs (Sec. 4.1)."""
        lean = Audio2FaceRegression(replace(self.config, languages=()), self.actors)
        lean.load_state_dict({n: t for n, t in self.state_dict().items() if not n.startswith("heads.")})
        return lean.to(self.device).eval()
