"""Audio2Emotion: windows, streams, post-processing against hand-made numbers, checkpoints."""

import csv
from itertools import pairwise

import numpy as np
import pytest
import torch

from meshanim.audio import Waveform, load_encoder, load_waveform
from meshanim.errors import FileFormatError, OptionError, ShapeError
from meshanim.models.audio2emotion import (
    Audio2Emotion,
    Audio2EmotionConfig,
    EmotionDetector,
    EmotionOptions,
    EmotionPostProcessor,
    EmotionStream,
    detect_emotions,
    load_audio2emotion,
)
from meshanim.models.audio2emotion.detection import Timeline
from meshanim.models.audio2emotion.features import EmotionFeatures, loudest
from meshanim.models.audio2face import EmotionTrack
from meshanim.motion.emotions import EMOTIONS, HEARD_EMOTIONS

PLAIN = EmotionOptions(max_emotions=6, live_blend_coef=0.0, transition_smoothing=0.0, emotion_strength=1.0)


@pytest.fixture(scope="module")
def speech():
    """Two seconds of a man's voice, then a pause, then the voice again: 4.7 s."""
    voice = load_waveform("tests/audio/data/arctic_a0009.flac").samples[:32000]
    return Waveform(np.concatenate([voice, np.zeros(16000), voice[:27000]]), 16000)


@pytest.fixture(scope="module")
def network():
    """Random weights that make every input matter."""
    torch.manual_seed(3)
    network = Audio2Emotion(Audio2EmotionConfig(163)).eval()
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    return network


@pytest.fixture(scope="module")
def detector(network):
    return EmotionDetector(network)


def test_windows_reach_the_end_and_no_further():
    timeline = Timeline()
    for seconds, count in ((0.1, 1), (1.9, 1), (1.91, 2), (2.4, 2), (2.41, 3), (10.0, 18)):
        samples = round(16000 * seconds)
        assert timeline.windows(samples) == count
        spans = [timeline.span(k, samples) for k in range(count)]
        assert spans[0][0] == 0
        assert spans[-1][1] == samples
        assert all(end - start <= 30400 for start, end in spans)
        assert all(later[0] - earlier[0] == 8000 for earlier, later in pairwise(spans))
    with pytest.raises(OptionError, match="stride"):
        Timeline(stride=2.0)


def test_a_window_is_the_mean_of_its_stretches(detector, network, speech):
    window = speech.samples[:30400]
    logits = [
        network(detector.features.alone(window[start : start + 10000])[None])[0]
        for start in (0, 4960, 9920, 14880, 19840)
    ]
    expected = torch.stack(logits).double().softmax(1).mean(0).detach().numpy()
    np.testing.assert_allclose(detector.probabilities(window), expected, atol=1e-7)
    assert np.ptp(expected) > 0.01
    short = detector.probabilities(window[:3000])
    np.testing.assert_allclose(short, detector.probabilities(np.pad(window[:3000], (0, 7000))), atol=1e-7)


def test_loudness_of_the_file_does_not_matter_but_silence_is_neutral(detector, speech):
    window = speech.samples[:30400]
    np.testing.assert_allclose(
        detector.probabilities(0.1 * window), detector.probabilities(window), atol=1e-3
    )
    silent = detector.probabilities(np.zeros(30400, np.float32))
    np.testing.assert_array_equal(silent, np.eye(6)[HEARD_EMOTIONS.index("neutral")])


def test_files_are_linear_between_windows(detector, speech):
    found = detect_emotions(speech, detector, PLAIN)
    assert len(found.times) == 7
    np.testing.assert_allclose(found.times[:3], [0.95, 1.45, 1.95])
    np.testing.assert_allclose(found.probabilities.sum(1), 1)
    raw = np.stack([np.interp(found.track.times, found.times, p) for p in found.probabilities.T], 1)
    for name in HEARD_EMOTIONS:
        if name != "neutral":
            expected = raw[:, HEARD_EMOTIONS.index(name)]
            np.testing.assert_allclose(found.track.strengths[:, EMOTIONS.index(name)], expected, atol=1e-6)
    others = [k for k, name in enumerate(EMOTIONS) if name not in HEARD_EMOTIONS]
    assert not found.track.strengths[:, others].any()
    assert found.track.times[-1] < speech.duration <= found.track.times[-1] + 0.033 + 1e-9


