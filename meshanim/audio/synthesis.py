"""Synthetic speech with phoneme timings: espeak-ng and Pico from pip, flite where it is installed."""

import importlib.util
import json
import math
import re
import shutil
import subprocess
import sys
import tempfile
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import numpy as np

from meshanim.audio.phonemes import Phoneme, align, words_of
from meshanim.audio.waveform import Waveform, load_waveform
from meshanim.errors import DependencyError, OptionError, ShapeError

__all__ = ["espeak_pronunciation", "speak", "synthesize_speech", "voices"]

_PACKAGES = {"espeak": "espeakng_loader", "pico": "py_nanotts"}
_FLITE_PITCH = {"slt": 175, "rms": 95, "awb": 125, "kal16": 105}  # Hz, the voices' own
_PICO = ("en-US", "en-GB")
_ESPEAK_LANGUAGES = ("en-us", "en-gb-x-rp", "en-gb-scotland", "en-gb-x-gbclan", "en-gb-x-gbcwmd", "en-029")
_ESPEAK_VARIANTS = (
    "m1", "m2", "m3", "m4", "m5", "m6", "m7", "f1", "f2", "f3", "f4", "f5", "klatt", "klatt2", "klatt3",
    "klatt4", "Andy", "Annie", "steph", "Alex", "Michael", "Lee", "Gene", "Denis", "Hugo", "iven",
)  # fmt: skip


def voices() -> list[str]:
    """Names of the voices on this machine for `synthesize_speech`, best first.

    "flite:slt" (female, US), "flite:rms" (male, US), "flite:awb" (male, Scottish), "flite:kal16" (male, US);
    "pico:en-US", "pico:en-GB" (female); "espeak:LANGUAGE" and "espeak:LANGUAGE+VARIANT".
    """
    found = []
    if shutil.which("flite"):
        found += [f"flite:{name}" for name in _FLITE_PITCH]
    if importlib.util.find_spec(_PACKAGES["pico"]):
        found += [f"pico:{name}" for name in _PICO]
    if importlib.util.find_spec(_PACKAGES["espeak"]):
        found += [f"espeak:{language}" for language in _ESPEAK_LANGUAGES]
        found += [f"espeak:{language}+{v}" for language in _ESPEAK_LANGUAGES for v in _ESPEAK_VARIANTS]
    return found


def synthesize_speech(
    text: str,
    voice: str = "pico:en-US",
    rate: float = 1.0,
    pitch: float = 1.0,
    intonation: float = 1.0,
) -> tuple[Waveform, list[Phoneme]]:
    """Speak an English sentence; the same arguments give the same samples.

    Every utterance is made by a process of its own, so that none depends on what was spoken before, and
    calls are safe from threads and forked processes.

    Parameters
    ----------
    text : str
        A sentence; numbers are to be written out.
    voice : str
        One of `voices()`.
    rate : float
        Speed, 0.5 to 2; 1 is the voice's own.
    pitch : float
        Factor on the fundamental frequency, 0.5 to 2.
    intonation : float
        Factor on the range of the pitch, 0 to 2; Pico has none and ignores it.

    Returns
    -------
    waveform : Waveform
        16 kHz, peak 0.7.
    phonemes : list of Phoneme
        From 0 to the end. By forced alignment for every voice; where that fails on espeak's, its own events,
        with the closure of stops given back, as espeak stamps a stop at its burst.

    Raises
    ------
    OptionError
        If the voice does not exist, a factor is out of range, or the text has no words.
    DependencyError
        If the voice's engine or pocketsphinx is not installed.
    ShapeError
        If the phonemes cannot be aligned.
    """
    waveform, events = _spoken(text, voice, rate, pitch, intonation)
    try:
        return waveform, align(waveform, text)
    except ShapeError:
        if not events:
            raise
        return waveform, _from_events(events, waveform.duration)


def speak(
    text: str, voice: str = "pico:en-US", rate: float = 1.0, pitch: float = 1.0, intonation: float = 1.0
) -> Waveform:
    """The sound of `synthesize_speech` alone: no phonemes, so no alignment and no pocketsphinx."""
    return _spoken(text, voice, rate, pitch, intonation)[0]


def _spoken(
    text: str, voice: str, rate: float, pitch: float, intonation: float
) -> tuple[Waveform, list[tuple[float, str]]]:
    """16 kHz, peak 0.7, and the engine's phoneme events where it has some."""
    words_of(text)
    for name, value, low in (("rate", rate, 0.5), ("pitch", pitch, 0.5), ("intonation", intonation, 0.0)):
        if not low <= value <= 2:
            raise OptionError(f"{name} is {value}; expected {low} to 2")
    engine, _, name = voice.partition(":")
    events: list[tuple[float, str]] = []
    if engine == "flite" and name in _FLITE_PITCH:
        waveform = _flite(text, name, rate, pitch, intonation)
    elif engine == "pico" and name in _PICO:
        answer, samples = _speak("pico", {"text": text, "voice": name, "rate": rate, "pitch": pitch})
        waveform = Waveform(samples, answer["rate"])
    elif engine == "espeak" and name:
        request = {
            "task": "speak",
            "text": text,
            "voice": name,
            "rate": round(175 * rate),
            # espeak's pitch scale: 50 is the voice's own, 50 steps are an octave
            "pitch": min(99, max(0, round(50 + 50 * math.log2(pitch)))),
            "range": min(99, round(50 * intonation)),
        }
        answer, samples = _speak("espeak", request)
        waveform = Waveform(samples, answer["rate"])
        events = answer["events"]
    else:
        raise OptionError(f"no voice {voice!r}; expected one of voices(), such as {', '.join(voices()[:6])}")
    return waveform.resampled(16000).levelled(), events


