"""What a face must do at each phoneme, whatever the sentence and the frame rate."""

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from meshanim.datasets.synthetic.articulation import holds, segments
from meshanim.datasets.synthetic.performance import CURVE_NAMES, perform
from meshanim.datasets.synthetic.style import EMOTIONS, SpeakingStyle
from meshanim.datasets.synthetic.visemes import (
    ARTICULATORS,
    BILABIALS,
    DIPHTHONGS,
    LABIODENTALS,
    PHONEMES,
    VISEMES,
)
from meshanim.errors import OptionError, ShapeError


class Timed(NamedTuple):
    start: float
    end: float
    symbol: str


RATES = [24.0, 25.0, 29.97, 30.0, 60.0]
OPEN = {"AA", "AE", "AY", "AW", "AO"}


def timed(*spoken: tuple[str, float]) -> list[Timed]:
    result, now = [], 0.0
    for symbol, length in spoken:
        result.append(Timed(now, now + length, symbol))
        now += length
    return result


def act(phonemes, fps=30.0, **options):
    return perform(phonemes, int(np.ceil(phonemes[-1].end * fps)), fps, **options)


phoneme_strings = st.lists(
    st.tuples(st.sampled_from([*sorted(PHONEMES), "SIL"]), st.floats(0.045, 0.22)), min_size=1, max_size=14
).map(lambda spoken: timed(("SIL", 0.3), *spoken, ("SIL", 0.3)))
styles = st.integers(0, 10_000).map(SpeakingStyle.random)
emotions = st.sampled_from(sorted(EMOTIONS))


def test_every_phoneme_has_a_target_for_every_articulator():
    for phoneme in PHONEMES:
        for name in DIPHTHONGS.get(phoneme, (phoneme,)):
            assert set(VISEMES[name].dominance) == set(ARTICULATORS)
            channels = {channel for articulator in ARTICULATORS.values() for channel in articulator.channels}
            assert set(VISEMES[name].targets) <= channels


def test_names_are_the_52_of_arkit_and_the_seal():
    assert len(CURVE_NAMES) == len(set(CURVE_NAMES)) == 53
    assert CURVE_NAMES[-1] == "lipSeal"


@settings(max_examples=150, deadline=None)
@given(phoneme_strings, st.sampled_from(RATES), styles, emotions, st.integers(0, 99))
def test_contacts_and_ranges(phonemes, fps, style, emotion, seed):
    performance = act(phonemes, fps, style=style, emotion_name=emotion, seed=seed)
    curves = performance.curves
    assert np.isfinite(curves).all()
    assert curves.min() >= 0
    assert curves.max() <= 1
    assert np.abs(performance.pose).max() < 0.6
    times = (np.arange(len(performance)) + 0.5) / fps
    parts = segments(phonemes, len(performance) / fps)
    jaw, close = performance.curve("jawOpen"), performance.curve("mouthClose")
    for start, end in holds(parts, BILABIALS):
        near = np.abs(times - (start + end) / 2) <= (end - start) / 2 + 1 / fps
        closed = near & (performance.seal == 1)
        assert closed.any()
        assert np.all(performance.seal[(times >= start) & (times <= end)] == 1) or not closed.all()
        assert np.allclose(close[closed], jaw[closed], atol=1e-6)
        assert np.all(performance.curve("lipSeal")[closed] == 1)
        for name in ("mouthLowerDownLeft", "mouthUpperUpRight", "tongueOut", "mouthFunnel"):
            assert np.abs(performance.curve(name)[closed]).max() < 1e-6
    for start, end in holds(parts, LABIODENTALS):
        near = np.abs(times - (start + end) / 2) <= (end - start) / 2 + 1.5 / fps
        touching = near & (performance.labiodental == 1)
        assert touching.any()
        assert jaw[touching].max() < 0.05
        assert performance.curve("mouthRollLower")[touching].min() > 0.35
        assert performance.curve("lipSeal")[touching].max() == 0


@settings(max_examples=40, deadline=None)
@given(
    st.sampled_from(sorted(OPEN)),
    st.sampled_from(["T", "K", "P", "HH", "S"]),
    st.sampled_from(RATES),
    st.floats(0.12, 0.25),
)
def test_open_vowels_open(vowel, consonant, fps, length):
    phonemes = timed(("SIL", 0.3), (consonant, 0.08), (vowel, length), (consonant, 0.08), ("SIL", 0.3))
    performance = act(phonemes, fps)
    times = (np.arange(len(performance)) + 0.5) / fps
    inside = (times > 0.38) & (times < 0.38 + length)
    opening = performance.curve("jawOpen") - performance.curve("mouthClose")
    assert opening[inside].max() > 0.14  # 4 mm between the lips
    assert performance.curve("lipSeal")[inside].min() < 0.15


def test_neighbours_are_felt():
    def rounding(vowel):
        phonemes = timed(("SIL", 0.3), ("S", 0.1), ("T", 0.08), (vowel, 0.15), ("SIL", 0.3))
        return act(phonemes).curve("mouthPucker")[10:14].mean()

    assert rounding("UW") > 0.15
    assert rounding("IY") < 0.02


