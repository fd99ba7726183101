"""The service as its clients see it: NVIDIA's own stubs, over a socket."""

import gc
import resource
import shutil
import subprocess
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from importlib.resources import files

import numpy as np
import pytest
from grpc_client import END, FPS, RATE, Answer, Served, grpc, header, messages, pcm, requests, sound

from meshanim.animator import AnimationOptions, Animator
from meshanim.audio import Waveform, load_waveform
from meshanim.cli import main
from meshanim.motion.blendshape_csv import ARKIT_SHAPES
from meshanim.motion.blendshape_solver import BlendshapeSolver, SolverOptions
from meshanim.motion.post_processing import PRESETS, PostTrack
from meshanim.serve.grpc_service import MESSAGE

from nvidia_ace.status_pb2 import Status  # isort: skip


@pytest.fixture(scope="module")
def animator():
    return Animator.from_pretrained("default")


@pytest.fixture(scope="module")
def served(animator):
    with Served(animator, streams=8) as served:
        yield served


@pytest.fixture(scope="module")
def speech():
    return load_waveform(files("meshanim") / "audio/clips/sense_and_sensibility.flac").resampled(RATE)


@pytest.fixture(scope="module")
def spoken(served, speech):
    return Answer(served.stub.ProcessAudioStream(requests(pcm(speech, 2.0)), timeout=60))


def test_a_stream_is_a_header_frames_an_event_and_a_status(spoken, speech):
    assert spoken.order == ["animation_data_stream_header", "animation_data", "event", "status"]
    assert spoken.names == [name[0].upper() + name[1:] for name in ARKIT_SHAPES]
    assert abs(spoken.begun - time.time()) < 600
    assert spoken.status.code == Status.SUCCESS
    assert spoken.sound == pcm(speech, 2.0)
    np.testing.assert_allclose(spoken.times, np.arange(60) / FPS)


def test_the_weights_are_those_of_the_animated_head(spoken, animator, speech):
    samples = np.frombuffer(pcm(speech, 2.0), "<i2") / np.float32(32768)
    motion = animator(Waveform(samples.astype(np.float32), RATE), AnimationOptions())
    solver = BlendshapeSolver.from_head(animator.head, SolverOptions(active=ARKIT_SHAPES))
    rows = [animator.head.expression_names.index(name) for name in ARKIT_SHAPES]
    np.testing.assert_allclose(spoken.weights, solver(motion.vertices)[:, rows], atol=2e-3)
    jaw = spoken.names.index("JawOpen")
    assert np.ptp(spoken.weights[:, jaw]) > 0.1


@pytest.mark.parametrize("size", [777, 64_000])
def test_sound_may_be_cut_anywhere(served, speech, spoken, size):
    other = Answer(served.stub.ProcessAudioStream(requests(pcm(speech, 2.0), size), timeout=60))
    np.testing.assert_allclose(other.weights, spoken.weights, atol=2e-3)
    assert other.sound == spoken.sound


def test_factors_offsets_and_limits_of_shapes(served, speech, spoken):
    parameters = messages.BlendShapeParameters(
        bs_weight_multipliers={"JawOpen": 3.0, "TongueTipUp": 1.0},
        bs_weight_offsets={"JawOpen": -0.2, "MouthPucker": 0.5},
        enable_clamping_bs_weight=True,
    )
    data = requests(pcm(speech, 2.0), blendshape_params=parameters)
    other = Answer(served.stub.ProcessAudioStream(data, timeout=60))
    expected = spoken.weights.copy()
    expected[:, spoken.names.index("JawOpen")] *= 3
    expected[:, spoken.names.index("JawOpen")] -= 0.2
    expected[:, spoken.names.index("MouthPucker")] += 0.5
    np.testing.assert_allclose(other.weights, expected.clip(0, 1), atol=6e-3)


