"""Emotional speech of many synthetic speakers, for classifiers of emotion: sound alone, the corpus's voices.

An emotion changes rate, pitch and amplitude of a voice as in the corpus (`style.EMOTIONS`) and nothing else:
no timbre, no intonation, no breath. It is what the embedded corpus has, not what people do.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from tqdm import tqdm
from tyro.conf import Positional

from meshanim import __version__
from meshanim.audio import save_waveform, speak, voices
from meshanim.datasets.synthetic.claim import claim_folder
from meshanim.datasets.synthetic.corpus import CastMember, Take, delivery
from meshanim.datasets.synthetic.sentences import SENTENCES
from meshanim.datasets.synthetic.style import SpeakingStyle
from meshanim.errors import DependencyError, OptionError
from meshanim.jobs import run_jobs
from meshanim.motion.emotions import HEARD_EMOTIONS

__all__ = ["EmotionalSpeechOptions", "speak_emotions", "speakers"]


@dataclass(frozen=True)
class EmotionalSpeechOptions:
    """Speak sentences with six emotions in many synthetic voices: DIR/SPEAKER/EMOTION/NN.wav.

    Example: meshanim data emotional-speech speech --speakers 36
    """

    directory: Positional[Path]
    """Folder to write; an interrupted run with the same options is continued."""
    speakers: int = 36
    """People, each with a voice, rate and pitch of their own: every third one Pico's or flite's, the others a
    variant of espeak-ng each."""
    sentences: int = 5
    """Sentences of each emotion by each speaker, chosen by the seed (at most 80)."""
    seed: int = 0
    """Same seed, same files."""
    workers: int = 1
    """Processes; 0 takes one a core."""

    def __post_init__(self):
        for name, low, high in (
            ("speakers", 2, 10_000),
            ("sentences", 1, len(SENTENCES)),
            ("seed", 0, 2**63),
        ):
            if not low <= getattr(self, name) <= high:
                raise OptionError(f"--{name} is {getattr(self, name)}; expected {low} to {high}")


def speakers(options: EmotionalSpeechOptions, available: list[str]) -> list[CastMember]:
    """Everybody who speaks, decided by the seed alone.

    Parameters
    ----------
    options : EmotionalSpeechOptions
    available : list of str
        Voices of this machine.
    """
    order = np.random.default_rng([options.seed, 0x5EA5])
    formant = [voice for voice in available if voice.startswith("espeak")]
    formant = [formant[k] for k in order.permutation(len(formant))]
    recorded = [voice for voice in available if not voice.startswith("espeak")]
    members = []
    for index in range(options.speakers):
        generator = np.random.default_rng([options.seed, index, 0x5EA5])
        pool = recorded if (index % 3 == 0 and recorded) or not formant else formant
        rate, pitch = np.exp(generator.normal(size=2) * (0.08, 0.10))
        members.append(
            CastMember(
                f"P{index + 1:03d}",
                (),
                SpeakingStyle(),
                pool[(index // 3 if pool is recorded else index) % len(pool)],
                round(float(np.clip(rate, 0.8, 1.25)), 3),
                round(float(np.clip(pitch, 0.8, 1.25)), 3),
            )
        )
    return members


def speak_emotions(options: EmotionalSpeechOptions, progress: bool = True) -> Path:
    """Write the speech; files that are already there are kept.

    Raises
    ------
    DependencyError
        Without a synthetic voice: the extra is `speech`.
    OptionError
        If the folder holds something else.
    """
    available = voices()
    if not available:
        raise DependencyError("py-nanotts", "speech")
    recorded = {
        "speakers": options.speakers,
        "sentences": options.sentences,
        "seed": options.seed,
        "version": __version__,
    }
    claim_folder(options.directory, recorded, "speech")
    jobs = [
        (Take(member, number, SENTENCES[sentence], emotion, intensity, (options.seed, row, at)), number)
        for row, member in enumerate(speakers(options, available))
        for at, (emotion, number, sentence, intensity) in enumerate(_lines(options, row))
    ]
    with tqdm(total=len(jobs), desc="sentences", disable=not progress) as bar:
        for _ in run_jobs(partial(_write, options.directory.absolute()), jobs, options.workers):
            bar.update()
    return options.directory


def _lines(options: EmotionalSpeechOptions, row: int) -> list[tuple[str, int, int, float]]:
    """Emotion, number, sentence and intensity of everything that a speaker says."""
    generator = np.random.default_rng([options.seed, row, 0xE307])
    lines = []
    for emotion in HEARD_EMOTIONS:
        chosen = generator.permutation(len(SENTENCES))[: options.sentences]
        strengths = generator.uniform(0.4, 1.0, options.sentences).round(2)
        lines += [
            (emotion, number, int(sentence), 0.0 if emotion == "neutral" else float(strength))
            for number, (sentence, strength) in enumerate(zip(chosen, strengths), start=1)
        ]
    return lines


def _write(directory: Path, job: tuple[Take, int]) -> str:
    take, number = job
    folder = directory / take.member.name / take.emotion
    path = folder / f"{number:02d}.wav"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        how = delivery(take)
        save_waveform(how.around(speak(take.text, take.member.voice, how.rate, how.pitch)), path)
    return path.name
