"""The embedded corpus: who speaks which sentence how, acted out and written."""

import hashlib
import math
import shutil
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from tqdm import tqdm
from tyro.conf import Positional

from meshanim import __version__
from meshanim.audio import Phoneme, Waveform, loudness, pitch, synthesize_speech, voices
from meshanim.datasets.faceformer import write_faceformer_sequence, write_faceformer_templates
from meshanim.datasets.meshanim_format import (
    MotionSequence,
    SequenceInfo,
    Subject,
    write_dataset,
    write_sequence,
    write_subject,
)
from meshanim.datasets.synthetic.claim import claim_folder
from meshanim.datasets.synthetic.performance import CURVE_NAMES, Performance, perform
from meshanim.datasets.synthetic.sentences import SENTENCES
from meshanim.datasets.synthetic.style import EMOTIONS, SpeakingStyle
from meshanim.errors import DependencyError, FileFormatError, OptionError
from meshanim.heads import Head, HeadParameters, load_head
from meshanim.jobs import run_jobs

__all__ = [
    "CastMember",
    "SynthesizeOptions",
    "Take",
    "act",
    "cast",
    "delivery",
    "splits",
    "synthesize",
    "takes",
]

_PROSODY_RATE = 100.0


@dataclass(frozen=True)
class SynthesizeOptions:
    """Write a talking-head corpus: synthetic speech with phoneme timings, and a head that speaks it.

    Example: meshanim data synthesize corpus --subjects 8 --sentences 40 --fps 30 --seed 0
    """

    directory: Positional[Path]
    """Folder to write; an interrupted run with the same options is continued."""
    subjects: int = 8
    """People: identity, voice and speaking style."""
    sentences: int = 40
    """Sentences, the same for every subject (at most 80, or as many as --texts has)."""
    fps: float = 30.0
    """Frames a second."""
    seed: int = 0
    """Same seed, same files, whatever the number of workers."""
    format: Literal["meshanim", "faceformer"] = "meshanim"
    """meshanim: vertices, pose, curves, phonemes. faceformer: wav/, vertices_npy/, templates.pkl."""
    emotional: float = 0.25
    """Share of the sentences that are spoken with an emotion."""
    head: str = "default"
    """A head with ARKit expressions: default, or rig:PATH."""
    texts: Path | None = None
    """Sentences of your own, one a line, instead of the built-in ones."""
    workers: int = 0
    """Processes; 0 takes one a core."""
    dask: str = ""
    """Address of a Dask scheduler, such as tcp://host:8786, whose workers make the sequences instead."""

    def __post_init__(self):
        for name, low, high in (
            ("subjects", 1, 10_000),
            ("sentences", 1, 10_000),
            ("fps", 1, 1000),
            ("seed", 0, 2**63),
            ("emotional", 0, 1),
            ("workers", 0, 4096),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise OptionError(f"--{name} is {value}; expected {low} to {high}")

    @property
    def recorded(self) -> dict[str, str | int | float]:
        """What decides the content of the files: all options but the folder and who works."""
        texts = hashlib.sha256("\n".join(_texts(self)).encode()).hexdigest()[:16]
        chosen = {
            key: value for key, value in asdict(self).items() if key not in ("directory", "workers", "dask")
        }
        return {**chosen, "texts": texts, "version": __version__}


@dataclass(frozen=True)
class CastMember:
    """A subject of the corpus: identity, style, and a voice with its own rate and pitch."""

    name: str
    shape: tuple[float, ...]
    style: SpeakingStyle
    voice: str
    rate: float
    pitch: float


@dataclass(frozen=True)
class Take:
    """One sentence to be spoken by one member of the cast."""

    member: CastMember
    sentence: int
    text: str
    emotion: str
    intensity: float
    seed: tuple[int, int, int]


def cast(options: SynthesizeOptions, shapes: int, available: list[str]) -> list[CastMember]:
    """Everybody who speaks, decided by the seed alone.

    Parameters
    ----------
    options : SynthesizeOptions
        Number of subjects and seed.
    shapes : int
        Identity coefficients of the head.
    available : list of str
        Voices, best first; recorded people's are used up before formant synthesis is.
    """
    human = [voice for voice in available if not voice.startswith("espeak")] or available
    members = []
    for index in range(options.subjects):
        generator = np.random.default_rng([options.seed, index, 0xCA57])
        shape = np.clip(generator.normal(size=shapes) * 0.8, -2, 2)
        # The first of each voice speaks as it is, later ones are moved in rate and pitch.
        again = index >= len(human)
        factors = (
            np.exp(generator.normal(size=2) * (0.08, 0.10))
            if again
            else np.exp(generator.normal(size=2) * (0.05, 0.02))
        )
        members.append(
            CastMember(
                name=f"S{index + 1:02d}",
                shape=tuple(round(float(value), 4) for value in shape),
                style=SpeakingStyle.random(int(generator.integers(2**31))),
                voice=human[index % len(human)],
                rate=round(float(np.clip(factors[0], 0.8, 1.25)), 3),
                pitch=round(float(np.clip(factors[1], 0.8, 1.25)), 3),
            )
        )
    return members


def _texts(options: SynthesizeOptions) -> tuple[str, ...]:
    if options.texts is None:
        known = SENTENCES
    else:
        try:
            lines = options.texts.read_text(encoding="utf-8").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise FileFormatError(f"cannot read sentences from {options.texts}: {error}") from error
        known = tuple(line.strip() for line in lines if line.strip())
    if options.sentences > len(known):
        raise OptionError(
            f"--sentences is {options.sentences}, there are {len(known)}; give more with --texts FILE"
        )
    return known[: options.sentences]


def takes(options: SynthesizeOptions, members: list[CastMember]) -> list[Take]:
    """Every sentence of every subject; a share of them with an emotion."""
    names = [name for name in EMOTIONS if name != "neutral"]
    result = []
    for index, member in enumerate(members):
        for number, text in enumerate(_texts(options), start=1):
            generator = np.random.default_rng([options.seed, index, number, 0xE307])
            moved = generator.random() < options.emotional
            result.append(
                Take(
                    member,
                    number,
                    text,
                    names[int(generator.integers(len(names)))] if moved else "neutral",
                    round(float(generator.uniform(0.4, 1.0)), 2) if moved else 0.0,
                    (options.seed, index, number),
                )
            )
    return result


def splits(everything: list[Take]) -> dict[str, list[str]]:
    """Sequence names by split.

    An eighth of the subjects (of four or more) is held out for validation and as many for testing, and a
    tenth of the sentences (of five or more) for each. Training has neither; `val` and `test` are the held-out
    sentences by the training subjects and by their own held-out subjects; `val_unseen` and `test_unseen` are
    only the latter. `spare` is the rest: held-out subjects speaking sentences that training has seen.
    """
    people = list(dict.fromkeys(take.member.name for take in everything))
    numbers = sorted({take.sentence for take in everything})
    held_people = max(1, round(len(people) / 8)) if len(people) >= 4 else 0
    held_numbers = max(1, round(len(numbers) / 10)) if len(numbers) >= 5 else 0

    def held(items: list, count: int) -> tuple[set, set]:
        cut = len(items) - count
        return set(items[cut - count : cut]), set(items[cut:])

    val_people, test_people = held(people, held_people)
    val_numbers, test_numbers = held(numbers, held_numbers)
    result: dict[str, list[str]] = {
        name: [] for name in ("train", "val", "test", "val_unseen", "test_unseen", "spare")
    }
    for take in everything:
        name, person, number = _name(take), take.member.name, take.sentence
        kept = person not in val_people | test_people
        if kept and number not in val_numbers | test_numbers:
            result["train"].append(name)
        elif number in val_numbers and (kept or person in val_people):
            result["val"].append(name)
            if not kept:
                result["val_unseen"].append(name)
        elif number in test_numbers and (kept or person in test_people):
            result["test"].append(name)
            if not kept:
                result["test_unseen"].append(name)
        else:
            result["spare"].append(name)
    return result


def _name(take: Take) -> str:
    return f"{take.member.name}_sentence{take.sentence:02d}"


@dataclass(frozen=True)
class Delivery:
    """How a voice says a take: factors on rate, pitch and amplitude, seconds of silence before and after."""

    rate: float
    pitch: float
    volume: float
    before: float
    after: float

    def around(self, waveform: Waveform) -> Waveform:
        """The sentence at its amplitude, between its silences."""
        before, after = (round(seconds * waveform.rate) for seconds in (self.before, self.after))
        samples = np.pad(waveform.samples * np.float32(self.volume), (before, after))
        return Waveform(np.clip(samples, -1, 1).astype(np.float32), waveform.rate)


def delivery(take: Take) -> Delivery:
    """What the emotion at its intensity, the speaker and chance make of the voice."""
    feeling = EMOTIONS[take.emotion]

    def gain(value: float) -> float:
        return 1 + take.intensity * (value - 1)

    generator = np.random.default_rng([*take.seed, 0x5BEA])
    rate = take.member.rate * gain(feeling.rate) * math.exp(generator.normal() * 0.04)
    tone = take.member.pitch * gain(feeling.pitch) * math.exp(generator.normal() * 0.02)
    before, after = generator.uniform(0.15, 0.6, size=2)
    rate, tone = (float(np.clip(value, 0.5, 2.0)) for value in (rate, tone))
    return Delivery(rate, tone, gain(feeling.volume), before, after)


def _speak(take: Take) -> tuple[Waveform, list[Phoneme]]:
    """The sentence with some silence before and after it."""
    how = delivery(take)
    waveform, phonemes = synthesize_speech(take.text, take.member.voice, how.rate, how.pitch)
    shift = round(how.before * waveform.rate) / waveform.rate
    moved = [
        Phoneme(round(p.start + shift, 4), round(p.end + shift, 4), p.symbol)
        for p in phonemes
        if p.symbol != "SIL"
    ]
    return how.around(waveform), moved


def act(take: Take, fps: float) -> tuple[Waveform, list[Phoneme], Performance]:
    """Speak and act out one take."""
    waveform, phonemes = _speak(take)
    performance = perform(
        phonemes,
        math.ceil(len(waveform.samples) * fps / waveform.rate - 1e-9),
        fps,
        loudness=loudness(waveform, _PROSODY_RATE),
        pitch=pitch(waveform, _PROSODY_RATE),
        rate=_PROSODY_RATE,
        style=take.member.style,
        emotion_name=take.emotion,
        intensity=take.intensity,
        seed=int(np.random.default_rng([*take.seed, 0xACC]).integers(2**62)),
    )
    return waveform, phonemes, performance


def _vertices(head: Head, shape: tuple[float, ...], curves: np.ndarray, chunk: int = 64) -> np.ndarray:
    """Zero-pose vertices (T, V, 3), a fixed number of frames at a time."""
    identity = torch.tensor([shape], dtype=torch.float32)
    result = np.empty((len(curves), head.mesh.n_vertices, 3), np.float32)
    with torch.inference_mode():
        for first in range(0, len(curves), chunk):
            part = torch.from_numpy(curves[first : first + chunk])
            result[first : first + chunk] = head(HeadParameters(shape=identity, expression=part)).numpy()
    return result


@lru_cache(maxsize=1)
def _head(name: str) -> Head:
    return load_head(name)


def _columns(head: Head) -> list[int]:
    """Where each of the head's expressions is in `CURVE_NAMES`; -1 for those that are not ARKit's."""
    return [CURVE_NAMES.index(name) if name in CURVE_NAMES else -1 for name in head.expression_names]


def _make(options: SynthesizeOptions, take: Take) -> str:
    """Make and write one sequence; one thread, so that sums do not depend on the machine."""
    if _done(options, take):
        return _name(take)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        head = _head(options.head)
        waveform, phonemes, performance = act(take, options.fps)
        padded = np.pad(performance.curves, ((0, 0), (0, 1)))
        curves = np.ascontiguousarray(padded[:, _columns(head)])
        info = SequenceInfo(
            subject=take.member.name,
            sentence=take.sentence,
            text=take.text,
            fps=float(options.fps),
            frames=len(performance),
            phonemes=tuple((p.start, p.end, p.symbol) for p in phonemes),
            emotion=take.emotion,
            intensity=take.intensity,
            voice=take.member.voice,
        )
        sequence = MotionSequence(
            info, _vertices(head, take.member.shape, curves), performance.pose, curves, waveform
        )
        if options.format == "faceformer":
            write_faceformer_sequence(options.directory, sequence)
        else:
            write_sequence(options.directory, sequence)
    finally:
        torch.set_num_threads(threads)
    return _name(take)


def _done(options: SynthesizeOptions, take: Take) -> bool:
    return (options.directory / "sequences" / _name(take) / "sequence.json").exists()


def _remove_half_written(options: SynthesizeOptions) -> None:
    for folder in ("sequences", "wav", "vertices_npy"):
        for left in (options.directory / folder).glob(".*"):
            shutil.rmtree(left) if left.is_dir() else left.unlink()


def synthesize(options: SynthesizeOptions, progress: bool = True) -> Path:
    """Write the corpus; sequences that are already there are kept.

    Parameters
    ----------
    options : SynthesizeOptions
        What to make.
    progress : bool
        Show a bar.

    Returns
    -------
    Path
        The folder; `meshanim.datasets.MeshanimDataset` or `FaceFormerDataset` reads it.

    Raises
    ------
    DependencyError
        Without a synthetic voice or pocketsphinx: the extra is `speech`.
    OptionError
        If the folder holds something else, there are too few sentences, or the head has no ARKit expressions.
    """
    head = _head(options.head)
    if "jawOpen" not in head.expression_names:
        raise OptionError(f"head {options.head} has no expression jawOpen: the corpus needs ARKit's names")
    available = voices()
    if not available:
        raise DependencyError("py-nanotts", "speech")
    members = cast(options, len(head.shape_names), available)
    everything = takes(options, members)
    claim_folder(options.directory, options.recorded, "corpus")
    _remove_half_written(options)
    missing = [take for take in everything if not _done(options, take)]
    with tqdm(total=len(everything), initial=len(everything) - len(missing), disable=not progress) as bar:
        bar.set_description("sequences")
        make = partial(_make, replace(options, directory=options.directory.absolute()))
        for _ in run_jobs(make, missing, options.workers, options.dask):
            bar.update()
    _remove_half_written(options)  # by workers that were killed
    subjects = [_subject(head, member) for member in members]
    if options.format == "faceformer":
        write_faceformer_templates(options.directory, subjects)
    for subject in subjects:
        write_subject(options.directory, subject)
    write_dataset(
        options.directory,
        name="meshanim synthetic",
        fps=float(options.fps),
        head=options.head,
        mesh=head.mesh,
        curve_names=head.expression_names,
        subjects=subjects,
        splits=splits(everything),
    )
    return options.directory


def _subject(head: Head, member: CastMember) -> Subject:
    shape = np.array(member.shape, np.float32)
    with torch.inference_mode():
        template = head.template(torch.from_numpy(shape)[None])[0].numpy()
    attributes = {
        "voice": member.voice,
        "rate": member.rate,
        "pitch": member.pitch,
        "style": asdict(member.style),
    }
    return Subject(member.name, template, shape, attributes)