def test_controls_of_the_face_are_those_of_post_processing(served, speech, animator):
    parameters = messages.FaceParameters(
        float_params={"lowerFaceStrength": 0.4, "lipOpenOffset": 0.1, "someday": 1.0}
    )
    data = requests(pcm(speech, 2.0), face_params=parameters)
    answer = Answer(served.stub.ProcessAudioStream(data, timeout=60))
    samples = np.frombuffer(pcm(speech, 2.0), "<i2") / np.float32(32768)
    controls = replace(PRESETS["neutral"], lower_face_strength=0.4, lip_open_offset=0.1)
    options = AnimationOptions(controls=PostTrack.of(controls))
    motion = animator(Waveform(samples.astype(np.float32), RATE), options)
    solver = BlendshapeSolver.from_head(animator.head, SolverOptions(active=ARKIT_SHAPES))
    rows = [animator.head.expression_names.index(name) for name in ARKIT_SHAPES]
    np.testing.assert_allclose(answer.weights, solver(motion.vertices)[:, rows], atol=2e-3)
    assert answer.status.code == Status.WARNING
    assert answer.status.message == "without effect here: someday"
    data = requests(pcm(speech, 0.1), face_params=messages.FaceParameters(float_params={"skinStrength": 9}))
    code, details = refused(served.stub.ProcessAudioStream(data, timeout=60))
    assert (code, details) == (grpc.StatusCode.INVALID_ARGUMENT, "skin_strength is 9; expected 0 to 2")


def test_sound_of_another_rate_comes_back_as_it_was(served, speech):
    slow = speech.resampled(22050)
    data = (slow.samples[:22050].clip(-1, 1) * 32767).astype("<i2").tobytes()
    answer = Answer(served.stub.ProcessAudioStream(requests(data, rate=22050), timeout=60))
    assert answer.sound == data
    assert len(answer.weights) == FPS


def test_several_clients_at_once_get_what_one_gets(served, speech, spoken):
    with ThreadPoolExecutor(3) as pool:
        runs = [
            pool.submit(
                lambda: Answer(served.stub.ProcessAudioStream(requests(pcm(speech, 2.0)), timeout=120))
            )
            for _ in range(3)
        ]
        for run in runs:
            np.testing.assert_allclose(run.result().weights, spoken.weights, atol=2e-3)


class Held:
    """A client that says nothing until it is let go."""

    def __init__(self, stub, *first):
        self.go = threading.Event()
        self.call = stub.ProcessAudioStream(self._requests(first), timeout=60)

    def _requests(self, first):
        yield from first
        self.go.wait(30)

    def leave(self):
        self.call.cancel()
        self.go.set()


def refused(call):
    with pytest.raises(grpc.RpcError) as error:
        list(call)
    return error.value.code(), error.value.details()


def is_served(served, speech):
    """Whether a good client gets its frames; slots of others that left may need a moment."""

    def run():
        return len(Answer(served.stub.ProcessAudioStream(requests(pcm(speech, 0.5)), timeout=60)).weights)

    return patient(run)


def patient(run):
    """Try again while the server is full."""
    for _ in range(100):
        try:
            return run()
        except grpc.RpcError as error:
            if error.code() != grpc.StatusCode.RESOURCE_EXHAUSTED:
                raise
            time.sleep(0.1)
    raise AssertionError("the server stays full")


def held(served, speech):
    """A client that has been taken and says no more."""

    def run():
        client = Held(served.stub, header(), sound(pcm(speech, 0.3)))
        assert next(client.call).HasField("animation_data_stream_header")
        return client

    return patient(run)


def test_more_clients_than_it_takes_are_refused_and_those_that_vanish_make_room(animator, speech):
    with Served(animator, streams=2) as served:
        for _ in range(3):
            clients = [held(served, speech) for _ in range(2)]
            code, _ = refused(served.stub.ProcessAudioStream(requests(pcm(speech, 0.3)), timeout=60))
            assert code == grpc.StatusCode.RESOURCE_EXHAUSTED
            for client in clients:
                client.leave()
        assert is_served(served, speech) == 15


def test_a_client_that_says_nothing_is_told_so(animator, speech):
    with Served(animator, streams=1, idle=3.0) as served:
        client = Held(served.stub, header())
        assert next(client.call).HasField("animation_data_stream_header")
        expected = (grpc.StatusCode.DEADLINE_EXCEEDED, "nothing was sent or taken for 3 s")
        assert refused(client.call) == expected
        client.go.set()
        assert is_served(served, speech) == 15


