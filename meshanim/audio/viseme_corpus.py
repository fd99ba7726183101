"""Speech that the viseme encoder learns from: generated sentences in synthetic voices, aligned.

Voices made from recordings of people (flite, Pico) carry most of it; espeak-ng's formant voices add variety.
"""

import random
import re
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from jaxtyping import Int16, UInt8
from tqdm import tqdm

from meshanim.audio.phonemes import phoneme_frames
from meshanim.audio.synthesis import synthesize_speech, voices
from meshanim.errors import FileFormatError, OptionError, ShapeError
from meshanim.files import written_whole

__all__ = ["FAMILIES", "Utterance", "generate_sentence", "load_corpus", "speak_corpus"]

FAMILIES = {"flite": 0.45, "pico": 0.35, "espeak": 0.20}
"""Share of the hours that each family of voices speaks."""

LABEL_RATE = 100
HOP = 160
_SHARD_SECONDS = 300.0

_PATTERNS = (
    "{the} {quality} {thing} {did} {the} {thing} {where} {the} {thing}",
    "{name} {did} {many} {quality} {things} {when}",
    "{who} {did} {the} {quality} {person}, and {who} {did} {the} {thing} {how}",
    "please {do} {the} {thing} {where} {the} {quality} {thing}",
    "did {who} {do} {the} {thing} {where} {name}",
    "{when}, {name} {did} {the} {thing} {where} the {person}",
    "what would {who} {do} if {the} {thing} were {quality}",
    "{who} could not {do} {the} {thing} because {the} {person} was too {quality}",
    "how many {things} did {name} {do} {when}",
    "{quality} {thing}, {quality} {thing}, {quality} {thing}",
    "there are {many} {things} {where} {the} {quality} {thing}",
    "the {thing} of the {person} is {how} {quality}",
    "{many} {many}, {many} {many}, {many}",
    "yes, {who} should {do} the {quality} one",
    "no, i do not think {who} will ever {do} it {how}",
    "{who} had been {quality} and {quality}, but {name} {did} him {when}",
    "why are you so {quality} about {the} {thing}",
    "the {quality} {person} and the {quality} {person} {did} each other",
    "who {did} my {thing}",
    "it was {quality}",
    "{do} me the {thing}",
    "thank you very much for the {quality} {thing}",
    "he might have been more {quality} than {name} {when}",
    "she {did} that the {thing} was {where} the {thing}",
    "oh, what a {quality} {thing} you have",
    "whether they {do} it or not, the {thing} must be {quality}",
    "{how}, {the} {person} {did} {where} {many} {things} and {the} {thing}",
    "those {things} over there are {quality}, these are {quality}",
    "let us {do} to {do} a {thing}",
    "{name} and {name} are going to {do} the {person} {when}",
)


@lru_cache(maxsize=1)
def _words() -> dict[str, list[str]]:
    """The lists of viseme_words.txt, and the plurals of its things."""
    text = (Path(__file__).parent / "viseme_words.txt").read_text()
    lists = re.findall(r"\[(\w+)\]\n(.*?)(?=\n\n|\Z)", text, re.DOTALL)
    words = {key: re.split(r",\s+", body.strip()) for key, body in lists}
    words["things"] = [_plural(word) for word in words["thing"]]
    return words


def _plural(word: str) -> str:
    for pattern, ending in (
        (r"(s|x|z|sh|ch)$", r"\1es"),
        (r"([^aeiou])y$", r"\1ies"),
        (r"(?<![fo])fe?$", "ves"),
    ):
        if re.search(pattern, word):
            return re.sub(pattern, ending, word)
    return word + "s"


def generate_sentence(generator: random.Random) -> str:
    """A grammatical sentence of common words, mostly without sense; together they cover all phonemes."""
    pattern = generator.choice(_PATTERNS)
    sentence = re.sub(r"\{(\w+)\}", lambda slot: generator.choice(_words()[slot[1]]), pattern)
    return re.sub(r"\ba ([aeiou])", r"an \1", sentence)


@dataclass(frozen=True)
class Utterance:
    """A sentence in one voice.

    Parameters
    ----------
    samples : (T,) int16
        16 kHz; T is a multiple of 160.
    labels : (T / 160,) uint8
        Phoneme of each 10 ms, an index into `PHONEMES`.
    voice : str
        Its name in `voices()`.
    """

    samples: Int16[np.ndarray, " samples"]
    labels: UInt8[np.ndarray, " frames"]
    voice: str

    @property
    def family(self) -> str:
        """The engine that spoke it."""
        return self.voice.partition(":")[0]


