"""The default speech encoder: phoneme and viseme posteriors from log-mel, trained on synthetic voices.

A temporal convolution net of 0.8 M parameters that runs on files and on streams with the same result,
50 frames a second, 100 ms of look-ahead.
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import torch
from jaxtyping import Float, Float32
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.nn import functional as F

from meshanim.audio.encoders import EncoderStream, MelStream, SpeechEncoder
from meshanim.audio.features import DEFAULT_MEL, RunningNormalization, log_mel, utterance_normalization
from meshanim.audio.phonemes import PHONEMES, VISEMES
from meshanim.audio.waveform import Waveform
from meshanim.errors import FileFormatError, OptionError
from meshanim.files import written_whole

__all__ = ["VisemeEncoder", "VisemeNet", "VisemeNetConfig", "load_viseme_net", "save_viseme_net"]

WEIGHTS = Path(__file__).parent / "weights" / "visemes.safetensors"
MEMORY = 300.0
"""Frames (10 ms) that running normalisation remembers."""


@dataclass(frozen=True)
class VisemeNetConfig:
    """Size of the net.

    Parameters
    ----------
    bands : int
        Log-mel bands of the input.
    width : int
        Channels.
    kernel : int
        Taps of the depthwise convolutions.
    dilations : tuple of int
        One residual block each.
    future : tuple of int
        Frames (20 ms) of right context of each block.
    dropout : float
        Within the blocks, while training.
    """

    bands: int = 80
    width: int = 160
    kernel: int = 5
    dilations: tuple[int, ...] = (1, 1, 2, 2, 4, 4, 8, 8)
    future: tuple[int, ...] = (2, 0, 0, 0, 0, 0, 0, 0)
    dropout: float = 0.1


class PaddedLayer(nn.Module):
    """A layer over time that needs `left` frames before and `right` frames after what it gives.

    Its forward takes the frames with their context and gives (length - left - right) / stride frames, so that
    files (context: zeros) and streams (context: what came before) run the same code.
    """

    left: int
    right: int
    stride: int = 1


class InputLayer(PaddedLayer):
    """Bands to channels, five frames of 10 ms, all of them ahead."""

    def __init__(self, config: VisemeNetConfig):
        super().__init__()
        self.left, self.right = 0, 4
        self.convolution = nn.Conv1d(config.bands, config.width, 5)

    def forward(self, padded: Float[Tensor, "batch bands padded"]) -> Float[Tensor, "batch width frames"]:
        return F.gelu(self.convolution(padded))


class HalvingLayer(PaddedLayer):
    """100 frames a second to 50."""

    def __init__(self, config: VisemeNetConfig):
        super().__init__()
        self.left, self.right, self.stride = 2, 1, 2
        self.convolution = nn.Conv1d(config.width, config.width, 4, stride=2)
        self.norm = nn.BatchNorm1d(config.width)

    def forward(self, padded: Float[Tensor, "batch width padded"]) -> Float[Tensor, "batch width frames"]:
        return F.gelu(self.norm(self.convolution(padded)))


class GatedBlock(PaddedLayer):
    """Residual block: dilated depthwise convolution, then a gated pointwise one."""

    def __init__(self, config: VisemeNetConfig, dilation: int, future: int):
        super().__init__()
        self.left, self.right = dilation * (config.kernel - 1) - future, future
        self.depthwise = nn.Conv1d(
            config.width, config.width, config.kernel, dilation=dilation, groups=config.width
        )
        self.norm = nn.BatchNorm1d(config.width)
        self.expand = nn.Conv1d(config.width, 2 * config.width, 1)
        self.reduce = nn.Conv1d(config.width, config.width, 1)
        self.dropout = nn.Dropout(config.dropout)

    def forward(self, padded: Float[Tensor, "batch width padded"]) -> Float[Tensor, "batch width frames"]:
        frames = padded[..., self.left : padded.shape[-1] - self.right]
        gate, value = self.expand(self.norm(self.depthwise(padded))).chunk(2, dim=1)
        return frames + self.dropout(self.reduce(torch.sigmoid(gate) * F.gelu(value)))


class VisemeNet(nn.Module):
    """Normalised log-mel to phoneme and viseme logits.

    Parameters
    ----------
    config : VisemeNetConfig
        Sizes.

    Attributes
    ----------
    prior_mean, prior_variance : (bands,) tensors
        Statistics of log-mel over the training speech; where running normalisation starts.
    """

    def __init__(self, config: VisemeNetConfig = VisemeNetConfig()):
        super().__init__()
        if len(config.dilations) != len(config.future):
            raise OptionError(
                f"{len(config.dilations)} dilations but {len(config.future)} contexts; expected one each"
            )
        self.config = config
        blocks = [GatedBlock(config, d, r) for d, r in zip(config.dilations, config.future)]
        self.layers = nn.ModuleList([InputLayer(config), HalvingLayer(config), *blocks])
        self.phonemes = nn.Conv1d(config.width, len(PHONEMES), 1)
        self.visemes = nn.Conv1d(config.width, len(VISEMES), 1)
        self.prior_mean: Tensor
        self.prior_variance: Tensor
        self.register_buffer("prior_mean", torch.full((config.bands,), -6.0))
        self.register_buffer("prior_variance", torch.full((config.bands,), 9.0))

    @property
    def stages(self) -> list[PaddedLayer]:
        """The layers in order."""
        return cast(list[PaddedLayer], list(self.layers))

    def hidden(self, mel: Float[Tensor, "batch bands mel_frames"]) -> Float[Tensor, "batch width frames"]:
        """Channels before the heads; frames = ceil(mel_frames / 2)."""
        hidden = mel
        for layer in self.stages:
            hidden = layer(F.pad(hidden, (layer.left, layer.right)))
        return hidden

    def heads(
        self, hidden: Float[Tensor, "batch width frames"]
    ) -> tuple[Float[Tensor, "batch phonemes frames"], Float[Tensor, "batch visemes frames"]]:
        """Logits of `PHONEMES` and of `VISEMES`."""
        return self.phonemes(hidden), self.visemes(hidden)

    def forward(
        self, mel: Float[Tensor, "batch bands mel_frames"]
    ) -> tuple[Float[Tensor, "batch phonemes frames"], Float[Tensor, "batch visemes frames"]]:
        """Logits of whole utterances of normalised log-mel."""
        return self.heads(self.hidden(mel))

    def running_normalization(self, weight: float) -> RunningNormalization:
        """Normalisation as the net was trained with, from a prior worth `weight` frames of 10 ms."""
        mean, variance = self.prior_mean.double().numpy(), self.prior_variance.double().numpy()
        return RunningNormalization(mean, variance, weight, MEMORY)


class HiddenStream:
    """The net's layers over a stream; each keeps the frames that its next outputs need."""

    def __init__(self, net: VisemeNet):
        self.net = net
        widths = [net.config.bands] + [net.config.width] * (len(net.stages) - 1)
        self.kept = [torch.zeros(1, w, layer.left) for w, layer in zip(widths, net.stages)]

    def push(
        self, mel: Float32[Tensor, "1 bands mel_frames"], last: bool = False
    ) -> Float32[Tensor, "1 width frames"]:
        """Channels of the frames that are complete; `last` ends the stream with zeros, as files end."""
        hidden = mel
        for k, layer in enumerate(self.net.stages):
            joined = torch.cat([self.kept[k], hidden], dim=-1)
            if last:
                joined = F.pad(joined, (0, layer.right))
            context = layer.left + layer.right
            count = max(0, joined.shape[-1] - context + layer.stride - 1) // layer.stride
            self.kept[k] = joined[..., count * layer.stride :]
            if count == 0:
                hidden = joined.new_zeros(1, self.net.config.width, 0)
            else:
                hidden = layer(joined[..., : (count - 1) * layer.stride + context + 1])
        return hidden


