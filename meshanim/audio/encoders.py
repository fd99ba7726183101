"""One interface for what turns speech into features, with and without weights, for files and for streams."""

from abc import ABC, abstractmethod
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from meshanim.audio.features import DEFAULT_MEL, MelConfig, log_mel, mel_filters, power_frames
from meshanim.audio.waveform import Waveform
from meshanim.errors import FileFormatError, OptionError, ShapeError

__all__ = ["EncoderStream", "FileFeatures", "MelEncoder", "SpeechEncoder", "load_encoder"]


class EncoderStream(ABC):
    """Features of speech that is still being spoken.

    Blocks of any length go in; the frames that are certain come out. All frames of all calls, one after the
    other, are the features of the whole.
    """

    @abstractmethod
    def push(self, samples: Float32[np.ndarray, " samples"]) -> Float32[Tensor, "frames dim"]:
        """Take the next samples (at the encoder's sample rate) and give the frames they complete."""

    @abstractmethod
    def finish(self) -> Float32[Tensor, "frames dim"]:
        """End the speech and give the last frames."""


class SpeechEncoder(ABC):
    """Speech to features; frame k describes time (k + 0.5) / rate.

    Attributes
    ----------
    name : str
        What `load_encoder` was given.
    dim : int
        Features a frame.
    rate : float
        Feature frames a second.
    sample_rate : int
        Samples a second that streams expect; whole waveforms are resampled.
    """

    name: str
    dim: int
    rate: float
    sample_rate: int = 16000

    @abstractmethod
    def __call__(self, waveform: Waveform) -> Float32[Tensor, "frames dim"]:
        """Features of a whole waveform."""

    def stream(self) -> EncoderStream:
        """Start a stream.

        Raises
        ------
        OptionError
            If the encoder needs the whole utterance.
        """
        raise OptionError(f"encoder {self.name} needs the whole utterance; choose visemes or mel to stream")