def _utterance(generator: random.Random, names: Sequence[str]) -> Utterance | None:
    """One utterance, or None where the voice or the alignment failed on this sentence."""
    sentence = generate_sentence(generator)
    voice = generator.choice(names)
    wide = voice.startswith("espeak")
    rate = generator.uniform(0.7, 1.3)
    pitch = generator.uniform(0.65, 1.5) if wide else generator.uniform(0.78, 1.28)
    intonation = generator.uniform(0.3, 1.8)
    try:
        waveform, phonemes = synthesize_speech(sentence, voice, rate, pitch, intonation)
    except ShapeError:
        return None
    frames = len(waveform.samples) // HOP
    labels = phoneme_frames(phonemes, frames, LABEL_RATE)
    if (labels != 0).mean() < 0.3:
        return None
    samples = (waveform.samples[: frames * HOP] * 32767).astype(np.int16)
    return Utterance(samples, labels.astype(np.uint8), voice)


def _speak_shard(folder: Path, family: str, index: int, seconds: float, seed: int) -> None:
    generator = random.Random(f"{seed}/{family}/{index}")
    names = [v for v in voices() if v.startswith(f"{family}:")]
    spoken: list[Utterance] = []
    total = 0.0
    while total < seconds:
        utterance = _utterance(generator, names)
        if utterance is not None:
            spoken.append(utterance)
            total += len(utterance.samples) / 16000
    with written_whole(folder / f"{family}-{index:03d}.npz") as path:
        np.savez(
            path,
            samples=np.concatenate([u.samples for u in spoken]),
            labels=np.concatenate([u.labels for u in spoken]),
            frames=np.array([len(u.labels) for u in spoken]),
            voices=np.array([u.voice for u in spoken]),
        )


def speak_corpus(folder: str | Path, hours: float = 3.0, seed: int = 0, processes: int = 2) -> None:
    """Generate training speech in shards of five minutes; shards that exist are kept, so that it resumes.

    Parameters
    ----------
    folder : str or Path
        Made where missing.
    hours : float
        Of speech, shared among the families of voices as `FAMILIES` says.
    seed : int
        The same seed, voices and versions give the same files, with any number of processes.
    processes : int
        Worker processes.

    Raises
    ------
    OptionError
        If a family of voices is not installed.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    missing = set(FAMILIES) - {v.partition(":")[0] for v in voices()}
    if missing:
        raise OptionError(
            f"voices of {', '.join(sorted(missing))} are not installed; "
            "apt install flite, pip install 'meshanim[speech]'"
        )
    jobs = []
    for family, share in FAMILIES.items():
        seconds = hours * share * 3600
        for index in range(int(np.ceil(seconds / _SHARD_SECONDS - 1e-9))):
            if not (folder / f"{family}-{index:03d}.npz").exists():
                jobs.append((family, index, min(_SHARD_SECONDS, seconds - index * _SHARD_SECONDS)))
    with tqdm(total=len(jobs), desc="speak", unit="shard") as progress:
        if processes == 1:
            for job in jobs:
                _speak_shard(folder, *job, seed)
                progress.update()
            return
        with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
            for done in as_completed([pool.submit(_speak_shard, folder, *job, seed) for job in jobs]):
                done.result()
                progress.update()


def load_corpus(folder: str | Path) -> list[Utterance]:
    """All utterances of a folder, in the order of the file names.

    Raises
    ------
    FileFormatError
        If there are none, or a shard is damaged.
    """
    paths = sorted(Path(folder).glob("*.npz"))
    if not paths:
        raise FileFormatError(
            f"{folder} holds no shards; make them with: python -m meshanim.audio.viseme_training"
        )
    found: list[Utterance] = []
    for path in paths:
        try:
            with np.load(path, allow_pickle=False) as shard:
                samples, labels = shard["samples"], shard["labels"]
                ends, names = np.cumsum(shard["frames"]), shard["voices"]
        except (OSError, ValueError, KeyError) as error:
            raise FileFormatError(
                f"{path} cannot be read ({error}); delete it and generate it again"
            ) from error
        for end, frames, name in zip(ends, np.diff(ends, prepend=0), names):
            start = end - frames
            found.append(Utterance(samples[start * HOP : end * HOP], labels[start:end], str(name)))
    return found
