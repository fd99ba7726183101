"""Forced alignment and phone recognition against labels of recorded speech."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from meshanim.audio import (
    PHONEMES,
    VISEMES,
    Phoneme,
    Waveform,
    align,
    load_waveform,
    phoneme_frames,
    recognize_phonemes,
)
from meshanim.audio.phonemes import VISEME_OF_PHONEME, pronounce, words_of
from meshanim.audio.synthesis import arpabet
from meshanim.audio.viseme_evaluation import load_clips, scores
from meshanim.errors import FileFormatError, OptionError, ShapeError

DATA = Path(__file__).parent / "data"
TEXT = (DATA / "arctic_a0009.txt").read_text()

pytest.importorskip("pocketsphinx")


@pytest.fixture(scope="module")
def speech():
    return load_waveform(DATA / "arctic_a0009.flac")


def test_visemes_cover_all_phonemes():
    assert len(PHONEMES) == 40
    assert len(VISEMES) == 13
    assert set(VISEME_OF_PHONEME.tolist()) == set(range(13))
    assert Phoneme(0, 1, "P").viseme == Phoneme(0, 1, "M").viseme == "bmp"
    assert Phoneme(0, 1, "SIL").viseme == "sil"


def test_alignment_matches_the_labels_of_arctic(speech):
    phonemes = align(speech, TEXT)
    labels = [
        Phoneme(float(a), float(b), s) for a, b, s in map(str.split, (DATA / "arctic_a0009.phones").open())
    ]
    frames = round(speech.duration * 100)
    agree = phoneme_frames(phonemes, frames, 100) == phoneme_frames(labels, frames, 100)
    assert agree.mean() > 0.8
    true, found = ([p.start for p in ps if p.symbol == "F"] for ps in (labels, phonemes))
    np.testing.assert_allclose(found, true, atol=0.03)


def test_phonemes_cover_the_speech_without_gaps(speech):
    for phonemes in (align(speech, TEXT), recognize_phonemes(speech)):
        assert phonemes[0].start == 0
        assert phonemes[-1].end == pytest.approx(speech.duration)
        assert all(a.end == pytest.approx(b.start) for a, b in pairwise(phonemes))
        assert all(p.end > p.start and p.symbol in PHONEMES for p in phonemes)


def test_alignment_does_not_depend_on_what_was_aligned_before(speech):
    first = align(speech, TEXT)
    align(load_waveform(DATA / "librivox_0930.flac"), (DATA / "librivox_0930.txt").read_text())
    assert align(Waveform(0.1 * speech.samples, speech.rate), TEXT) == first


def test_recognition_finds_most_visemes(speech):
    count = int(speech.duration * 50)
    true, found = (phoneme_frames(ps, count, 50) for ps in (align(speech, TEXT), recognize_phonemes(speech)))
    assert scores([true], [found], [VISEME_OF_PHONEME[found]])["viseme_accuracy"] > 0.6


def test_words_that_the_dictionary_lacks(speech):
    pytest.importorskip("espeakng_loader")
    assert pronounce("blorptastic")[:4] == ["B", "L", "AO", "R"]
    unknown = TEXT.replace("gregson", "gregxon")
    symbols = [p.symbol for p in align(speech, unknown, {"gregxon": "G R EH G S AH N"})]
    assert symbols == [p.symbol for p in align(speech, TEXT)]
    with pytest.raises(OptionError, match="ARPAbet"):
        align(speech, unknown, {"gregxon": "G R E2"})


def test_text_that_is_not_spoken():
    with pytest.raises(ShapeError, match="do not align"):
        align(Waveform(np.zeros(1600), 16000), TEXT)


@pytest.mark.parametrize("text", ["", "...", "chapter 2"])
def test_text_without_words(speech, text):
    with pytest.raises(OptionError):
        align(speech, text)


def test_words():
    assert words_of("Don't say ‘perhaps’, O'Brien!") == ["don't", "say", "perhaps'", "o'brien"]


def test_frames_take_the_phoneme_at_their_centre():
    phonemes = [Phoneme(0.0, 0.03, "B"), Phoneme(0.03, 0.05, "AA")]
    assert [PHONEMES[k] for k in phoneme_frames(phonemes, 4, 50)] == ["B", "AA", "SIL", "SIL"]


def test_ipa():
    assert arpabet("tʃˈɜːl") == ["CH", "ER", "L"]
    assert arpabet("aɪ ˈoʊ") == ["AY", "OW"]
    assert arpabet("") == []


def test_perfect_and_wrong_scores():
    true = [np.repeat(np.arange(40), 5)]
    perfect = scores(true, true, [VISEME_OF_PHONEME[true[0]]])
    assert all(value == 1 for value in perfect.values())
    none = scores(true, [np.zeros(200, np.int64)], [np.zeros(200, np.int64)])
    assert none["bmp_recall"] == none["bmp_precision"] == 0
    assert none["phoneme_accuracy"] == 5 / 200


def test_clips_of_a_folder(tmp_path):
    clips = load_clips(DATA)
    assert clips[0].name == "arctic_a0009"
    assert len(clips) == 6
    assert all(abs(np.abs(c.waveform.samples).max() - 0.7) < 1e-3 for c in clips)
    with pytest.raises(FileFormatError, match="no sound files"):
        load_clips(tmp_path)
    (tmp_path / "a.flac").write_bytes((DATA / "arctic_a0009.flac").read_bytes())
    with pytest.raises(FileFormatError, match=r"a\.txt is missing"):
        load_clips(tmp_path)
    (tmp_path / "a.phones").write_text("0 1 QQ\n")
    with pytest.raises(FileFormatError, match="no phoneme"):
        load_clips(tmp_path)
