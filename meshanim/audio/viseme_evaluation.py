"""How often the phonemes and visemes of recorded speech are found: `meshanim evaluate visemes`."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from jaxtyping import Float32, Int64
from scipy.signal import butter, fftconvolve, sosfilt
from tqdm import tqdm

from meshanim.audio.phonemes import PHONEMES, VISEME_OF_PHONEME, VISEMES, Phoneme, align, phoneme_frames
from meshanim.audio.waveform import Waveform, load_waveform
from meshanim.errors import FileFormatError, OptionError
from meshanim.results import Results

__all__ = [
    "Clip",
    "EvaluateVisemesOptions",
    "degraded",
    "evaluate",
    "evaluate_visemes",
    "load_clips",
    "scores",
]

RATE = 50.0
"""Frames a second that are judged."""
CONDITIONS = ("clean", "noise20", "noise10", "telephone", "room", "quiet")
Labels = Int64[np.ndarray, " _"]
Posteriors = Callable[
    [Waveform], tuple[Float32[np.ndarray, "frames phonemes"], Float32[np.ndarray, "frames visemes"]]
]


@dataclass(frozen=True)
class Clip:
    """Recorded speech and what is spoken when.

    Parameters
    ----------
    name : str
        File name without ending; what precedes the first underscore groups clips.
    waveform : Waveform
        16 kHz, peak 0.7.
    phonemes : sequence of Phoneme
        The reference.
    """

    name: str
    waveform: Waveform
    phonemes: Sequence[Phoneme]


def load_clips(folder: str | Path) -> list[Clip]:
    """Sound files of a folder, each with NAME.txt (what is said) and, where known, NAME.phones.

    A line of NAME.phones is "start end symbol" (seconds, ARPAbet); without it the text is aligned.

    Raises
    ------
    FileFormatError
        If there are no clips, or a text or label file is missing or malformed.
    """
    folder = Path(folder)
    paths = sorted(p for p in folder.glob("*") if p.suffix.lower() in (".wav", ".flac", ".ogg", ".mp3"))
    if not paths:
        raise FileFormatError(f"{folder} holds no sound files; expected NAME.wav with NAME.txt")
    clips = []
    for path in paths:
        waveform = load_waveform(path).levelled()
        labels = path.with_suffix(".phones")
        if labels.is_file():
            phonemes = [_labelled(line, labels) for line in labels.read_text().splitlines() if line.strip()]
        else:
            text = path.with_suffix(".txt")
            if not text.is_file():
                raise FileFormatError(f"{text} is missing; expected the words that {path.name} says")
            phonemes = align(waveform, text.read_text())
        clips.append(Clip(path.stem, waveform, phonemes))
    return clips


def _labelled(line: str, path: Path) -> Phoneme:
    try:
        start, end, symbol = line.split()
        phoneme = Phoneme(float(start), float(end), symbol)
    except ValueError as error:
        raise FileFormatError(f"{path}: {line!r} is no label; expected 'start end symbol'") from error
    if symbol not in PHONEMES:
        raise FileFormatError(f"{path}: {symbol!r} is no phoneme; expected ARPAbet without digits, or SIL")
    return phoneme


def degraded(waveform: Waveform, condition: str, generator: np.random.Generator) -> Waveform:
    """The clip as recorded ("clean"), in noise of 20 or 10 dB, by telephone, in a room, or at -30 dB.

    Raises
    ------
    OptionError
        If there is no such condition.
    """
    samples, rate = waveform.samples, waveform.rate
    if condition == "clean":
        return waveform
    if condition == "telephone":
        band = butter(6, [300, 3400], "bandpass", fs=rate, output="sos")
        return Waveform(sosfilt(band, samples), rate)
    if condition == "room":
        seconds = np.arange(int(0.4 * rate)) / rate
        tail = generator.normal(0, 1, len(seconds)) * np.exp(-6.9 * seconds / 0.4)
        tail[: int(0.002 * rate)] = 0
        tail /= np.sqrt((tail**2).sum())
        tail[0] = 1
        return Waveform(0.7 * fftconvolve(samples, tail)[: len(samples)], rate)
    if condition == "quiet":
        return Waveform(samples * 0.03, rate)
    if condition in ("noise20", "noise10"):
        spectrum = np.fft.rfft(generator.normal(0, 1, len(samples)))
        noise = np.fft.irfft(spectrum * (np.arange(len(spectrum)) + 20.0) ** -0.5, len(samples))
        ratio = 10 ** (float(condition[5:]) / 10)
        return Waveform(samples + noise * np.sqrt(np.mean(samples**2) / ratio / np.mean(noise**2)), rate)
    raise OptionError(f"no condition {condition!r}; expected {', '.join(CONDITIONS)}")


def _runs(labels: Labels, value: int) -> list[tuple[int, int]]:
    """Spans [first, last + 1) of a value."""
    edges = np.diff(np.concatenate([[False], labels == value, [False]]).astype(np.int8))
    return list(zip(np.flatnonzero(edges == 1).tolist(), np.flatnonzero(edges == -1).tolist()))


def _matched(spans: list[tuple[int, int]], others: list[tuple[int, int]], tolerance: int = 2) -> int:
    """How many spans come within 40 ms of one of the others."""
    return sum(any(a - tolerance <= d - 1 and c <= b - 1 + tolerance for c, d in others) for a, b in spans)


def scores(
    true_phonemes: Sequence[Labels], phonemes: Sequence[Labels], visemes: Sequence[Labels]
) -> dict[str, float]:
    """Shares of frames and events that are right, over all clips.

    Parameters
    ----------
    true_phonemes, phonemes : sequences of (frames,) int arrays
        Indices into `PHONEMES`, one array a clip.
    visemes : sequence of (frames,) int arrays
        Indices into `VISEMES`.

    Returns
    -------
    dict
        phoneme_accuracy, viseme_accuracy (13 classes, frames); recall and precision of the events bmp, fv,
        round and open (runs of a class, matched within 40 ms); silence_f1 of frames.
    """
    true = np.concatenate(true_phonemes)
    true_visemes = [VISEME_OF_PHONEME[t] for t in true_phonemes]
    joined, found = np.concatenate(true_visemes), np.concatenate(visemes)
    result = {
        "phoneme_accuracy": float(np.mean(true == np.concatenate(phonemes))),
        "viseme_accuracy": float(np.mean(joined == found)),
    }
    for name in ("bmp", "fv", "round", "open"):
        value = VISEMES.index(name)
        real = [_runs(t, value) for t in true_visemes]
        claimed = [_runs(v, value) for v in visemes]
        recalled = sum(_matched(r, c) for r, c in zip(real, claimed))
        precise = sum(_matched(c, r) for r, c in zip(real, claimed))
        result[f"{name}_recall"] = recalled / max(1, sum(map(len, real)))
        result[f"{name}_precision"] = precise / max(1, sum(map(len, claimed)))
    both = np.sum((joined == 0) & (found == 0))
    result["silence_f1"] = float(2 * both / max(1, np.sum(joined == 0) + np.sum(found == 0)))
    return result


def evaluate(
    clips: Sequence[Clip], posteriors: Posteriors, condition: str = "clean"
) -> tuple[dict[str, float], dict[str, float]]:
    """Scores of an encoder's most probable classes, and its viseme accuracy by group of clips.

    Parameters
    ----------
    clips : sequence of Clip
        Speech with references.
    posteriors : callable
        Waveform to phoneme and viseme posteriors at 50 frames a second.
    condition : str
        One of `CONDITIONS`.
    """
    generator = np.random.default_rng(0)
    true, phonemes, visemes = [], [], []
    for clip in clips:
        phoneme_posteriors, viseme_posteriors = posteriors(degraded(clip.waveform, condition, generator))
        true.append(phoneme_frames(clip.phonemes, len(phoneme_posteriors), RATE))
        phonemes.append(phoneme_posteriors.argmax(1))
        visemes.append(viseme_posteriors.argmax(1))
    groups: dict[str, list[int]] = {}
    for k, clip in enumerate(clips):
        groups.setdefault(clip.name.partition("_")[0], []).append(k)
    by_group = {
        group: scores([true[k] for k in ks], [phonemes[k] for k in ks], [visemes[k] for k in ks])[
            "viseme_accuracy"
        ]
        for group, ks in groups.items()
    }
    return scores(true, phonemes, visemes), by_group


@dataclass(frozen=True)
class EvaluateVisemesOptions:
    """Judge speech encoders with phoneme or viseme outputs on recorded clips.

    Example: meshanim evaluate visemes clips/ --encoders visemes phones visemes+phones
    """

    clips: tyro.conf.Positional[Path]
    """Folder of sound files, each with NAME.txt, what it says."""
    encoders: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAMES")] = ("visemes",)
    """visemes, visemes:utterance (statistics of the whole clip), phones, visemes+phones."""
    weights: Path | None = None
    """Another viseme net than the packaged one."""
    conditions: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAMES")] = ("clean",)
    """clean, noise20, noise10, telephone, room, quiet."""
    json: Path | None = None
    """Where the numbers go."""


def _posteriors(name: str, weights: Path | None) -> Posteriors:
    from meshanim.audio.phones import FusedEncoder, PhoneEncoder
    from meshanim.audio.visemes import VisemeEncoder, load_viseme_net

    net = load_viseme_net() if weights is None else load_viseme_net(weights)
    encoders = {
        "visemes": lambda: VisemeEncoder(net),
        "visemes:utterance": lambda: VisemeEncoder(net, normalization="utterance"),
        "phones": PhoneEncoder,
        "visemes+phones": lambda: FusedEncoder(VisemeEncoder(net, normalization="utterance")),
    }
    if name not in encoders:
        raise OptionError(f"no encoder {name!r} with visemes; expected one of {', '.join(encoders)}")
    encoder = encoders[name]()

    def run(waveform: Waveform) -> tuple[np.ndarray, np.ndarray]:
        features = encoder(waveform).numpy()
        return features[:, : len(PHONEMES)], features[:, len(PHONEMES) :]

    return run


def evaluate_visemes(options: EvaluateVisemesOptions, progress: bool = True) -> Results:
    """Scores of each encoder under each condition, by group of clips where clean, and its speed.

    Raises
    ------
    FileFormatError, OptionError
        If a clip cannot be read, or an encoder or condition does not exist.
    """
    clips = load_clips(options.clips)
    seconds = sum(clip.waveform.duration for clip in clips)
    results = Results("evaluate visemes")
    for name in tqdm(options.encoders, desc="encoders", disable=not progress):
        posteriors = _posteriors(name, options.weights)
        for condition in options.conditions:
            start = time.perf_counter()
            found, groups = evaluate(clips, posteriors, condition)
            speed = seconds / (time.perf_counter() - start)
            for metric, value in found.items():
                results.add(condition, name, metric, value, "ratio")
            results.add(condition, name, "speed", speed, "x real time")
            if condition == "clean":
                for group, value in groups.items():
                    results.add(f"clean, {group}", name, "viseme_accuracy", value, "ratio")
    if options.json is not None:
        results.save(options.json)
    return results
