"""SyncNet on mouth landmarks: do these lips belong to this sound, and which comes first?

Two encoders give unit vectors for 0.2 s of lip motion and of speech; those of one moment are near each other,
those of different moments are not (Chung and Zisserman 2016, "Out of time"; on 3D landmarks as in GeneFace).
Audio2Face-3D's benchmark scores lip sync with one (Sec. 7).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from huggingface_hub import ModelCard
from jaxtyping import Float, Float64
from torch import Tensor, nn
from torch.nn import functional

from meshanim.errors import OptionError, ShapeError
from meshanim.models.audio2face.speech import features_at
from meshanim.models.checkpoint import Checkpoint
from meshanim.motion.face_parts import FaceParts

__all__ = [
    "MOMENT",
    "RATE",
    "SyncConfig",
    "SyncNet",
    "SyncScore",
    "mouth_landmarks",
    "mouth_moments",
    "speech_moments",
]

RATE = 25.0
"""Lip frames a second that the network sees, whatever the animation's rate."""
MOMENT = 5
"""Lip frames of a moment: 0.2 s, as published."""


@dataclass(frozen=True)
class SyncConfig:
    """What a SyncNet is made of.

    Parameters
    ----------
    feature_dim, feature_rate : int, float
        Of the speech encoder, and steps a second.
    encoder : str
        Name for `load_encoder`.
    landmarks : sequence of int
        Vertices of the mouth on the mesh that it was trained on; another mesh gives as many of its own.
    head : str
        Name of that mesh's head, empty if it has none.
    width : int
        Channels of both encoders and numbers of the vectors.
    """

    feature_dim: int
    feature_rate: float
    encoder: str
    landmarks: Sequence[int]
    head: str = ""
    width: int = 128

    def __post_init__(self):
        object.__setattr__(self, "landmarks", tuple(int(vertex) for vertex in self.landmarks))
        if min(self.feature_dim, self.width) < 1 or not self.feature_rate > 0 or len(self.landmarks) < 2:
            raise OptionError("a SyncNet needs features, a width, a feature rate and at least two landmarks")

    @property
    def steps(self) -> int:
        """Feature steps of a moment."""
        return max(1, round(MOMENT / RATE * self.feature_rate))


class SyncScore(NamedTuple):
    """How well lips fit speech.

    Parameters
    ----------
    distance : float
        Mean distance of the vectors of the same moment, 0 to 2; lower fits better (LSE-D).
    confidence : float
        Median over shifts of the mean distance, less the smallest; higher fits better (LSE-C).
    offset : float
        Seconds by which the lips come after the sound, where the distance is smallest.
    """

    distance: float
    confidence: float
    offset: float


def mouth_landmarks(parts: FaceParts) -> tuple[int, ...]:
    """Twenty vertices of the lips: margins and outer borders of both at five places across the mouth.

    Raises
    ------
    OptionError
        If the face has no lip pairs.
    """
    if not min(len(parts.lip_pairs), len(parts.upper_lip), len(parts.lower_lip)):
        raise OptionError(
            "this mesh has no known lips: SyncNet needs a head that has, or parts that name them"
        )
    rows = (parts.lip_pairs[:, 0], parts.lip_pairs[:, 1], parts.upper_lip[:, 0], parts.lower_lip[:, 1])
    return tuple(int(vertex) for row in rows for vertex in row)


def mouth_moments(
    mouth: Float[Tensor, "frames landmarks 3"],
    neutral: Float[Tensor, "landmarks 3"],
    fps: float,
    times: Float64[Tensor, " moments"],
) -> Float[Tensor, "moments 5 numbers"]:
    """Lip motion around moments: displacement from the neutral mouth in units of its width, at `RATE`.

    Parameters
    ----------
    mouth : (T, L, 3)
        Landmarks in zero pose; frame i is at (i + 0.5) / fps.
    neutral : (L, 3)
        The subject at rest, the same unit.
    fps : float
        Frames a second.
    times : (N,)
        Middles of the moments, seconds.

    Returns
    -------
    (N, 5, 3 L)
    """
    span = (neutral[:, None] - neutral[None]).norm(dim=-1).amax()
    moved = ((mouth - neutral) / span).flatten(1)
    around = (torch.arange(MOMENT, dtype=torch.float64) - (MOMENT - 1) / 2) / RATE
    return features_at(moved, fps, times[:, None] + around)


def _encoder(channels: int, width: int, length: int) -> nn.Sequential:
    """Two convolutions over time, then everything at once."""
    return nn.Sequential(
        nn.Conv1d(channels, width, 3, padding=1),
        nn.GELU(),
        nn.Conv1d(width, width, 3, padding=1),
        nn.GELU(),
        nn.Flatten(),
        nn.Linear(width * length, 2 * width),
        nn.GELU(),
        nn.Linear(2 * width, width),
    )


