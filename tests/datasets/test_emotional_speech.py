"""The embedded corpus's emotional speech: the same files again, and what an emotion does to a voice."""

from pathlib import Path

import numpy as np
import pytest

from meshanim.audio import load_waveform, pitch, voices
from meshanim.cli import main
from meshanim.datasets.emotional import read_emotional
from meshanim.datasets.synthetic.emotional_speech import EmotionalSpeechOptions, speak_emotions, speakers
from meshanim.errors import OptionError
from meshanim.motion.emotions import HEARD_EMOTIONS


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("speech") / "speech"
    assert main(["data", "emotional-speech", str(path), "--speakers", "2", "--sentences", "1"]) == 0
    return path


def test_every_speaker_has_every_emotion(folder):
    clips = read_emotional(folder)
    assert {(clip.speaker, clip.emotion) for clip in clips} == {
        (f"folders:{who}", emotion) for who in ("P001", "P002") for emotion in HEARD_EMOTIONS
    }
    sounds = {clip.emotion: load_waveform(clip.path) for clip in clips if clip.speaker == "folders:P001"}
    peaks = {name: float(np.abs(sound.samples).max()) for name, sound in sounds.items()}
    assert peaks["neutral"] == pytest.approx(0.7, abs=0.01)
    assert peaks["anger"] > peaks["neutral"] > peaks["sadness"]
    tones = {name: np.median(p[p > 0]) for name, sound in sounds.items() if len(p := pitch(sound, 100))}
    assert tones["fear"] > tones["sadness"]


def test_an_interrupted_run_goes_on_to_the_same_bytes(folder):
    options = EmotionalSpeechOptions(folder, 2, 1)
    lost = folder / "P002" / "joy" / "01.wav"
    before = lost.read_bytes()
    lost.unlink()
    speak_emotions(options, progress=False)
    assert lost.read_bytes() == before
    with pytest.raises(OptionError, match="was begun with speakers 2"):
        speak_emotions(EmotionalSpeechOptions(folder, 3, 1), progress=False)
    with pytest.raises(OptionError, match="sentences"):
        EmotionalSpeechOptions(folder, 2, 81)


def test_voices_are_spread():
    members = speakers(EmotionalSpeechOptions(Path("x"), 30), voices())
    recorded = [member.voice for member in members if not member.voice.startswith("espeak")]
    formant = [member.voice for member in members if member.voice.startswith("espeak")]
    assert len(recorded) == 10
    assert len(set(formant)) == len(formant) == 20
    assert len({(member.voice, member.rate, member.pitch) for member in members}) == 30
