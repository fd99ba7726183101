"""Emotions through the service: what clients say, and what is heard in the voice where they ask for it."""

from importlib.resources import files

import numpy as np
import pytest
import torch
from face_networks import head_regression
from grpc_client import END, FPS, RATE, Answer, Served, grpc, header, messages, pcm, requests, sound
from nvidia_ace.status_pb2 import Status

from meshanim.animator import AnimationOptions, Animator
from meshanim.audio import Waveform, load_encoder, load_waveform
from meshanim.heads import load_head
from meshanim.models.audio2emotion import (
    Audio2Emotion,
    Audio2EmotionConfig,
    EmotionDetector,
    detect_emotions,
    load_audio2emotion,
)
from meshanim.models.audio2face import EmotionTrack
from meshanim.motion.blendshape_csv import ARKIT_SHAPES
from meshanim.motion.blendshape_solver import BlendshapeSolver, SolverOptions
from meshanim.motion.emotions import HEARD_EMOTIONS
from meshanim.serve.stream_emotions import StreamEmotions


@pytest.fixture(scope="module")
def speech():
    return load_waveform(files("meshanim") / "audio/clips/sense_and_sensibility.flac").resampled(RATE)


@pytest.fixture(scope="module")
def joyful_ear(tmp_path_factory):
    """A classifier that hears joy in everything."""
    network = Audio2Emotion(Audio2EmotionConfig(83, "mel"))
    with torch.no_grad():
        network.classify[-1].weight.zero_()
        network.classify[-1].bias.zero_()[HEARD_EMOTIONS.index("joy")] = 30.0
    folder = tmp_path_factory.mktemp("ear")
    network.save_pretrained(folder)
    return folder


@pytest.fixture(scope="module")
def feeling():
    return Animator(head_regression(), load_encoder("mel"), load_head("default"))


@pytest.fixture(scope="module")
def listening(feeling, joyful_ear):
    with Served(feeling, audio2emotion=str(joyful_ear)) as served:
        yield served


def test_emotions_are_followed_over_time(feeling, speech):
    def run(*keys, beginning=None):
        emotions = [messages.EmotionWithTimeCode(time_code=time, emotion=value) for time, value in keys]
        first = header(emotion_params=messages.EmotionParameters(beginning_emotion=beginning or {}))
        data = [first, sound(pcm(speech, 1.5), emotions), END]
        return Answer(served.stub.ProcessAudioStream(iter(data), timeout=60))

    with Served(feeling) as served:
        neutral, joyful = run(), run(beginning={"joy": 1.0})
        assert np.abs(neutral.weights - joyful.weights).max() > 0.02
        later = run((0.0, {"joy": 0.0}), (0.7, {"joy": 0.0}), (0.75, {"joy": 1.0}))
        np.testing.assert_allclose(later.weights[:20], neutral.weights[:20], atol=2e-3)
        np.testing.assert_allclose(later.weights[24:], joyful.weights[24:], atol=2e-3)
        odd = run((0.0, {"outofbreath": 0.5, "joy": 0.0}))
        assert odd.status.code == Status.WARNING
        assert "without effect here: outofbreath" in odd.status.message
        np.testing.assert_allclose(odd.weights, neutral.weights, atol=2e-3)


def asked(served, speech, keys=(), beginning=None, size=3200, transition=None, seconds=4.0, **post):
    """Answer to a client whose header has emotion post-processing."""
    emotions = [messages.EmotionWithTimeCode(time_code=time, emotion=value) for time, value in keys]
    first = header(
        emotion_post_processing_params=messages.EmotionPostProcessingParameters(**post),
        emotion_params=messages.EmotionParameters(
            beginning_emotion=beginning or {}, live_transition_time=transition
        ),
    )
    data = pcm(speech, seconds)
    parts = [data[begin : begin + size] for begin in range(0, len(data), size)]
    sent = [first, sound(parts[0], emotions), *map(sound, parts[1:]), END]
    return Answer(served.stub.ProcessAudioStream(iter(sent), timeout=120))


def test_emotions_are_heard_in_the_voice(listening, feeling, joyful_ear, speech):
    answer = asked(listening, speech, seconds=3.0)
    assert answer.status.code == Status.SUCCESS
    samples = np.frombuffer(pcm(speech, 3.0), "<i2") / np.float32(32768)
    waveform = Waveform(samples.astype(np.float32), RATE)
    detector = EmotionDetector(load_audio2emotion(joyful_ear))
    found = detect_emotions(waveform, detector, emotions=("joy", "anger"), mode="live").track
    track = EmotionTrack(found.times + 0.033, found.strengths)
    motion = feeling(waveform, AnimationOptions(emotions=track, implicit="a"))
    solver = BlendshapeSolver.from_head(feeling.head, SolverOptions(active=ARKIT_SHAPES))
    rows = [feeling.head.expression_names.index(name) for name in ARKIT_SHAPES]
    np.testing.assert_allclose(answer.weights, solver(motion.vertices)[:, rows], atol=2e-3)
    still = feeling(waveform, AnimationOptions())
    assert np.abs(solver(still.vertices)[:, rows] - answer.weights)[80:].max() > 0.02

    assert [time for time, _ in answer.shown] == pytest.approx([(k + 0.5) / FPS for k in range(90)])
    joy = np.array([emotion["joy"] for _, emotion in answer.shown])
    assert joy[:57].max() < 1e-6
    assert 0.4 < joy[-1] < 0.6
    times = (np.arange(90) + 0.5) / FPS
    np.testing.assert_allclose(joy, np.interp(times, track.times, track.strengths[:, 0]), atol=1e-6)


