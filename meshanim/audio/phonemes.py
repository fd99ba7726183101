"""Phonemes in time: ARPAbet and visemes, forced alignment, and recognition without a transcript."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Int64

from meshanim.audio.waveform import Waveform
from meshanim.errors import DependencyError, OptionError, ShapeError

__all__ = [
    "PHONEMES",
    "VISEMES",
    "VISEME_OF_PHONEME",
    "Phoneme",
    "align",
    "phoneme_frames",
    "recognize_phonemes",
]

PHONEMES = (
    "SIL", "AA", "AE", "AH", "AO", "AW", "AY", "B", "CH", "D", "DH", "EH", "ER", "EY", "F", "G", "HH",
    "IH", "IY", "JH", "K", "L", "M", "N", "NG", "OW", "OY", "P", "R", "S", "SH", "T", "TH", "UH", "UW",
    "V", "W", "Y", "Z", "ZH",
)  # fmt: skip
"""ARPAbet without stress digits, silence first."""

_CLASSES = {
    "sil": "SIL",
    "bmp": "B M P",
    "fv": "F V",
    "th": "TH DH",
    "tdnl": "T D N L",
    "sz": "S Z",
    "sh": "SH ZH CH JH",
    "kg": "K G NG HH",
    "r": "R ER",
    "round": "W UW UH OW OY",
    "open": "AA AE AY AW AO",
    "mid": "AH EH",
    "front": "IY IH EY Y",
}
VISEMES = tuple(_CLASSES)
"""Classes of phonemes that look alike on a face."""

VISEME_OF_PHONEME: Int64[np.ndarray, " phonemes"] = np.array(
    [
        next(k for k, members in enumerate(_CLASSES.values()) if symbol in members.split())
        for symbol in PHONEMES
    ]
)
"""For each of `PHONEMES` the index of its class in `VISEMES`."""


@dataclass(frozen=True)
class Phoneme:
    """A phoneme and when it is spoken.

    Parameters
    ----------
    start, end : float
        Seconds.
    symbol : str
        One of `PHONEMES`.
    """

    start: float
    end: float
    symbol: str

    @property
    def viseme(self) -> str:
        """Its class in `VISEMES`."""
        return VISEMES[VISEME_OF_PHONEME[PHONEMES.index(self.symbol)]]


def phoneme_frames(phonemes: Sequence[Phoneme], frames: int, fps: float) -> Int64[np.ndarray, " frames"]:
    """The phoneme spoken at each frame's time (k + 0.5) / fps, as index into `PHONEMES`; else silence."""
    times = (np.arange(frames) + 0.5) / fps
    found = np.zeros(frames, np.int64)
    for phoneme in phonemes:
        found[(times >= phoneme.start) & (times < phoneme.end)] = PHONEMES.index(phoneme.symbol)
    return found


def words_of(text: str) -> list[str]:
    """Lower-case words of a sentence, with their apostrophes.

    Raises
    ------
    OptionError
        If there is no word, or a digit: how a number is spoken is the writer's to say.
    """
    if re.search(r"\d", text):
        raise OptionError(f"text {text!r} holds digits; expected words: write numbers out")
    words = re.findall(r"[a-z]+(?:'[a-z]+)*'?", text.lower().replace("\u2019", "'"))
    if not words:
        raise OptionError(f"text {text!r} holds no English word; expected the words that are spoken")
    return words


def _pocketsphinx() -> Any:
    try:
        import pocketsphinx
    except ImportError as error:
        raise DependencyError("pocketsphinx", "speech") from error
    return pocketsphinx


def aligner() -> Any:
    """A decoder with the US English acoustic model and dictionary, without a language model."""
    return _pocketsphinx().Decoder(lm=None, loglevel="FATAL", bestpath=False)


@lru_cache(maxsize=1)
def _shared_aligner() -> Any:
    return aligner()


@lru_cache(maxsize=1)
def recognizer() -> Any:
    """A decoder of phone sequences with a phone bigram (pocketsphinx's allphone search)."""
    pocketsphinx = _pocketsphinx()
    return pocketsphinx.Decoder(
        allphone=pocketsphinx.get_model_path("en-us/en-us-phone.lm.bin"),
        lm=None,
        lw=2.0,
        beam=1e-20,
        pbeam=1e-20,
        loglevel="FATAL",
    )


def pcm(waveform: Waveform) -> bytes:
    """16 kHz 16-bit samples, levelled to a peak of 0.7."""
    return (waveform.resampled(16000).levelled().samples * 32767).astype("<i2").tobytes()


def _decode(decoder: Any, samples: bytes) -> None:
    decoder.reinit_feat()  # forget the noise of the last utterance
    decoder.start_utt()
    decoder.process_raw(samples, no_search=False, full_utt=True)
    decoder.end_utt()


