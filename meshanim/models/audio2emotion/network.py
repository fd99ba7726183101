"""The classifier: features of a stretch of speech, and of a neutral one of the same voice, to logits."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from meshanim.errors import OptionError
from meshanim.models.checkpoint import Checkpoint
from meshanim.motion.emotions import HEARD_EMOTIONS

__all__ = ["Audio2Emotion", "Audio2EmotionConfig"]


@dataclass(frozen=True)
class Audio2EmotionConfig:
    """Sizes, and how sound becomes features.

    Parameters
    ----------
    feature_dim : int
        Numbers a frame: those of the encoder, and three of the voice where `prosody` is on.
    encoder : str
        As `load_encoder` takes it; frozen.
    prosody : bool
        Whether pitch, voicing and loudness stand beside the encoder's features.
    width : int
        Channels.
    dropout : float
    crop : float
        Seconds that are classified at once: the paper's sub-window.
    reference : float
        Seconds of neutral speech that stand before it, where there are some.
    silence : float
        Seconds between the two.
    """

    feature_dim: int
    encoder: str = "visemes:hidden"
    prosody: bool = True
    width: int = 96
    dropout: float = 0.3
    crop: float = 0.625
    reference: float = 2.0
    silence: float = 2.0

    def __post_init__(self):
        if self.feature_dim < 1 or self.width < 1 or not 0 <= self.dropout < 1:
            raise OptionError("feature_dim and width must be positive, dropout within 0 to 1")
        if not (self.crop > 0 and self.reference > 0 and self.silence >= 0):
            raise OptionError("crop and reference must be seconds above 0, silence not negative")


class Audio2Emotion(Checkpoint):
    """Frozen features, two convolutions over time, attentive statistics pooling, two linear layers.

    The paper trains wav2vec 2.0's transformer with the classifier; here the encoder stays as it is.

    Parameters
    ----------
    config : Audio2EmotionConfig
    """

    title = "Audio2Emotion"

    def __init__(self, config: Audio2EmotionConfig):
        super().__init__()
        self.config = config
        dim, width = config.feature_dim, config.width
        self.feature_mean: Tensor
        self.feature_scale: Tensor
        self.register_buffer("feature_mean", torch.zeros(dim))
        self.register_buffer("feature_scale", torch.ones(dim))
        self.frames = nn.Sequential(
            nn.Conv1d(dim, width, 3, padding=1),
            nn.GELU(),
            nn.Dropout(config.dropout),
            nn.Conv1d(width, width, 3, padding=1),
            nn.GELU(),
        )
        self.attention = nn.Conv1d(width, 1, 1)
        self.classify = nn.Sequential(
            nn.Dropout(config.dropout),
            nn.Linear(4 * width + 1, width),
            nn.GELU(),
            nn.Dropout(config.dropout),
            nn.Linear(width, len(HEARD_EMOTIONS)),
        )

    def _pooled(self, features: Float[Tensor, "batch steps dim"]) -> Float[Tensor, "batch pooled"]:
        """Mean and deviation over time, frames weighted by attention."""
        channels = self.frames(((features - self.feature_mean) / self.feature_scale).mT)
        weight = self.attention(channels).softmax(2)
        mean = (weight * channels).sum(2)
        variance = (weight * (channels - mean[:, :, None]).square()).sum(2)
        return torch.cat([mean, (variance + 1e-6).sqrt()], 1)

    def forward(
        self,
        features: Float[Tensor, "batch steps dim"],
        reference: Float[Tensor, "batch reference_steps dim"] | None = None,
        known: Float[Tensor, " batch"] | None = None,
    ) -> Float[Tensor, "batch classes"]:
        """Logits of `HEARD_EMOTIONS`.

        Parameters
        ----------
        features : (B, steps, dim)
            Of the stretch that is classified.
        reference : (B, steps, dim), optional
            Of neutral speech of the same voices.
        known : (B,), optional
            1 where the reference counts, 0 where there is none.
        """
        heard = self._pooled(features)
        if reference is None:
            change, flag = torch.zeros_like(heard), heard.new_zeros(len(heard), 1)
        else:
            flag = heard.new_ones(len(heard), 1) if known is None else known[:, None]
            change = flag * (heard - self._pooled(reference))
        return self.classify(torch.cat([heard, change, flag], 1))