@pytest.mark.parametrize("size", [1777, 96_000])
def test_what_is_heard_does_not_depend_on_where_sound_is_cut(listening, speech, size):
    one, other = (asked(listening, speech, size=cut, seconds=2.6) for cut in (3200, size))
    np.testing.assert_allclose(other.weights, one.weights, atol=2e-3)
    assert other.shown == one.shown


def test_emotion_post_processing_is_the_protocols(listening, speech):
    def last(*keys, transition=1e-4, **options):
        answer = asked(listening, speech, keys, size=96_000, seconds=2.6, transition=transition, **options)
        assert answer.told == list(keys)
        shown = answer.shown[-1][1]
        return shown["joy"], shown["anger"]

    anger = (0.0, {"anger": 1.0})
    assert last(emotion_strength=1.0) == pytest.approx((1.0, 0.0), abs=0.01)
    assert last(emotion_strength=0.0) == (0, 0)
    # What a client sends is preferred, by default at a half.
    assert last(anger) == pytest.approx((0.3, 0.3), abs=0.01)
    assert last(anger, preferred_emotion_strength=1.0) == pytest.approx((0.0, 0.6), abs=1e-6)
    assert last(anger, enable_preferred_emotion=False) == pytest.approx((0.6, 0.0), abs=0.01)
    stuck = last(beginning={"anger": 1.0}, live_blend_coef=1.0)
    assert stuck == pytest.approx((0.0, 0.6), abs=1e-6)
    assert 0.01 < last(transition=5.0)[0] < 0.2


@pytest.mark.parametrize(
    ("post", "message"),
    [
        ({"max_emotions": 7}, "max_emotions is 7; expected 1 to 6"),
        ({"live_blend_coef": -0.5}, "live_blend_coef is -0.5; expected 0 to 1"),
        ({"emotion_contrast": float("nan")}, "emotion_contrast is nan; expected 0 to 3"),
        ({"beginning": {"joy": 3.0}}, "emotions must lie within 0 to 1"),
        ({"transition": -1.0}, "transition_smoothing is -1.0; expected 0 to 10"),
    ],
)
def test_emotion_parameters_out_of_range_are_refused(listening, speech, post, message):
    with pytest.raises(grpc.RpcError) as error:
        asked(listening, speech, **post)
    assert error.value.code() == grpc.StatusCode.INVALID_ARGUMENT
    assert message in error.value.details()


def test_a_service_that_does_not_listen_says_so_and_follows_the_client(feeling, speech):
    with Served(feeling, audio2emotion="none") as served:
        answer = asked(served, speech, [(0.0, {"joy": 0.8})], seconds=1.0)
    assert answer.status.code == Status.WARNING
    assert answer.status.message == "without effect here: emotion_post_processing_params"
    assert answer.shown[-1][1] == pytest.approx({"joy": 0.8, "anger": 0.0})


def test_the_default_network_follows_what_is_heard(joyful_ear, speech):
    animator = Animator.from_pretrained("default")
    with Served(animator, audio2emotion=str(joyful_ear)) as served:
        plain = Answer(served.stub.ProcessAudioStream(requests(pcm(speech, 3.0)), timeout=60))
        answer = asked(served, speech, seconds=3.0, emotion_strength=1.0)
    smile = answer.names.index("MouthSmileLeft")
    np.testing.assert_allclose(answer.weights[:55], plain.weights[:55], atol=2e-3)
    assert answer.weights[80:, smile].mean() > plain.weights[80:, smile].mean() + 0.1


def test_memory_of_a_stream_that_listens_is_bounded(joyful_ear):
    first = header(rate=48000).audio_stream_header
    detector = EmotionDetector(load_audio2emotion(joyful_ear))
    emotions = StreamEmotions(("joy", "anger"), first, detector)
    generator = np.random.default_rng(0)
    for second in range(15):
        emotions.tell([(second + k / 10, {"joy": 0.5}) for k in range(10)], second)
        emotions.hear(generator.normal(0, 0.1, 48000).astype(np.float32), last=second == 14)
        emotions.aggregate(second + 0.5)
        emotions.forget(second + 0.5)
        assert len(emotions.rows) == len(emotions.times) < 70
        assert len(emotions.track.times) < 110
        assert len(emotions.told) < 25
        assert len(emotions.stream.samples) < 3 * RATE
        assert not emotions.news