@pytest.mark.parametrize(
    ("sent", "message"),
    [
        ([sound(b"\0\0")], "the first message must be a header"),
        ([header(channels=2)], "1 channel of 16 bits, not 2 of 16"),
        ([header(bits=32)], "1 channel of 16 bits, not 1 of 32"),
        ([header(rate=100)], "100 samples a second; expected 8000 to 192000"),
        ([header(), header()], "a second header"),
        ([header(), END], "there was no sound"),
        ([header(), sound(b"\0\0\0"), END], "the sound ends within a sample"),
        ([header(), sound(b"\0\0")], "the stream ended without end_of_audio"),
        ([messages.AudioWithEmotionStream()], "a message is empty"),
        (
            [
                header(
                    blendshape_params=messages.BlendShapeParameters(
                        bs_weight_offsets={"JawOpen": float("nan")}
                    )
                )
            ],
            "JawOpen is nan",
        ),
        (
            [header(), sound(b"\0\0", [messages.EmotionWithTimeCode(time_code=0, emotion={"joy": 2.0})])],
            "emotions must lie within 0 to 1",
        ),
    ],
)
def test_what_cannot_be_animated_is_refused_by_name(served, sent, message):
    code, details = refused(served.stub.ProcessAudioStream(iter(sent), timeout=60))
    assert code == grpc.StatusCode.INVALID_ARGUMENT
    assert message in details


def test_garbage_is_refused_and_the_next_client_is_served(served, speech):
    raw = served.channel.stream_stream(
        "/nvidia_ace.services.a2f_controller.v1.A2FControllerService/ProcessAudioStream",
        request_serializer=bytes,
        response_deserializer=bytes,
    )
    generator = np.random.default_rng(0)
    for _ in range(5):
        code, details = refused(raw(iter([b"\xff" + generator.bytes(200)]), timeout=60))
        assert (code, details) == (
            grpc.StatusCode.INVALID_ARGUMENT,
            "a message is not AudioWithEmotionStream",
        )
    code, _ = refused(served.stub.ProcessAudioStream(iter([header(), sound(bytes(2 * MESSAGE))]), timeout=60))
    assert code == grpc.StatusCode.RESOURCE_EXHAUSTED
    assert is_served(served, speech) == 15


def test_a_client_that_floods_is_held_back_and_stopped(animator, speech):
    taken = 0

    def flood():
        nonlocal taken
        yield header()
        while taken < 200_000_000:
            taken += 1 << 16
            yield sound(bytes(1 << 16))

    gc.collect()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with Served(animator, seconds=8.0) as served:
        call = served.stub.ProcessAudioStream(flood(), timeout=60)
        assert refused(call) == (grpc.StatusCode.RESOURCE_EXHAUSTED, "more than 8 s of sound")
        # 8 s are 256 kB; what waits on the way is bounded by the transport's windows.
        assert taken < 20_000_000
        assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000  # kB
        assert is_served(served, speech) == 15


def test_a_client_that_never_reads_is_not_read_either(animator, speech):
    taken = 0
    stop = threading.Event()

    def flood():
        nonlocal taken
        yield header()
        while not stop.is_set():
            taken += 1 << 13
            yield sound(pcm(speech, 0.256))

    with Served(animator, streams=1) as served:
        call = served.stub.ProcessAudioStream(flood(), timeout=60)
        time.sleep(1.5)
        stop.set()
        call.cancel()
        assert taken < 20_000_000
        assert is_served(served, speech) == 15


def test_its_health_can_be_asked(served):
    check = served.channel.unary_unary("/grpc.health.v1.Health/Check", bytes, bytes)
    assert check(b"", timeout=10) == b"\x08\x01"


@pytest.mark.skipif(shutil.which("openssl") is None, reason="needs openssl to make a certificate")
def test_it_speaks_tls(animator, speech, tmp_path):
    key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
    command = "openssl req -x509 -newkey rsa:2048 -nodes -days 1 -subj /CN=localhost"
    more = ["-addext", "subjectAltName=DNS:localhost", "-keyout", str(key), "-out", str(certificate)]
    subprocess.run([*command.split(), *more], check=True, capture_output=True)
    trust = grpc.ssl_channel_credentials(certificate.read_bytes())
    with Served(animator, trust, tls=(key, certificate)) as served:
        assert is_served(served, speech) == 15


def test_bad_options_give_a_line(served, tmp_path, capsys):
    key = str(tmp_path / "missing.pem")
    for words, message in (
        (["--port", str(served.port)], "is the port taken?"),
        (["--port", "0", "--tls", key, key], "cannot read"),
        (["--port", "99999"], "port must be in 0 to 65535"),
        (["--streams", "0"], "streams must be at least 1"),
        (["--model", str(tmp_path / "nothing")], "nothing"),
    ):
        assert main(["serve", "grpc", *words]) == 2
        lines = capsys.readouterr().err.strip().splitlines()
        assert message in lines[-1]
