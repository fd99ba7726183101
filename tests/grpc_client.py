"""A gRPC client of the service in tests: NVIDIA's own stubs, over a socket."""

import asyncio
import threading

import numpy as np
import pytest

from meshanim.serve.grpc_service import ServeGrpcOptions, start_server

grpc = pytest.importorskip("grpc", reason="needs the extra `serve`")
pytest.importorskip("nvidia_audio2face_3d", reason="needs the extra `serve`")
from nvidia_ace.audio_pb2 import AudioHeader  # noqa: E402
from nvidia_audio2face_3d import messages_pb2 as messages  # noqa: E402
from nvidia_audio2face_3d.audio2face_pb2_grpc import A2FControllerServiceStub  # noqa: E402

FPS, RATE = 30.0, 16000


class Served:
    """A server on a thread of its own, and a client's channel to it."""

    def __init__(self, animator, channel=None, **options):
        self.loop = asyncio.new_event_loop()
        self.thread = threading.Thread(target=self.loop.run_forever, daemon=True)
        self.thread.start()
        chosen = ServeGrpcOptions(port=0, **options)
        self.server, self.port = self._call(start_server(animator, chosen))
        address = f"localhost:{self.port}"
        credentials = channel
        self.channel = (
            grpc.insecure_channel(address)
            if credentials is None
            else grpc.secure_channel(address, credentials)
        )
        self.stub = A2FControllerServiceStub(self.channel)

    def _call(self, coroutine):
        return asyncio.run_coroutine_threadsafe(coroutine, self.loop).result(60)

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.channel.close()
        self._call(self.server.stop(0))
        self.loop.call_soon_threadsafe(self.loop.stop)
        self.thread.join(10)


def pcm(speech, seconds):
    return (speech.samples[: int(seconds * RATE)].clip(-1, 1) * 32767).astype("<i2").tobytes()


def header(channels=1, bits=16, rate=RATE, **fields):
    sound = AudioHeader(
        audio_format=AudioHeader.AUDIO_FORMAT_PCM,
        channel_count=channels,
        bits_per_sample=bits,
        samples_per_second=rate,
    )
    return messages.AudioWithEmotionStream(
        audio_stream_header=messages.AudioWithEmotionStreamHeader(audio_header=sound, **fields)
    )


def sound(data, emotions=()):
    return messages.AudioWithEmotionStream(
        audio_with_emotion=messages.AudioWithEmotion(audio_buffer=data, emotions=emotions)
    )


END = messages.AudioWithEmotionStream(end_of_audio=messages.AudioWithEmotionStream.EndOfAudio())


def requests(data, size=3200, **fields):
    yield header(**fields)
    for first in range(0, len(data), size):
        yield sound(data[first : first + size])
    yield END


class Answer:
    """What a client makes of the answers."""

    def __init__(self, answers):
        kinds = []
        self.weights, self.times, self.sound, self.status, self.names = [], [], b"", None, None
        self.told, self.shown = [], []
        for answer in answers:
            kinds.append(answer.WhichOneof("stream_part"))
            if kinds[-1] == "animation_data_stream_header":
                self.names = list(answer.animation_data_stream_header.skel_animation_header.blend_shapes)
                self.begun = answer.animation_data_stream_header.start_time_code_since_epoch
                self.rate = answer.animation_data_stream_header.audio_header.samples_per_second
            elif kinds[-1] == "animation_data":
                (frame,) = answer.animation_data.skel_animation.blend_shape_weights
                self.times.append(frame.time_code)
                self.weights.append(list(frame.values))
                assert answer.animation_data.audio.time_code == pytest.approx(len(self.sound) / 2 / self.rate)
                self.sound += answer.animation_data.audio.audio_buffer
                metadata = answer.animation_data.metadata
                if "emotion_aggregate" in metadata:
                    # The name that NVIDIA's sample client asks for; its package on PyPI has another.
                    name = metadata["emotion_aggregate"].TypeName()
                    assert name == "nvidia_ace.emotion_aggregate.v1.EmotionAggregate"
                    aggregate = messages.EmotionAggregate.FromString(metadata["emotion_aggregate"].value)
                    for kept, given in (
                        (self.told, aggregate.input_emotions),
                        (self.shown, aggregate.a2f_smoothed_output),
                    ):
                        kept += [(key.time_code, dict(key.emotion)) for key in given]
            elif kinds[-1] == "status":
                self.status = answer.status
        self.weights = np.array(self.weights)
        self.order = [
            kind for k, kind in enumerate(kinds) if kind != "animation_data" or kinds[k - 1] != kind
        ]
