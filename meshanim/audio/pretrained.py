"""wav2vec 2.0 and HuBERT as frozen speech encoders, from a local folder or the Hugging Face hub."""

import math
from typing import Any

import torch
from jaxtyping import Float32
from torch import Tensor

from meshanim.audio.encoders import SpeechEncoder
from meshanim.audio.features import frame_count
from meshanim.audio.waveform import Waveform
from meshanim.errors import DependencyError, FileFormatError, OptionError

__all__ = ["TransformerEncoder"]

_CLASSES = {"wav2vec2": "Wav2Vec2Model", "hubert": "HubertModel"}


def _transformers() -> Any:
    try:
        import transformers
    except ImportError as error:
        raise DependencyError("transformers", "encoders") from error
    return transformers


class TransformerEncoder(SpeechEncoder):
    """Hidden states of a pretrained speech transformer (Baevski et al. 2020; Hsu et al. 2021), frozen.

    Nothing is shipped: weights come from a folder on disk or from the hub, under their own licence. Needs
    the whole utterance. Speech longer than `chunk` runs in overlapping windows, so that cost grows with
    length and not with its square.

    Parameters
    ----------
    kind : {"wav2vec2", "hubert"}
        Model family; the checkpoint has to be of it.
    path : str
        Folder with config.json and weights, or a hub id such as "facebook/wav2vec2-base-960h".
    layer : int
        Hidden state: 0 is the input of the first transformer layer, -1 the last output.
    rate : float
        Feature frames a second; hidden states are interpolated linearly to the times (k + 0.5) / rate. Their
        own rate is 50.
    chunk : float
        Seconds of a window; a fifth of it on either side is context.

    Raises
    ------
    DependencyError
        If transformers is not installed (extra `encoders`).
    FileFormatError
        If the checkpoint cannot be read or downloaded.
    OptionError
        If the checkpoint is of another kind, or layer, rate or chunk is out of range.
    """

    def __init__(self, kind: str, path: str, layer: int = -1, rate: float = 50.0, chunk: float = 20.0):
        if kind not in _CLASSES:
            raise OptionError(f"no kind {kind!r} of transformer; expected {' or '.join(_CLASSES)}")
        if not (rate > 0 and chunk >= 1):
            raise OptionError(
                f"rate is {rate} and chunk {chunk} s; expected rate above 0 and chunk of 1 s or more"
            )
        transformers = _transformers()
        try:
            config = transformers.AutoConfig.from_pretrained(path)
            if config.model_type != kind:
                raise OptionError(f"{path} is a {config.model_type}; load it as {config.model_type}:{path}")
            model = getattr(transformers, _CLASSES[kind]).from_pretrained(path)
        except (OSError, ValueError, KeyError) as error:
            raise FileFormatError(
                f"{kind} weights {path} cannot be loaded ({str(error).splitlines()[0]}); "
                "expected a folder with config.json and model.safetensors, or a hub id"
            ) from error
        layers = config.num_hidden_layers
        if not -layers - 1 <= layer <= layers:
            raise OptionError(f"layer is {layer}; {path} has hidden states 0 to {layers}, or -1 for the last")
        try:
            extractor = transformers.Wav2Vec2FeatureExtractor.from_pretrained(path)
        except OSError:  # no preprocessor_config.json beside the weights: the published models' setting
            extractor = transformers.Wav2Vec2FeatureExtractor(do_normalize=True)
        self.normalize = bool(extractor.do_normalize)
        self.model = model.eval().requires_grad_(False)
        self.layer = layer % (layers + 1)
        self.chunk = chunk
        self.name = f"{kind}:{path}"
        self.dim = config.hidden_size
        self.rate = rate
        self.stride = math.prod(config.conv_stride)
        self.receptive = 1
        for kernel, stride in zip(reversed(config.conv_kernel), reversed(config.conv_stride)):
            self.receptive = (self.receptive - 1) * stride + kernel

    @torch.inference_mode()
    def __call__(self, waveform: Waveform) -> Float32[Tensor, "frames dim"]:
        waveform = waveform.resampled(self.sample_rate)
        count = frame_count(waveform, self.rate)
        samples = torch.from_numpy(waveform.samples.copy())
        if self.normalize:
            samples = (samples - samples.mean()) / torch.sqrt(samples.var(unbiased=False) + 1e-7)
        if len(samples) < self.receptive:
            samples = torch.nn.functional.pad(samples, (0, self.receptive - len(samples)))
        states = self._hidden_states(samples)
        return self._at_frames(states, count)

    def frames_of_states(self, samples: int) -> Float32[Tensor, "frames states"]:
        """The matrix that makes the frames of so many samples, heard at once, of their hidden states."""
        states = (max(samples, self.receptive) - self.receptive) // self.stride + 1
        count = max(1, math.ceil(samples * self.rate / self.sample_rate - 1e-9))
        return self._at_frames(torch.eye(states), count)

    def _at_frames(self, states: Float32[Tensor, "states dim"], count: int) -> Float32[Tensor, "frames dim"]:
        """States at the frames' middles, linearly interpolated."""
        times = (torch.arange(count, dtype=torch.float64) + 0.5) / self.rate * self.sample_rate
        position = ((times - self.receptive / 2) / self.stride).clamp(0, len(states) - 1)
        lower = position.floor().long()
        upper = (lower + 1).clamp(max=len(states) - 1)
        weight = (position - lower).float()[:, None]
        return states[lower] * (1 - weight) + states[upper] * weight

    def _hidden_states(self, samples: Float32[Tensor, " samples"]) -> Float32[Tensor, "states dim"]:
        """States of the whole; state k sees samples from k * stride to k * stride + receptive."""
        total = (len(samples) - self.receptive) // self.stride + 1
        size = max(1, int(self.chunk * self.sample_rate) // self.stride)
        context = size // 5
        if total <= size:
            return self._run(samples)
        parts = []
        for start in range(0, total, size - 2 * context):
            first, last = max(0, start - context), min(total, start - context + size)
            states = self._run(samples[first * self.stride : (last - 1) * self.stride + self.receptive])
            end = min(total, start + size - 2 * context)
            parts.append(states[start - first : end - first])
        return torch.cat(parts)

    def _run(self, samples: Float32[Tensor, " samples"]) -> Float32[Tensor, "states dim"]:
        return self.model(samples[None], output_hidden_states=True).hidden_states[self.layer][0]