def _joined(segments: list[tuple[int, int, str]], duration: float) -> list[Phoneme]:
    """Segments in 10 ms frames to phonemes that cover the speech from 0 to its end without gaps."""
    phonemes: list[Phoneme] = []
    for first, last, name in segments:
        symbol = name if name in PHONEMES else "SIL"
        start, end = first * 0.01, min(last * 0.01, duration)
        if end <= start:
            continue
        reached = phonemes[-1].end if phonemes else 0.0
        if start > reached + 1e-6:
            phonemes.append(Phoneme(reached, start, "SIL"))
        if phonemes and symbol == phonemes[-1].symbol == "SIL":
            phonemes[-1] = Phoneme(phonemes[-1].start, end, "SIL")
        else:
            phonemes.append(Phoneme(start, end, symbol))
    reached = phonemes[-1].end if phonemes else 0.0
    if reached < duration:
        if phonemes and (phonemes[-1].symbol == "SIL" or duration - reached < 0.03):
            phonemes[-1] = Phoneme(phonemes[-1].start, duration, phonemes[-1].symbol)
        else:
            phonemes.append(Phoneme(reached, duration, "SIL"))
    return phonemes


def align(waveform: Waveform, text: str, pronunciations: Mapping[str, str] | None = None) -> list[Phoneme]:
    """When each phoneme of a known English text is spoken: forced alignment by pocketsphinx.

    Parameters
    ----------
    waveform : Waveform
        Speech that says `text`.
    text : str
        The words; punctuation is ignored, numbers are to be written out.
    pronunciations : mapping, optional
        ARPAbet without stress for words the dictionary (CMUdict) lacks or says otherwise:
        {"meshanim": "M EH SH AE N IH M"}. Words that are in neither are pronounced by espeak-ng's rules.

    Returns
    -------
    list of Phoneme
        From 0 to the end of the speech, silences included, on a grid of 10 ms.

    Raises
    ------
    OptionError
        If a word has no pronunciation, or a pronunciation a phoneme that does not exist.
    ShapeError
        If the words do not fit into the speech.
    DependencyError
        If pocketsphinx is not installed.
    """
    words = words_of(text)
    given = {word.lower(): phones.upper() for word, phones in (pronunciations or {}).items()}
    for word, phones in given.items():
        unknown = [p for p in phones.split() if p not in PHONEMES[1:]]
        if unknown or not phones.split():
            raise OptionError(f"pronunciation {phones!r} of {word!r} holds {unknown}; expected ARPAbet")
    decoder = aligner() if given else _shared_aligner()
    for word, phones in given.items():
        decoder.add_word(word, phones, True)
    for word in dict.fromkeys(words):
        if decoder.lookup_word(word) is None:
            decoder.add_word(word, " ".join(pronounce(word)), True)
    samples = pcm(waveform)
    try:
        decoder.set_align_text(" ".join(words))
        _decode(decoder, samples)
        decoder.set_alignment()
        _decode(decoder, samples)
        alignment = decoder.get_alignment()
    except RuntimeError as error:
        alignment = None
        cause: BaseException | None = error
    else:
        cause = None
    if alignment is None:
        raise ShapeError(
            f"{waveform.duration:.2f} s of speech do not align with {' '.join(words)[:60]!r} "
            f"({len(words)} words); expected speech that says this text"
        ) from cause
    segments = [(p.start, p.start + p.duration, p.name) for word in alignment for p in word]
    return _joined(segments, waveform.duration)


def pronounce(word: str) -> list[str]:
    """Phonemes of a word that the dictionary lacks, by espeak-ng's rules for US English.

    Raises
    ------
    OptionError
        If espeak-ng is not installed or does not know what to do with it.
    """
    from meshanim.audio.synthesis import espeak_pronunciation

    try:
        phonemes = espeak_pronunciation(word)
    except DependencyError:
        phonemes = []
    if not phonemes:
        raise OptionError(
            f"{word!r} is not in the dictionary; give it as pronunciations={{{word!r}: 'ARPAbet phonemes'}}"
        )
    return phonemes


def recognize_phonemes(waveform: Waveform) -> list[Phoneme]:
    """Phonemes of English speech without a transcript, by pocketsphinx's phone decoder.

    About 60 % of the frames right on clean speech, little in noise: use `align` where the text is known.

    Raises
    ------
    DependencyError
        If pocketsphinx is not installed.
    """
    decoder = recognizer()
    _decode(decoder, pcm(waveform))
    segments = [(s.start_frame, s.end_frame + 1, s.word) for s in decoder.seg() or []]
    return _joined(segments, waveform.duration)