Outputs = Literal["posteriors", "logarithms", "hidden"]


class VisemeEncoder(SpeechEncoder):
    """Speech to posteriors of 40 phonemes and 13 visemes, 50 frames a second.

    Trained on synthetic voices; about two thirds of the frames are right on real ones (docs/speech.md).

    Parameters
    ----------
    net : VisemeNet, optional
        The packaged weights by default.
    outputs : {"posteriors", "logarithms", "hidden"}
        Probabilities of `PHONEMES` then of `VISEMES` (53), their logarithms, or the net's channels (160).
    normalization : {"running", "utterance"}
        Running normalisation looks only back: streams and files give the same frames. Utterance statistics
        are a little better on files, most of all in quiet or noisy ones, and cannot stream.
    prior : float
        Seconds that the prior of running normalisation is worth, 0.01 to 3.

    Attributes
    ----------
    bilabial : int or None
        Which feature is the probability of p, b or m; None where features are no probabilities.

    Raises
    ------
    OptionError
        If an option is none of these.
    """

    def __init__(
        self,
        net: VisemeNet | None = None,
        outputs: Outputs = "posteriors",
        normalization: Literal["running", "utterance"] = "running",
        prior: float = 0.5,
    ):
        if outputs not in ("posteriors", "logarithms", "hidden"):
            raise OptionError(f"outputs is {outputs!r}; expected posteriors, logarithms or hidden")
        if normalization not in ("running", "utterance"):
            raise OptionError(f"normalization is {normalization!r}; expected running or utterance")
        if not 0.01 <= prior <= 3:
            raise OptionError(f"prior is {prior} s; expected 0.01 to 3")
        self.net = (load_viseme_net() if net is None else net).eval()
        self.outputs = outputs
        self.normalization = normalization
        self.prior = prior
        self.name = "visemes:hidden" if outputs == "hidden" else "visemes"
        self.rate = DEFAULT_MEL.fps / 2
        self.dim = self.net.config.width if outputs == "hidden" else len(PHONEMES) + len(VISEMES)
        self.bilabial = len(PHONEMES) + VISEMES.index("bmp") if outputs == "posteriors" else None

    @torch.inference_mode()
    def __call__(self, waveform: Waveform) -> Float32[Tensor, "frames dim"]:
        mel = log_mel(waveform)
        if self.normalization == "utterance":
            mel = utterance_normalization(mel)
        else:
            normalize = self.net.running_normalization(self.prior * DEFAULT_MEL.fps)
            mel = torch.from_numpy(normalize(mel.numpy()))
        return self._read_out(self.net.hidden(mel.T[None]))

    def stream(self) -> "VisemeStream":
        """Start a stream: the frames of the whole, 100 ms late.

        Raises
        ------
        OptionError
            If normalisation needs the whole utterance.
        """
        if self.normalization != "running":
            raise OptionError(f"normalization {self.normalization} needs the whole utterance; choose running")
        return VisemeStream(self)

    def _read_out(self, hidden: Float32[Tensor, "1 width frames"]) -> Float32[Tensor, "frames dim"]:
        if hidden.shape[-1] == 0:
            return hidden.new_zeros(0, self.dim)
        if self.outputs == "hidden":
            return hidden[0].T.clone()
        transform = torch.softmax if self.outputs == "posteriors" else torch.log_softmax
        return torch.cat([transform(logits[0].T, dim=1) for logits in self.net.heads(hidden)], dim=1)


