"""Training of the viseme encoder: reproducible speech, reproducible batches, exact resume."""

import json
import random

import numpy as np
import pytest
import torch

from meshanim.audio import PHONEMES
from meshanim.audio.augmentation import degrade, mask_features, resample_clip
from meshanim.audio.phonemes import aligner, words_of
from meshanim.audio.synthesis import voices
from meshanim.audio.viseme_corpus import FAMILIES, generate_sentence, load_corpus, speak_corpus
from meshanim.audio.viseme_training import TrainingConfig, VisemeBatches, train
from meshanim.audio.visemes import VisemeNet, load_viseme_net
from meshanim.errors import FileFormatError

SMALL = TrainingConfig(steps=4, batch=2, seconds=1.0, save_every=2)


@pytest.fixture(scope="module")
def corpus(tmp_path_factory):
    """Two families, tones whose pitch is the label."""
    folder = tmp_path_factory.mktemp("corpus")
    generator = np.random.default_rng(0)
    for family in ("flite", "pico"):
        frames = np.array([150, 90, 200])
        labels = generator.integers(0, len(PHONEMES), frames.sum() // 10).repeat(10).astype(np.uint8)
        phase = np.cumsum(2 * np.pi * (100 + 80.0 * labels.repeat(160)) / 16000)
        samples = (8000 * np.sin(phase)).astype(np.int16)
        np.savez(
            folder / f"{family}-000.npz",
            samples=samples,
            labels=labels,
            frames=frames,
            voices=np.array([f"{family}:a", f"{family}:b", f"{family}:a"]),
        )
    return folder


def test_sentences_are_of_words_that_can_be_aligned():
    sentences = [generate_sentence(random.Random(k)) for k in range(300)]
    assert sentences == [generate_sentence(random.Random(k)) for k in range(300)]
    assert len(set(sentences)) > 290
    pytest.importorskip("pocketsphinx")
    dictionary = aligner()
    pronunciations = {w: dictionary.lookup_word(w) for s in sentences for w in words_of(s)}
    assert None not in pronunciations.values()
    assert {p for said in pronunciations.values() for p in said.split()} == set(PHONEMES[1:])


def test_spoken_corpus_does_not_depend_on_processes_and_resumes(tmp_path):
    if set(FAMILIES) - {v.partition(":")[0] for v in voices()}:
        pytest.skip("needs flite, Pico and espeak-ng")
    speak_corpus(tmp_path / "one", hours=0.001, seed=3, processes=1)
    (tmp_path / "two").mkdir()
    kept = tmp_path / "two" / "flite-000.npz"
    kept.write_bytes((tmp_path / "one" / "flite-000.npz").read_bytes())
    before = kept.stat().st_mtime_ns
    speak_corpus(tmp_path / "two", hours=0.001, seed=3, processes=2)
    assert kept.stat().st_mtime_ns == before
    one, two = load_corpus(tmp_path / "one"), load_corpus(tmp_path / "two")
    assert [u.voice for u in one] == [u.voice for u in two]
    assert {u.family for u in one} == set(FAMILIES)
    for a, b in zip(one, two):
        np.testing.assert_array_equal(a.samples, b.samples)
        np.testing.assert_array_equal(a.labels, b.labels)
        assert len(a.samples) == 160 * len(a.labels)


def test_clips_keep_labels_with_their_samples(corpus):
    batches = VisemeBatches(load_corpus(corpus), SMALL)
    for seed, speed in ((0, 1.0), (1, 0.87), (2, 1.15)):
        samples, labels = batches.clip(np.random.default_rng(seed), speed)
        assert len(samples) == 16000
        assert len(labels) == 100
        for k in range(2, 98):
            if len(set(labels[k - 2 : k + 3])) > 1:
                continue
            frame = samples[k * 160 - 160 : k * 160 + 320]
            if np.abs(frame).max() < 0.01:  # a pause
                assert labels[k] == 0
                continue
            spectrum = np.abs(np.fft.rfft(frame * np.hanning(480), 8192))
            assert spectrum.argmax() * 16000 / 8192 / speed == pytest.approx(100 + 80 * labels[k], abs=15)


def test_batches_of_a_step_are_reproducible(corpus):
    net = VisemeNet()
    batches = VisemeBatches(load_corpus(corpus), SMALL)
    again = VisemeBatches(load_corpus(corpus), SMALL)
    for step in (3, 1):
        first, second = batches(step, net), again(step, net)
        torch.testing.assert_close(first, second, atol=0, rtol=0)
        mel, labels = first
        assert mel.shape == (2, 80, 100)
        assert labels.shape == (2, 50)
        assert mel.isfinite().all()
    assert not torch.equal(batches(3, net)[0], batches(1, net)[0])


def test_augmentation_keeps_shape_and_range():
    generator = np.random.default_rng(0)
    clips = generator.normal(0, 0.1, (6, 8000)).astype(np.float32)
    for _ in range(5):
        out = degrade(clips, generator, lambda g, n: g.normal(0, 1, n).astype(np.float32))
        assert out.shape == clips.shape
        assert out.isfinite().all()
        assert (out.abs().amax(1) <= 0.7 * 10 ** (6 / 20) + 1e-3).all()
    ramp = np.arange(100, dtype=np.float32)
    np.testing.assert_allclose(resample_clip(ramp, 80, 1.1), np.arange(80) * 1.1, rtol=1e-5)
    features = torch.ones(8, 50, 80)
    mask_features(features, generator)
    assert 0 < (features == 0).float().mean() < 0.4


class Interrupted(Exception):
    pass


def test_interrupted_training_equals_uninterrupted(corpus, tmp_path, monkeypatch):
    whole = train(corpus, tmp_path / "whole", SMALL)

    batch = VisemeBatches.__call__

    def stop(self, step, net):
        if step == 3:
            raise Interrupted
        return batch(self, step, net)

    with monkeypatch.context() as context:
        context.setattr(VisemeBatches, "__call__", stop)
        with pytest.raises(Interrupted):
            train(corpus, tmp_path / "parts", SMALL)
    resumed = train(corpus, tmp_path / "parts", SMALL)
    assert resumed.read_bytes() == whole.read_bytes()
    about = json.loads(resumed.with_suffix(".json").read_text())
    assert about["training"]["steps"] == 4
    load_viseme_net(resumed)
    with pytest.raises(FileFormatError, match="another configuration"):
        train(corpus, tmp_path / "parts", TrainingConfig(steps=5, batch=2, seconds=1.0))


def test_corpora_that_are_none(tmp_path):
    with pytest.raises(FileFormatError, match="no shards"):
        load_corpus(tmp_path)
    (tmp_path / "flite-000.npz").write_bytes(b"PK but no archive")
    with pytest.raises(FileFormatError, match="flite-000"):
        load_corpus(tmp_path)