def _flite(text: str, name: str, rate: float, pitch: float, intonation: float) -> Waveform:
    program = shutil.which("flite")
    if program is None:
        raise OptionError("flite is not installed; apt install flite, or choose a pico or espeak voice")
    settings = {
        "duration_stretch": f"{1 / rate:.4f}",
        "int_f0_target_mean": f"{_FLITE_PITCH[name] * pitch:.2f}",
        "int_f0_target_stddev": f"{16 * intonation:.2f}",
    }
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "speech.wav"
        command = [program, "-voice", name, "-t", text, "-o", str(path)]
        for key, value in settings.items():
            command += ["--setf", f"{key}={value}"]
        subprocess.run(command, check=True, capture_output=True)
        return load_waveform(path)


def _process(engine: str, request: dict) -> bytes:
    if importlib.util.find_spec(_PACKAGES[engine]) is None:
        raise DependencyError(_PACKAGES[engine].replace("_", "-"), "speech")
    script = Path(__file__).parent / "voices" / f"{engine}_process.py"
    done = subprocess.run(
        [sys.executable, "-I", str(script)], input=json.dumps(request).encode(), capture_output=True
    )
    if done.returncode != 0:
        reason = done.stderr.decode(errors="replace").strip().splitlines()[-1:] or [
            f"status {done.returncode}"
        ]
        raise OptionError(
            f"{engine} cannot speak {request['text'][:60]!r} as {request['voice']}: {reason[0]}"
        )
    return done.stdout


def _speak(engine: str, request: dict) -> tuple[dict, np.ndarray]:
    header, _, samples = _process(engine, request).partition(b"\n")
    answer = json.loads(header)
    answer["events"] = [(time, symbol) for time, symbol in answer.get("events", [])]
    return answer, np.frombuffer(samples, "<i2").astype(np.float32) / 32768


@lru_cache(maxsize=4096)
def _ipa(word: str) -> str:
    return json.loads(_process("espeak", {"task": "pronounce", "text": word, "voice": "en-us"}))["ipa"]


def espeak_pronunciation(word: str) -> list[str]:
    """Phonemes of an English word by espeak-ng's rules.

    Raises
    ------
    DependencyError
        If espeakng-loader is not installed.
    """
    return arpabet(_ipa(word))


_ARPABET = {
    "tʃ": "CH", "dʒ": "JH", "aɪə": "AY AH", "aɪɚ": "AY ER", "aɪ": "AY", "eɪ": "EY", "oʊ": "OW", "əʊ": "OW",
    "aʊ": "AW", "ɔɪ": "OY", "əl": "AH L", "ɔːɹ": "AO R", "oːɹ": "AO R", "ɑːɹ": "AA R", "ɛɹ": "EH R",
    "ɪɹ": "IH R", "ʊɹ": "UH R", "iə": "IY AH", "ʊə": "UH", "eə": "EH", "ɛə": "EH", "iː": "IY", "uː": "UW",
    "ɑː": "AA", "ɔː": "AO", "ɜː": "ER", "oː": "AO", "i": "IY", "u": "UW", "ɪ": "IH", "ᵻ": "IH",
    "ɛ": "EH", "e": "EH",
    "æ": "AE", "a": "AE", "ɐ": "AH", "ʌ": "AH", "ə": "AH", "ɒ": "AA", "ɔ": "AO", "o": "AO", "ʊ": "UH",
    "ɚ": "ER", "ɑ": "AA", "θ": "TH", "ð": "DH", "ʃ": "SH", "ʒ": "ZH", "ŋ": "NG", "ɹ": "R", "r": "R",
    "ɾ": "T", "ʔ": "T", "j": "Y", "h": "HH", "ɡ": "G", "g": "G", "x": "K",
    "p": "P", "b": "B", "t": "T", "d": "D", "k": "K", "f": "F", "v": "V", "s": "S", "z": "Z", "m": "M",
    "n": "N", "l": "L", "w": "W",
}  # fmt: skip
_IPA_SYMBOL = re.compile("|".join(sorted(_ARPABET, key=len, reverse=True)))


def arpabet(ipa: str) -> list[str]:
    """English IPA as espeak-ng writes it to ARPAbet without stress; stress and length marks are dropped."""
    symbols = _IPA_SYMBOL.findall(re.sub("[ˈˌ\u0329\u0303ʲ ]", "", ipa))
    return " ".join(_ARPABET[s] for s in symbols).split()


_STOPS = frozenset(["P", "B", "T", "D", "K", "G", "CH", "JH"])
_CLOSURE = 0.055  # seconds; espeak's /p/ events start this long after the closure (measured on alignments)


def _from_events(events: list[tuple[float, str]], duration: float) -> list[Phoneme]:
    """espeak's phoneme events as phonemes: a symbol of several is divided evenly, stops get their closure."""
    spans: list[tuple[float, float, str]] = []
    for (start, ipa), (end, _) in pairwise([*events, (duration, "")]):
        symbols = arpabet(ipa) or ["SIL"]
        step = (end - start) / len(symbols)
        spans += [(start + k * step, start + (k + 1) * step, symbol) for k, symbol in enumerate(symbols)]
    for k in range(1, len(spans)):
        start, end, symbol = spans[k]
        if symbol in _STOPS and end - start < 0.09:
            before = spans[k - 1]
            start -= min(_CLOSURE, 0.4 * (before[1] - before[0]))
            spans[k - 1], spans[k] = (before[0], start, before[2]), (start, end, symbol)
    return [Phoneme(max(0.0, a), min(b, duration), s) for a, b, s in spans if min(b, duration) > max(0.0, a)]
