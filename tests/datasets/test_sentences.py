"""The built-in sentences: pronounceable, balanced, and with enough closed lips."""

from collections import Counter

import pytest

from meshanim.audio.phonemes import words_of
from meshanim.datasets.synthetic.sentences import SENTENCES
from meshanim.datasets.synthetic.visemes import BILABIALS, LABIODENTALS, PHONEMES


@pytest.fixture(scope="module")
def dictionary():
    pocketsphinx = pytest.importorskip("pocketsphinx")
    entries = {}
    with open(pocketsphinx.get_model_path("en-us/cmudict-en-us.dict"), encoding="utf-8") as file:
        for line in file:
            word, *phonemes = line.split()
            entries.setdefault(word, phonemes)
    return entries


def counts(dictionary, sentences):
    return Counter(symbol for text in sentences for word in words_of(text) for symbol in dictionary[word])


def test_sentences_are_many_different_and_of_speakable_length():
    assert len(SENTENCES) == len(set(SENTENCES)) == 80
    lengths = [len(words_of(text)) for text in SENTENCES]
    assert min(lengths) >= 7
    assert max(lengths) <= 14


def test_every_word_can_be_aligned(dictionary):
    assert {word for text in SENTENCES for word in words_of(text)} <= set(dictionary)


@pytest.mark.parametrize(("number", "least"), [(80, 10), (40, 6), (20, 2)])
def test_every_phoneme_is_spoken_often(dictionary, number, least):
    spoken = counts(dictionary, SENTENCES[:number])
    assert set(spoken) == set(PHONEMES)
    assert min(spoken.values()) >= least


def test_lips_close_often(dictionary):
    spoken = counts(dictionary, SENTENCES)
    share = sum(spoken[symbol] for symbol in BILABIALS) / spoken.total()
    assert 0.10 < share < 0.16  # about 0.09 in running English
    assert sum(spoken[symbol] for symbol in LABIODENTALS) / spoken.total() > 0.04