class MelStream(EncoderStream):
    """Log-mel of a stream: the samples that later windows still need are kept."""

    def __init__(self, config: MelConfig):
        self.config = config
        self.kept = torch.zeros(config.margin)
        self.received = 0
        self.given = 0
        self.ended = False

    def push(self, samples: Float32[np.ndarray, " samples"]) -> Float32[Tensor, "frames dim"]:
        if self.ended:
            raise OptionError("the stream is finished; start another with stream()")
        if not np.isfinite(samples).all():
            raise ShapeError("a block holds NaN or infinity; expected finite samples")
        self.received += len(samples)
        return self._frames(torch.from_numpy(np.asarray(samples, np.float32)))

    def finish(self) -> Float32[Tensor, "frames dim"]:
        if self.ended:
            raise OptionError("the stream is finished; start another with stream()")
        if self.received == 0:
            raise ShapeError("the stream got no samples; expected at least one before finish()")
        self.ended = True
        config = self.config
        missing = -(-self.received // config.hop) - self.given
        after = (missing - 1) * config.hop + config.window - len(self.kept)
        return self._frames(torch.zeros(max(0, after)))

    def _frames(self, samples: Float32[Tensor, " samples"]) -> Float32[Tensor, "frames dim"]:
        config = self.config
        self.kept = torch.cat([self.kept, samples])
        count = max(0, (len(self.kept) - config.window) // config.hop + 1)
        self.given += count
        if count == 0:
            return torch.zeros(0, config.bands)
        used = self.kept[: (count - 1) * config.hop + config.window]
        self.kept = self.kept[count * config.hop :]
        return torch.log(power_frames(used, config) @ mel_filters(config) + config.floor)


class MelEncoder(SpeechEncoder):
    """80 log-mel bands at 100 frames a second, without weights; streams with 7.5 ms of look-ahead.

    Parameters
    ----------
    config : MelConfig
        Window, bands, range.
    """

    def __init__(self, config: MelConfig = DEFAULT_MEL):
        self.config = config
        self.name = "mel"
        self.dim = config.bands
        self.rate = config.fps
        self.sample_rate = config.rate

    def __call__(self, waveform: Waveform) -> Float32[Tensor, "frames dim"]:
        return log_mel(waveform, self.config)

    def stream(self) -> MelStream:
        return MelStream(self.config)


class FileFeatures(SpeechEncoder):
    """Precomputed features: VOCA's DeepSpeech windows (frames, 16, 29) load as they are.

    Parameters
    ----------
    path : str or Path
        A .npy file, (frames, dim) or (frames, width, dim).
    rate : float
        Frames a second of the array: 60 for VOCA.

    Raises
    ------
    FileFormatError
        If the file is missing or no plain array.
    ShapeError
        If it has another number of axes, no frames, or numbers that are not finite.
    """

    def __init__(self, path: str | Path, rate: float = 60.0):
        try:
            array = np.load(path, allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise FileFormatError(
                f"{path} cannot be read ({error}); expected a .npy array of features"
            ) from error
        if not isinstance(array, np.ndarray) or array.ndim not in (2, 3) or 0 in array.shape:
            shape = getattr(array, "shape", "of an archive")
            raise ShapeError(f"{path} has shape {shape}; expected (frames, dim) or (frames, width, dim)")
        if not np.isfinite(array).all():
            raise ShapeError(f"{path} holds NaN or infinity; expected finite features: compute them again")
        if not rate > 0:
            raise OptionError(f"rate is {rate}; expected frames a second above 0")
        self.name = f"features:{path}"
        self.array = torch.from_numpy(array.astype(np.float32))
        self.dim = array.shape[-1]
        self.rate = rate

    @property
    def windows(self) -> Float32[Tensor, "frames width dim"]:
        """The windows as they are; a file of single frames has width 1."""
        return self.array if self.array.ndim == 3 else self.array[:, None]

    def __call__(self, waveform: Waveform | None = None) -> Float32[Tensor, "frames dim"]:
        """The middle of each window (entry width // 2), or the frames; the waveform is not used."""
        windows = self.windows
        return windows[:, windows.shape[1] // 2]


def load_encoder(name: str = "visemes") -> SpeechEncoder:
    """The speech encoder of a name.

    Parameters
    ----------
    name : str
        "visemes" (the default, trained, streams), "visemes:hidden" (the channels before its posteriors),
        "mel" (no weights, streams), "phones" (pocketsphinx, extra `speech`), "visemes+phones" (both, files
        only), "wav2vec2:PATH" or "hubert:PATH" (a local folder or a hub id, extra `encoders`;
        "wav2vec2:PATH@6" takes hidden layer 6), "features:FILE" or "features:FILE@RATE" (a .npy file).

    Raises
    ------
    OptionError
        If there is no such encoder.
    FileFormatError
        If its file cannot be read.
    DependencyError
        If it needs an extra that is not installed.
    """
    kind, _, path = name.partition(":")
    if kind == "mel" and not path:
        return MelEncoder()
    if name in ("visemes", "visemes:hidden"):
        from meshanim.audio.visemes import VisemeEncoder

        return VisemeEncoder(outputs="hidden" if path else "posteriors")
    if name in ("phones", "visemes+phones"):
        from meshanim.audio.phones import FusedEncoder, PhoneEncoder

        return PhoneEncoder() if name == "phones" else FusedEncoder()
    if kind in ("wav2vec2", "hubert") and path:
        from meshanim.audio.pretrained import TransformerEncoder

        source, at, layer = path.rpartition("@")
        if not at:
            return TransformerEncoder(kind, path)
        try:
            return TransformerEncoder(kind, source, int(layer))
        except ValueError as error:
            raise OptionError(f"{name}: {layer!r} is not a layer; expected {kind}:PATH@LAYER") from error
    if kind == "features" and path:
        file, at, rate = path.rpartition("@")
        try:
            return FileFeatures(file, float(rate)) if at else FileFeatures(path)
        except ValueError as error:
            raise OptionError(f"{name}: {rate!r} is not a frame rate; expected features:FILE@RATE") from error
    raise OptionError(
        f"no encoder {name!r}; expected visemes, mel, phones, visemes+phones, wav2vec2:PATH, hubert:PATH "
        "or features:FILE"
    )