class VisemeStream(EncoderStream):
    """Mel, running normalisation and net, each with what it has to remember."""

    def __init__(self, encoder: VisemeEncoder):
        self.encoder = encoder
        self.mel = MelStream(DEFAULT_MEL)
        self.normalize = encoder.net.running_normalization(encoder.prior * DEFAULT_MEL.fps)
        self.layers = HiddenStream(encoder.net)

    @torch.inference_mode()
    def push(self, samples: Float32[np.ndarray, " samples"]) -> Float32[Tensor, "frames dim"]:
        return self._encode(self.mel.push(samples), last=False)

    @torch.inference_mode()
    def finish(self) -> Float32[Tensor, "frames dim"]:
        return self._encode(self.mel.finish(), last=True)

    def _encode(self, mel: Float32[Tensor, "mel_frames bands"], last: bool) -> Float32[Tensor, "frames dim"]:
        normal = torch.from_numpy(self.normalize(mel.numpy()))
        return self.encoder._read_out(self.layers.push(normal.T[None], last))


def save_viseme_net(net: VisemeNet, path: str | Path, training: dict | None = None) -> None:
    """Write weights (16-bit floats) as safetensors and the configuration beside them as json.

    Parameters
    ----------
    net : VisemeNet
        The net.
    path : str or Path
        Ends in .safetensors.
    training : dict, optional
        What made it, for the json file.

    Raises
    ------
    FileFormatError
        If the files cannot be written.
    """
    path = Path(path)
    tensors = {
        k: v.half().contiguous() for k, v in net.state_dict().items() if not k.endswith("num_batches_tracked")
    }
    with written_whole(path) as temporary:
        save_file(tensors, temporary)
    with written_whole(path.with_suffix(".json")) as temporary:
        temporary.write_text(
            json.dumps({"config": asdict(net.config), "training": training or {}}, indent=2) + "\n"
        )


def load_viseme_net(path: str | Path = WEIGHTS) -> VisemeNet:
    """Read what `save_viseme_net` wrote.

    Raises
    ------
    FileFormatError
        If a file is missing or damaged, or the weights do not fit the configuration.
    """
    path = Path(path)
    try:
        config: dict[str, Any] = json.loads(path.with_suffix(".json").read_text())["config"]
        sizes: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in config.items()}
        net = VisemeNet(VisemeNetConfig(**sizes))
        tensors = {k: v.float() for k, v in load_file(path).items()}
        missing, unexpected = net.load_state_dict(tensors, strict=False)
        lost = [k for k in missing if not k.endswith("num_batches_tracked")] + unexpected
        if lost:
            raise FileFormatError(
                f"{path} does not fit its configuration at {lost[0]}; expected a viseme net"
            )
    except (OSError, ValueError, KeyError, TypeError, RuntimeError, SafetensorError) as error:
        raise FileFormatError(
            f"{path} cannot be read as viseme net ({str(error).splitlines()[0]}); expected it and its .json"
        ) from error
    return net.eval()
