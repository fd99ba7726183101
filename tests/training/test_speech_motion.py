import numpy as np
import pytest
import torch
from corpus_small import write_small_corpus

from meshanim.audio import feature_windows, load_encoder
from meshanim.datasets.meshanim_format import MeshanimDataset
from meshanim.errors import FileFormatError, OptionError
from meshanim.training.feature_cache import FeatureCache
from meshanim.training.sampling import WindowSampler
from meshanim.training.speech_motion import SpeechTracks, load_clips


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return MeshanimDataset(write_small_corpus(tmp_path_factory.mktemp("corpus")))


def clips_of(dataset, folder, variants=1):
    cache = FeatureCache(folder, load_encoder("mel"))
    styles, emotions = ("anna", "ben"), ("neutral", "joy")
    return load_clips(dataset, dataset.split("train"), cache, styles, emotions, variants, progress=False)


def test_clips_know_their_subject_style_and_emotion(dataset, tmp_path):
    clips = clips_of(dataset, tmp_path)
    assert [clip.info.subject for clip in clips] == ["anna", "anna", "ben", "ben"]
    assert [clip.style for clip in clips] == [0, 0, 1, 1]
    assert [(clip.emotion, clip.intensity) for clip in clips[:2]] == [(0, 0.0), (1, 0.5)]
    with pytest.raises(OptionError, match="joy"):
        load_clips(
            dataset, dataset.split("train"), FeatureCache(tmp_path, load_encoder("mel")), (), ("neutral",)
        )


def test_features_are_kept_degraded_in_a_repeatable_way_and_checked(dataset, tmp_path):
    first = clips_of(dataset, tmp_path)
    files = sorted(tmp_path.glob("*/*.npy"))
    assert len(files) == 16
    written = [file.stat().st_mtime_ns for file in files]
    again = clips_of(dataset, tmp_path)
    assert [file.stat().st_mtime_ns for file in files] == written
    other = clips_of(dataset, tmp_path / "other")
    for a, b, c in zip(first, again, other):
        for k in (0, 1):
            assert np.array_equal(a.features[k][:], b.features[k][:])
            assert np.array_equal(a.features[k][:], c.features[k][:])
        assert not np.array_equal(a.features[0][:], a.features[1][:])
        assert a.features[0].shape == a.features[1].shape
    files[0].write_bytes(b"broken")
    with pytest.raises(FileFormatError, match="delete it"):
        clips_of(dataset, tmp_path)


def test_tracks_are_the_feature_windows_of_every_clip():
    generator = torch.Generator().manual_seed(0)
    tracks = [[torch.randn(n, 3, generator=generator).half().numpy() for _ in range(2)] for n in (40, 3, 17)]
    reader = SpeechTracks(tracks, 50.0, 6)
    fps = 24.0
    for clip, variants in enumerate(tracks):
        frames = round(len(variants[0]) / 50 * fps) + 1
        times = (torch.arange(frames, dtype=torch.float64) + 0.5) / fps
        for k, track in enumerate(variants):
            number = torch.full((frames,), clip)
            found = reader.windows(number, torch.full((frames,), k), times)
            expected = feature_windows(torch.from_numpy(track).float(), 50.0, fps, frames, width=6)
            torch.testing.assert_close(found, expected, atol=1e-6, rtol=1e-5)


def test_every_window_comes_once_an_epoch_and_is_consecutive():
    sampler = WindowSampler([40, 7, 3, 12], frames=4, windows=7, seed=1)
    assert len(sampler.slots) == 10 + 1 + 3
    picks = [sampler.spans(number) for number in range(4)]
    epoch = [(span.clip, span.first) for batch in picks[:2] for span in batch]
    assert {clip for clip, _ in epoch} == {0, 1, 3}
    assert np.bincount([clip for clip, _ in epoch]).tolist() == [10, 1, 0, 3]
    for clip, first in epoch:
        assert 0 <= first <= [40, 7, 3, 12][clip] - 4
    assert picks[:2] != picks[2:]
    fresh = WindowSampler([40, 7, 3, 12], frames=4, windows=7, seed=1)
    assert [fresh.spans(number) for number in (3, 0)] == [picks[3], picks[0]]
    with pytest.raises(OptionError, match="4 consecutive"):
        WindowSampler([3, 2], frames=4, windows=1)