@pytest.mark.parametrize("sizes", [(75200,), (1, 4000, 1777), (16000,), (513,)])
def test_streams_give_what_the_whole_gives(detector, speech, sizes):
    options = EmotionOptions(transition_smoothing=0.1)
    whole = detect_emotions(speech, detector, options, mode="live").track.strengths
    stream, parts, at, number = EmotionStream(detector, options), [], 0, 0
    while at < len(speech.samples):
        size = sizes[number % len(sizes)]
        parts.append(stream.push(speech.samples[at : at + size]))
        at, number = at + size, number + 1
    parts.append(stream.finish())
    np.testing.assert_array_equal(np.concatenate(parts), whole)
    assert len(stream.samples) < 2 * 30400
    with pytest.raises(OptionError, match="finished"):
        stream.push(np.zeros(3))


def test_a_live_frame_knows_no_later_sound(detector, speech):
    changed = speech.samples.copy()
    changed[48000:] = changed[:27000][::-1][: len(changed) - 48000].mean()
    one, other = (
        detect_emotions(Waveform(s, 16000), detector, PLAIN, mode="live").track.strengths
        for s in (speech.samples, changed)
    )
    known = int(3.0 / 0.033)
    np.testing.assert_array_equal(one[:known], other[:known])
    assert np.abs(one - other).max() > 1e-3
    assert one[: int(1.9 / 0.033)].max() < 1e-6  # before the first window has ended: neutral


def test_post_processing_in_pieces_is_that_of_the_whole():
    rows = np.random.default_rng(0).dirichlet(np.ones(6), 50)
    options = EmotionOptions(
        emotion_contrast=1.4, enable_preferred_emotion=True, preferred={"joy": 0.8}, beginning={"fear": 1.0}
    )
    whole = EmotionPostProcessor(options).push(rows)
    pieces = EmotionPostProcessor(options)
    parts = [pieces.push(rows[a:b]) for a, b in ((0, 1), (1, 1), (1, 20), (20, 50))]
    np.testing.assert_array_equal(np.concatenate(parts), whole)


def test_each_option_by_hand():
    row = np.array([[0.5, 0.2, 0.05, 0.1, 0.1, 0.05]])  # anger disgust fear joy neutral sadness
    face = ("anger", "disgust", "fear", "joy", "sadness")

    def result(times=1, probabilities=row, **changes):
        options = {**vars(PLAIN), **changes}
        return EmotionPostProcessor(EmotionOptions(**options), face).push(np.repeat(probabilities, times, 0))

    np.testing.assert_allclose(result()[0], [0.5, 0.2, 0.05, 0.1, 0.05], atol=1e-7)
    squares = row[0] ** 2 / (row[0] ** 2).sum()
    np.testing.assert_allclose(result(emotion_contrast=2.0)[0], squares[[0, 1, 2, 3, 5]], atol=1e-7)
    np.testing.assert_allclose(result(max_emotions=2)[0], [0.5, 0.2, 0, 0, 0], atol=1e-7)
    # Neutral takes no place among the strongest.
    calm = np.array([[0.2, 0.1, 0.0, 0.0, 0.7, 0.0]])
    np.testing.assert_allclose(result(probabilities=calm, max_emotions=1)[0], [0.2, 0, 0, 0, 0], atol=1e-7)
    smooth = result(3, live_blend_coef=0.7)[:, 0]
    np.testing.assert_allclose(smooth, 0.5 * (1 - 0.7 ** np.arange(1, 4)), atol=1e-7)
    preferred = {
        "enable_preferred_emotion": True,
        "preferred": {"joy": 1.0},
        "preferred_emotion_strength": 0.25,
    }
    np.testing.assert_allclose(result(**preferred)[0], [0.375, 0.15, 0.0375, 0.325, 0.0375], atol=1e-7)
    preferred["enable_preferred_emotion"] = False
    np.testing.assert_allclose(result(**preferred), result())
    moving = result(2, transition_smoothing=0.33)[:, 0]
    np.testing.assert_allclose(moving, [0.05, 0.095], atol=1e-7)
    np.testing.assert_allclose(result(transition_smoothing=0.01), result())
    np.testing.assert_allclose(result(emotion_strength=0.5), 0.5 * result())
    begun = result(beginning={"sadness": 1.0}, live_blend_coef=0.5)[0]
    np.testing.assert_allclose(begun, [0.25, 0.1, 0.025, 0.05, 0.525], atol=1e-7)
    other = result(correspondence={"anger": "joy", "disgust": "joy"})[0]
    np.testing.assert_allclose(other, [0, 0, 0, 0.7, 0], atol=1e-7)