class SyncNet(Checkpoint):
    """Unit vectors of lip motion and of speech.

    Parameters
    ----------
    config : SyncConfig
        Sizes, encoder and landmarks.
    """

    title = "SyncNet"
    feature_mean: Tensor
    feature_scale: Tensor
    mouth_mean: Tensor
    mouth_scale: Tensor

    def __init__(self, config: SyncConfig):
        super().__init__()
        self.config = config
        numbers = 3 * len(config.landmarks)
        self.mouth = _encoder(numbers, config.width, MOMENT)
        self.speech = _encoder(config.feature_dim, config.width, config.steps)
        self.log_sharpness = nn.Parameter(torch.tensor(2.0))
        for name, size in (("feature", config.feature_dim), ("mouth", numbers)):
            self.register_buffer(f"{name}_mean", torch.zeros(size))
            self.register_buffer(f"{name}_scale", torch.ones(size))

    def see(self, moments: Float[Tensor, "batch 5 numbers"]) -> Float[Tensor, "batch width"]:
        """Unit vectors of lip motion, as `mouth_moments` gives it."""
        scaled = (moments - self.mouth_mean) / self.mouth_scale
        return functional.normalize(self.mouth(scaled.mT), dim=-1)

    def hear(self, features: Float[Tensor, "batch window dim"]) -> Float[Tensor, "batch width"]:
        """Unit vectors of speech features, `config.steps` around each moment."""
        scaled = (features - self.feature_mean) / self.feature_scale
        return functional.normalize(self.speech(scaled.mT), dim=-1)

    def forward(
        self, moments: Float[Tensor, "seen 5 numbers"], features: Float[Tensor, "heard window dim"]
    ) -> Float[Tensor, "seen heard"]:
        """Likeness of each lip motion to each piece of speech: cosines times a learned sharpness."""
        return self.log_sharpness.exp() * self.see(moments) @ self.hear(features).mT

    @torch.inference_mode()
    def distances(
        self,
        mouth: Float[Tensor, "frames landmarks 3"],
        neutral: Float[Tensor, "landmarks 3"],
        fps: float,
        features: Float[Tensor, "steps dim"],
        reach: int = 15,
    ) -> Float[Tensor, " shifts"]:
        """Mean distance of lips and speech for every shift from -reach to reach frames of 1 / 25 s.

        At shift k, lips are compared with what was said k frames before.

        Parameters
        ----------
        mouth : (T, L, 3)
            Landmarks, zero pose.
        neutral : (L, 3)
            The subject at rest.
        fps : float
            Of `mouth`.
        features : (steps, dim)
            Of the whole sound, from the encoder of `config`.
        reach : int
            Largest shift.

        Raises
        ------
        ShapeError
            If sizes differ from the config's, the clip is shorter than all shifts need, or holds NaN.
        """
        config = self.config
        if mouth.shape[1:] != (len(config.landmarks), 3) or neutral.shape != mouth.shape[1:]:
            raise ShapeError(
                f"mouth has shape {tuple(mouth.shape)} and its neutral {tuple(neutral.shape)}; expected "
                f"(T, {len(config.landmarks)}, 3)"
            )
        if features.ndim != 2 or features.shape[1] != config.feature_dim:
            raise ShapeError(
                f"features have shape {tuple(features.shape)}; expected (steps, {config.feature_dim})"
            )
        if not (torch.isfinite(mouth).all() and torch.isfinite(features).all()):
            raise ShapeError("mouth or speech features hold NaN or infinite values")
        seconds = min(len(mouth) / fps, len(features) / config.feature_rate)
        count = int(seconds * RATE)
        if count <= reach:
            raise ShapeError(f"{seconds:.2f} s are too short for shifts of {reach / RATE:.2f} s")
        times = (torch.arange(count, dtype=torch.float64) + 0.5) / RATE
        seen = self.see(mouth_moments(mouth.float(), neutral.float(), fps, times).to(self.device))
        heard = self.hear(speech_moments(features.float(), config, times).to(self.device))
        apart = torch.cdist(seen, heard)
        return torch.stack([apart.diagonal(-shift).mean() for shift in range(-reach, reach + 1)]).cpu()

    def score(
        self,
        mouth: Float[Tensor, "frames landmarks 3"],
        neutral: Float[Tensor, "landmarks 3"],
        fps: float,
        features: Float[Tensor, "steps dim"],
        reach: int = 15,
    ) -> SyncScore:
        """Sync of a sequence, from `distances`."""
        curve = self.distances(mouth, neutral, fps, features, reach)
        least = int(curve.argmin())
        return SyncScore(float(curve[reach]), float(curve.median() - curve[least]), (least - reach) / RATE)

    def generate_model_card(self, *args, **kwargs) -> ModelCard:
        """README.md of a saved folder."""
        return ModelCard(
            "---\nlibrary_name: meshanim\ntags: [talking-head, lip-sync]\n---\n\n"
            "# SyncNet on mouth landmarks\n\n"
            f"Speech encoder `{self.config.encoder}`, {len(self.config.landmarks)} landmarks. Read by\n"
            "`meshanim evaluate a2f --syncnet FOLDER`.\n"
        )


def speech_moments(
    features: Float[Tensor, "steps dim"], config: SyncConfig, times: Float64[Tensor, " moments"]
) -> Float[Tensor, "moments window dim"]:
    """Feature steps around moments, the ends held."""
    around = (torch.arange(config.steps, dtype=torch.float64) - (config.steps - 1) / 2) / config.feature_rate
    return features_at(features, config.feature_rate, times[:, None] + around)
