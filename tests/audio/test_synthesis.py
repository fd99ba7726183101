"""Synthetic voices: what they say, when, and that they say it again."""

import shutil
from concurrent.futures import ProcessPoolExecutor
from itertools import pairwise
from multiprocessing import get_context

import numpy as np
import pytest

from meshanim.audio import pitch, synthesize_speech, voices
from meshanim.audio.synthesis import _from_events, _speak
from meshanim.errors import OptionError

pytest.importorskip("pocketsphinx")
TEXT = "Baby, buy five maps."
PHONEMES = ["B", "EY", "B", "IY", "B", "AY", "F", "AY", "V", "M", "AE", "P", "S"]

NAMES = [
    pytest.param("flite:slt", marks=pytest.mark.skipif(not shutil.which("flite"), reason="needs flite")),
    "pico:en-GB",
    "espeak:en-us+f3",
]


@pytest.mark.parametrize("voice", NAMES)
def test_voices_speak_with_phonemes_in_time(voice):
    if voice.startswith("pico"):
        pytest.importorskip("py_nanotts")
    if voice.startswith("espeak"):
        pytest.importorskip("espeakng_loader")
    assert voice in voices()
    waveform, phonemes = synthesize_speech(TEXT, voice)
    assert waveform.rate == 16000
    assert np.abs(waveform.samples).max() == pytest.approx(0.7, abs=1e-3)
    assert [p.symbol for p in phonemes if p.symbol != "SIL"] == PHONEMES
    assert phonemes[0].start == 0
    assert phonemes[-1].end == pytest.approx(waveform.duration)
    fricative = next(p for p in phonemes if p.symbol == "S")
    middle = int((fricative.start + fricative.end) / 2 * 16000)
    spectrum = np.abs(np.fft.rfft(waveform.samples[middle - 256 : middle + 256] * np.hanning(512)))
    assert spectrum[96:].sum() > spectrum[:96].sum()  # an s has its energy above 3 kHz

    again, phonemes_again = synthesize_speech(TEXT, voice)
    np.testing.assert_array_equal(waveform.samples, again.samples)
    assert phonemes == phonemes_again

    fast, _ = synthesize_speech(TEXT, voice, rate=1.4)
    assert fast.duration < 0.9 * waveform.duration
    high, _ = synthesize_speech(TEXT, voice, pitch=1.3)
    mean, mean_high = (p[p > 0].mean() for p in (pitch(waveform, 50.0), pitch(high, 50.0)))
    assert 1.15 < mean_high / mean < 1.45


def test_same_speech_from_another_process():
    pytest.importorskip("py_nanotts")
    here, phonemes = synthesize_speech(TEXT, "pico:en-US")
    for method in ("fork", "spawn"):
        with ProcessPoolExecutor(1, mp_context=get_context(method)) as pool:
            there, phonemes_there = pool.submit(synthesize_speech, TEXT, "pico:en-US").result()
        np.testing.assert_array_equal(here.samples, there.samples)
        assert phonemes == phonemes_there


def test_events_give_stops_their_closure():
    pytest.importorskip("espeakng_loader")
    request = {"task": "speak", "text": "a map", "voice": "en-us", "rate": 175, "pitch": 50, "range": 50}
    answer, samples = _speak("espeak", request)
    phonemes = _from_events(answer["events"], len(samples) / answer["rate"])
    symbols = [p.symbol for p in phonemes]
    assert [s for s in symbols if s != "SIL"] == ["AH", "M", "AE", "P"]
    stop = phonemes[symbols.index("P")]
    burst = next(time for time, ipa in answer["events"] if ipa == "p")
    assert 0.02 < burst - stop.start <= 0.0551
    assert all(a.end == pytest.approx(b.start) for a, b in pairwise(phonemes))


@pytest.mark.parametrize(
    "options",
    [
        {"voice": "espeak:martian"},
        {"voice": "flite:hal"},
        {"voice": "nobody"},
        {"rate": 5.0},
        {"pitch": 0.1},
        {"intonation": -1.0},
        {"text": "42"},
    ],
)
def test_what_cannot_be_spoken(options):
    pytest.importorskip("espeakng_loader")
    with pytest.raises(OptionError) as caught:
        synthesize_speech(options.pop("text", TEXT), **options)
    assert "\n" not in str(caught.value)