def test_preferred_emotions_may_change_and_only_count_where_there_are_some():
    rows = np.random.default_rng(1).dirichlet(np.ones(6), 40)
    plain = EmotionPostProcessor(EmotionOptions()).push(rows)
    wanting = EmotionOptions(enable_preferred_emotion=True)
    np.testing.assert_array_equal(EmotionPostProcessor(wanting).push(rows), plain)
    wishes = np.zeros((40, 10))
    wishes[:, EMOTIONS.index("joy")] = 0.8
    constant = EmotionOptions(enable_preferred_emotion=True, preferred={"joy": 0.8})
    told = EmotionPostProcessor(wanting).push(rows, wishes)
    np.testing.assert_array_equal(told, EmotionPostProcessor(constant).push(rows))
    wishes[20:] = 0
    later = EmotionPostProcessor(wanting).push(rows, wishes)
    np.testing.assert_array_equal(later[:20], told[:20])
    assert later[-1, EMOTIONS.index("joy")] < 0.1 < told[-1, EMOTIONS.index("joy")]
    np.testing.assert_array_equal(EmotionPostProcessor(EmotionOptions()).push(rows, wishes), plain)
    stuck = EmotionOptions(live_blend_coef=1.0, beginning={"fear": 0.5}, emotion_strength=1.0)
    np.testing.assert_allclose(EmotionPostProcessor(stuck).push(rows)[:, EMOTIONS.index("fear")], 0.5)


def test_streams_follow_preferred_emotions_over_time(detector, speech):
    options = EmotionOptions(
        enable_preferred_emotion=True, preferred_emotion_strength=1.0, emotion_strength=1.0,
        transition_smoothing=0.0, live_blend_coef=0.0,
    )  # fmt: skip
    stream = EmotionStream(detector, options)
    stream.preferred = EmotionTrack.of(EMOTIONS, (1.0, {"joy": 0.0}), (2.0, {"joy": 1.0}))
    starts = range(0, len(speech.samples), 4000)
    parts = [stream.push(speech.samples[first : first + 4000]) for first in starts]
    joy = np.concatenate(parts)[:, EMOTIONS.index("joy")]
    np.testing.assert_allclose(joy, np.clip(np.arange(len(joy)) * 0.033 - 1, 0, 1), atol=1e-6)


def test_a_neutral_sample_is_heard(network, speech):
    encoder = load_encoder("visemes:hidden")
    features = EmotionFeatures(network.config, encoder)
    heard, reference = features.after(speech.samples[:10000], speech.samples)
    assert heard.shape == features.alone(speech.samples[:10000]).shape == (32, 163)
    assert reference.shape == (25, 163)
    none = network(heard[None], reference[None], torch.zeros(1))
    torch.testing.assert_close(none, network(heard[None]))
    assert (network(heard[None], reference[None]) - none).abs().max() > 1e-3
    # Shared normalisation: against a quiet neutral sample the same stretch is loud.
    quiet, _ = features.after(speech.samples[:10000], 0.1 * speech.samples)
    assert (quiet[:, 162] - heard[:, 162]).mean() > 0.2
    told = EmotionDetector(network, encoder, speech)
    plain = EmotionDetector(network, encoder)
    window = speech.samples[:30400]
    assert np.abs(told.probabilities(window) - plain.probabilities(window)).max() > 1e-3


