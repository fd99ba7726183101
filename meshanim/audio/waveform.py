"""`Waveform`: mono samples and their rate; reading and writing sound files."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import soundfile
import soxr

from meshanim.errors import FileFormatError, OptionError, ShapeError
from meshanim.files import written_whole

__all__ = ["FULL_SCALE", "Waveform", "load_waveform", "save_waveform"]

FULL_SCALE = 32768
"""Steps of a 16-bit sample to amplitude 1."""

CONTAINERS = (".m4a", ".mp4")
SLOWEST = 4000
"""Samples a second of a file below which nothing of speech is left."""
CUT = re.compile(r"(?:data|SSND) : (\d+) \(should be (\d+)\)")
"""Where libsndfile says how many bytes of sound a wav or aiff announces, and how many there are."""
STREAMED = 0x7FFF0000
"""A length above this was written by a program that could not know it."""


@dataclass(frozen=True)
class Waveform:
    """Mono speech.

    Parameters
    ----------
    samples : (T,) float32
        Amplitudes, full scale is 1. Any float or integer array is converted to float32 unscaled.
    rate : int
        Samples a second, Hz.

    Raises
    ------
    ShapeError
        If the samples are not one row of finite numbers, or none at all, or the rate is not positive.
    """

    samples: np.ndarray
    rate: int

    def __post_init__(self):
        samples = np.ascontiguousarray(self.samples, dtype=np.float32)
        if samples.ndim != 1 or len(samples) == 0:
            raise ShapeError(
                f"samples have shape {samples.shape}; expected (T,) with T > 0: mix to mono first"
            )
        if not np.isfinite(samples).all():
            first = int(np.argmin(np.isfinite(samples)))
            raise ShapeError(
                f"sample {first} is {samples[first]}; expected finite numbers: repair the recording"
            )
        if self.rate <= 0:
            raise ShapeError(f"rate is {self.rate}; expected samples a second above 0")
        object.__setattr__(self, "samples", samples)

    @property
    def duration(self) -> float:
        """Seconds."""
        return len(self.samples) / self.rate

    def resampled(self, rate: int) -> "Waveform":
        """The same sound at another rate, band-limited (soxr, high quality).

        Parameters
        ----------
        rate : int
            Samples a second, Hz.

        Raises
        ------
        OptionError
            If the rate is not positive.
        """
        if rate <= 0:
            raise OptionError(f"rate is {rate}; expected samples a second above 0")
        if rate == self.rate:
            return self
        samples = soxr.resample(self.samples, self.rate, rate, quality="HQ")
        return Waveform(samples if len(samples) else np.zeros(1, np.float32), rate)

    def levelled(self, peak: float = 0.7) -> "Waveform":
        """The same sound scaled so that its largest amplitude is `peak`; silence stays as it is."""
        largest = float(np.abs(self.samples).max())
        return self if largest == 0 else Waveform(self.samples * np.float32(peak / largest), self.rate)


def load_waveform(path: str | Path, rate: int | None = 16000) -> Waveform:
    """Read a sound file, mix its channels to one by their mean and resample it.

    Parameters
    ----------
    path : str or Path
        Any format libsndfile reads: wav, flac, ogg, opus, mp3, aiff, ...; .m4a and .mp4 by FFmpeg (PyAV).
    rate : int, optional
        Samples a second of the result; None keeps the file's.

    Raises
    ------
    FileFormatError
        If the file is missing or not a sound file.
    ShapeError
        If it holds no samples, or samples that are not finite.
    OptionError
        If the rate is not positive.
    """
    path = Path(path)
    if not path.is_file():
        raise FileFormatError(
            f"{path} is not a file; expected a sound file (wav, flac, ogg, mp3): check the path"
        )
    try:
        if path.suffix.lower() in CONTAINERS:
            samples, file_rate = _decode(path)
        else:
            samples, file_rate = _read(path)
    except (soundfile.LibsndfileError, OSError) as error:
        reason = str(getattr(error, "error_string", error)).strip().rstrip(".")
        raise FileFormatError(
            f"{path} cannot be read as sound ({reason}); expected wav, flac, ogg or mp3: convert it first"
        ) from error
    if len(samples) == 0:
        raise ShapeError(f"{path} holds no samples; expected at least one: record it again")
    if file_rate < SLOWEST:
        raise FileFormatError(
            f"{path} has {file_rate} samples a second; expected at least {SLOWEST}: is that its true rate?"
        )
    try:
        waveform = Waveform(samples.mean(axis=1), int(file_rate))
    except ShapeError as error:
        raise ShapeError(f"{path}: {error}") from error
    return waveform if rate is None else waveform.resampled(rate)


def _read(path: Path) -> tuple[np.ndarray, int]:
    """Samples (T, channels) and rate; OSError if the file ends before its sound does."""
    with soundfile.SoundFile(path) as file:
        cut = CUT.search(file.extra_info)
        if cut is not None:
            announced, there = map(int, cut.groups())
            # Some writers count a padding byte.
            if there + 1 < announced < STREAMED:
                raise OSError(f"it is cut short: {there} of {announced} bytes of sound")
        return file.read(dtype="float32", always_2d=True), file.samplerate


def _decode(path: Path) -> tuple[np.ndarray, int]:
    """Samples (T, channels) and rate of the first sound of a container; OSError if there is none."""
    import av

    try:
        with av.open(str(path)) as file:
            if not file.streams.audio:
                raise OSError("it has no sound")
            stream = file.streams.audio[0]
            resampler = av.AudioResampler(format="fltp")
            blocks = [
                block.to_ndarray()
                for frame in (*file.decode(stream), None)
                for block in resampler.resample(frame)
            ]
            rate = stream.rate
    except av.FFmpegError as error:
        raise OSError(error.strerror) from error
    samples = np.concatenate(blocks, axis=1) if blocks else np.zeros((1, 0), np.float32)
    return samples.T, int(rate)


def save_waveform(waveform: Waveform, path: str | Path, lossless: bool = False) -> None:
    """Write 16-bit PCM (wav or flac by the ending); amplitudes beyond full scale are clipped.

    Parameters
    ----------
    waveform : Waveform
        What to write. Samples that came from a 16-bit file are written as they were.
    path : str or Path
        Ends in .wav or .flac.
    lossless : bool
        Write 32-bit floats (wav alone) where 16 bits do not hold the samples exactly.

    Raises
    ------
    FileFormatError
        If the ending is no format of libsndfile or the folder cannot be written to.
    """
    path = Path(path)
    if path.suffix[1:].upper() not in soundfile.available_formats():
        raise FileFormatError(f"{path} ends in {path.suffix or 'nothing'!r}; expected .wav or .flac")
    steps = np.clip(np.rint(waveform.samples.astype(np.float64) * FULL_SCALE), -FULL_SCALE, FULL_SCALE - 1)
    exact = not lossless or np.array_equal(steps, waveform.samples.astype(np.float64) * FULL_SCALE)
    with written_whole(path) as temporary:
        if exact:
            soundfile.write(temporary, steps.astype(np.int16), waveform.rate, subtype="PCM_16")
        else:
            soundfile.write(temporary, waveform.samples, waveform.rate, subtype="FLOAT")