def test_rest_position_in_pauses_and_no_flapping_before_a_bilabial():
    performance = act(timed(("SIL", 1.0), ("M", 0.1), ("AA", 0.2), ("SIL", 1.0)))
    seal = performance.curve("lipSeal")
    assert seal[:30].min() > 0.9
    assert seal[-6:].min() > 0.9
    assert performance.seal[:20].max() == 0


def test_short_vowels_undershoot_and_accents_overshoot():
    def jaw(length, **options):
        return act(timed(("SIL", 0.3), ("T", 0.08), ("AA", length), ("T", 0.08), ("SIL", 0.3)), **options)

    assert jaw(0.06).curve("jawOpen").max() < 0.75 * jaw(0.18).curve("jawOpen").max()


@pytest.mark.parametrize("seed", range(3))
def test_the_same_motion_at_every_rate(seed):
    phonemes = timed(("SIL", 0.4), ("HH", 0.08), ("AA", 0.2), ("R", 0.1), ("D", 0.1), ("SIL", 3.0))
    slow = perform(phonemes, 110, 30.0, seed=seed)
    fast = perform(phonemes, 330, 90.0, seed=seed)
    assert np.allclose(fast.curves[1::3], slow.curves, atol=2e-3)
    assert np.allclose(fast.pose[1::3], slow.pose, atol=1e-5)


def test_chance_follows_the_seed():
    phonemes = timed(("SIL", 0.4), ("AA", 0.2), ("SIL", 6.0))
    again = [act(phonemes, seed=5).curves for _ in range(2)]
    assert np.array_equal(*again)
    assert not np.array_equal(again[0], act(phonemes, seed=6).curves)


def test_blinks_close_the_lids_at_a_human_rate():
    phonemes = timed(("SIL", 240.0))
    for fps in (24.0, 30.0):
        lids = act(phonemes, fps, style=SpeakingStyle(blinks=0.3)).curve("eyeBlinkLeft")
        events = np.flatnonzero((lids[1:] > 0.5) & (lids[:-1] <= 0.5))
        assert 0.2 < len(events) / 240 < 0.4
        peaks = [lids[event : event + 8].max() for event in events]
        assert min(peaks) > 0.9
        assert np.median(lids) < 0.05


def test_gaze_is_near_the_front_and_moves_in_steps():
    performance = act(timed(("SIL", 60.0)))
    yaw = performance.curve("eyeLookOutLeft") - performance.curve("eyeLookInLeft")
    assert np.allclose(yaw, performance.curve("eyeLookInRight") - performance.curve("eyeLookOutRight"))
    assert np.abs(yaw).max() < 0.95
    assert np.abs(np.median(yaw)) < 0.1
    assert 0.3 < np.mean(np.abs(np.diff(yaw)) > 0.03) * 30 < 6


@settings(max_examples=40, deadline=None)
@given(phoneme_strings, styles, emotions)
def test_nothing_teleports(phonemes, style, emotion):
    performance = act(phonemes, 60.0, style=style, emotion_name=emotion)
    speed = np.abs(np.diff(performance.curves, axis=0)) * 60
    jaw, brow = CURVE_NAMES.index("jawOpen"), CURVE_NAMES.index("browInnerUp")
    assert speed[:, jaw].max() < 16  # 31 mm at weight 1: 0.5 m/s only where a labiodental cuts a vowel short
    assert speed[:, brow].max() < 6
    assert np.abs(np.diff(performance.pose, axis=0)).max() * 60 < 2.0


def test_loud_speech_opens_the_jaw_more():
    phonemes = timed(("SIL", 0.4), ("AA", 0.2), ("D", 0.1), ("AA", 0.2), ("SIL", 0.4))
    steps = (np.arange(130) + 0.5) / 100
    loud = np.where((steps > 0.7) & (steps < 0.9), 0.5, np.where((steps > 0.4) & (steps < 0.6), 0.05, 1e-5))
    jaw = act(phonemes, loudness=loud, rate=100.0).curve("jawOpen")
    assert jaw[20:].max() > 1.2 * jaw[:18].max()


def test_emotions_and_styles_differ_by_intensity():
    phonemes = timed(("SIL", 0.3), ("HH", 0.08), ("EH", 0.1), ("L", 0.08), ("OW", 0.2), ("SIL", 0.3))
    neutral = act(phonemes).curves
    for name in set(EMOTIONS) - {"neutral"}:
        full = act(phonemes, emotion_name=name).curves
        half = act(phonemes, emotion_name=name, intensity=0.5).curves
        assert np.abs(full - neutral).max() > 0.2
        assert np.abs(half - neutral).mean() < np.abs(full - neutral).mean()
        assert np.array_equal(act(phonemes, emotion_name=name, intensity=0.0).curves, neutral)


def test_bad_input_is_named():
    with pytest.raises(OptionError, match="QX"):
        act(timed(("QX", 0.1)))
    with pytest.raises(OptionError, match="follow each other"):
        act([Timed(0.5, 0.6, "AA"), Timed(0.1, 0.2, "B")])
    with pytest.raises(OptionError, match="sulky"):
        act(timed(("AA", 0.1)), emotion_name="sulky")
    with pytest.raises(OptionError, match="jaw"):
        SpeakingStyle(jaw=9.0)
    with pytest.raises(ShapeError):
        act(timed(("AA", 0.1)), pitch=np.ones(4))
    assert len(perform([], 0, 30.0)) == 0
    assert perform([], 1, 30.0).curves.shape == (1, 53)