def test_the_loudest_stretch():
    samples = np.zeros(48000, np.float32)
    samples[20000:30000] = 1
    assert loudest(samples, 10000).sum() > 9000
    np.testing.assert_array_equal(loudest(samples[:5000], 8000), np.zeros(8000))


def test_checkpoints(network, tmp_path):
    network.save_pretrained(tmp_path / "run" / "model")
    back = load_audio2emotion(tmp_path / "run")
    assert back.config == network.config
    features = torch.randn(2, 32, 163)
    torch.testing.assert_close(back(features), network(features))
    config = tmp_path / "run" / "model" / "config.json"
    weights = tmp_path / "run" / "model" / "model.safetensors"
    whole = weights.read_bytes()
    weights.write_bytes(whole[:1000])
    with pytest.raises(FileFormatError, match="no checkpoint"):
        load_audio2emotion(tmp_path / "run")
    weights.write_bytes(whole)
    config.write_text(config.read_text().replace('"width": 96', '"width": 64'))
    with pytest.raises(FileFormatError, match="no checkpoint"):
        load_audio2emotion(tmp_path / "run")
    config.write_text("{}")
    with pytest.raises(FileFormatError, match="no classifier"):
        load_audio2emotion(tmp_path / "run")
    with pytest.raises(FileFormatError, match="nothing"):
        load_audio2emotion(tmp_path / "nothing")


def test_the_table(detector, speech, tmp_path):
    found = detect_emotions(speech, detector)
    found.save(tmp_path / "emotions.csv")
    with open(tmp_path / "emotions.csv", newline="") as text:
        header, *rows = list(csv.reader(text))
    assert ",".join(header) == (
        ",time_code,emotion_values.amazement,emotion_values.anger,emotion_values.cheekiness,"
        "emotion_values.disgust,emotion_values.fear,emotion_values.grief,emotion_values.joy,"
        "emotion_values.outofbreath,emotion_values.pain,emotion_values.sadness"
    )
    assert [int(row[0]) for row in rows] == list(range(len(rows)))
    values = np.array([[float(cell) for cell in row[1:]] for row in rows])
    np.testing.assert_array_equal(values[:, 0], found.track.times)
    np.testing.assert_array_equal(values[:, 1:], found.track.strengths)
    with pytest.raises(OptionError, match=r"\.csv"):
        found.save(tmp_path / "emotions.txt")


def test_bad_input_is_named(network, detector):
    for change, message in (
        ({"emotion_contrast": 9}, "emotion_contrast"),
        ({"max_emotions": 0}, "max_emotions"),
        ({"live_blend_coef": 1.1}, "live_blend_coef"),
        ({"fixed_dt": 0}, "fixed_dt"),
        ({"correspondence": {"boredom": "joy"}}, "boredom"),
    ):
        with pytest.raises(OptionError, match=message):
            EmotionOptions(**change)
    for change in ({"preferred": {"bliss": 1.0}}, {"beginning": {"joy": 2.0}}):
        with pytest.raises(OptionError, match=r"bliss|joy"):
            EmotionPostProcessor(EmotionOptions(**change))
    for row in (np.full((1, 6), np.nan), np.full((1, 6), -0.1)):
        with pytest.raises(ShapeError, match="finite"):
            EmotionPostProcessor(EmotionOptions()).push(row)
    stream = EmotionStream(detector)
    with pytest.raises(ShapeError, match="NaN"):
        stream.push(np.array([np.nan]))
    with pytest.raises(ShapeError, match="no samples"):
        stream.finish()
    with pytest.raises(OptionError, match="visemes:hidden"):
        EmotionDetector(network, load_encoder("mel"))
    for change in ({"feature_dim": 0}, {"feature_dim": 3, "dropout": 1.0}, {"feature_dim": 3, "crop": 0.0}):
        with pytest.raises(OptionError, match=r"feature_dim|crop"):
            Audio2EmotionConfig(**change)
