"""The classifier that ships: small, and it tells the corpus's emotions apart in voices it has not heard."""

from pathlib import Path

import numpy as np
import pytest

from meshanim.audio import Waveform, load_waveform
from meshanim.datasets.emotional import read_emotional
from meshanim.datasets.synthetic.emotional_speech import EmotionalSpeechOptions, speak_emotions
from meshanim.models.audio2emotion import EmotionDetector, load_audio2emotion
from meshanim.motion.emotions import HEARD_EMOTIONS


def test_it_is_small():
    folder = Path("meshanim/models/weights/audio2emotion-default")
    assert sum(path.stat().st_size for path in folder.iterdir()) < 2e6
    network = load_audio2emotion()
    assert sum(parameter.numel() for parameter in network.parameters()) == 112_519


@pytest.fixture(scope="module")
def strangers(tmp_path_factory):
    """Three speakers of another seed: other voices of espeak-ng, other rates and pitches."""
    folder = tmp_path_factory.mktemp("strangers") / "speech"
    speak_emotions(EmotionalSpeechOptions(folder, 3, 1, seed=77), progress=False)
    return read_emotional(folder)


def test_anger_sounds_angrier_than_sadness_beside_a_neutral_sample(strangers):
    network, anger = load_audio2emotion(), HEARD_EMOTIONS.index("anger")
    heard: dict[str, list[float]] = {"anger": [], "sadness": []}
    for speaker in sorted({clip.speaker for clip in strangers}):
        sounds = {clip.emotion: load_waveform(clip.path) for clip in strangers if clip.speaker == speaker}
        detector = EmotionDetector(network, neutral=sounds["neutral"])
        for emotion, values in heard.items():
            values.append(detector.keys(sounds[emotion])[1].mean(0)[anger])
    assert np.mean(heard["anger"]) > np.mean(heard["sadness"]) + 0.1


def test_silence_is_neutral():
    detector = EmotionDetector(load_audio2emotion())
    _, probabilities = detector.keys(Waveform(np.zeros(48000, np.float32), 16000))
    np.testing.assert_array_equal(probabilities.argmax(1), HEARD_EMOTIONS.index("neutral"))
