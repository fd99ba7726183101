"""Audio2Face-3D's public gRPC protocol: existing clients send speech and get ARKit weights, frame by frame.

The messages are those of NVIDIA's package `nvidia-audio2face-3d` (extra `serve`). A stream is a header, sound
with emotions, and an end; the answer is a header, a message a frame with its weights and its share of the
sound, an event when everything has been computed, and a status.

Nothing grows with what clients send: a stream holds the sound of the frames that are still being computed
and the last two seconds of what emotions are heard in,
reading stops while frames are computed or wait to be sent, and the numbers of streams, seconds and bytes a
message are limited.
"""

import asyncio
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float64
from tyro.conf import arg

from meshanim.animator import AnimationOptions, Animator
from meshanim.errors import BackendError, FileFormatError, MeshanimError, OptionError
from meshanim.models.audio2emotion import EmotionDetector, load_audio2emotion
from meshanim.motion.blendshape_csv import ARKIT_SHAPES
from meshanim.motion.blendshape_solver import BlendshapeSolver, SolverOptions
from meshanim.motion.post_files import controls_of, post_track
from meshanim.motion.post_processing import PRESETS, PostTrack
from meshanim.performance import told_emotions
from meshanim.serve.stream_emotions import RequestError, StreamEmotions
from meshanim.serve.weight_stream import WeightStream

__all__ = ["Audio2FaceService", "ServeGrpcOptions", "serve_grpc", "start_server"]

SERVICE = "nvidia_ace.services.a2f_controller.v1.A2FControllerService"
HEALTH = "grpc.health.v1.Health"
AGGREGATE = "nvidia_ace.emotion_aggregate.v1.EmotionAggregate"
"""Name of the message by which NVIDIA's clients know it; their package on PyPI has it under another."""
SERVING = b"\x08\x01"
"""HealthCheckResponse with status SERVING."""
RATES = (8000, 192_000)
MESSAGE = 1 << 20
"""Most bytes of a message: half a minute of 16 kHz sound."""


@dataclass(frozen=True)
class ServeGrpcOptions:
    """Serve Audio2Face-3D's gRPC protocol: speech in, blendshape weights out, for existing clients.

    Example: meshanim serve grpc --port 52000
    """

    model: str = "default"
    """The network: default, or a folder that meshanim train wrote."""
    head: str | None = None
    """Whose shapes the weights are of, as for meshanim animate; the network's own if not given."""
    post: str | None = None
    """Post-processing of clients that ask for none, as for meshanim animate; what a header says of it is
    changed from this."""
    audio2emotion: str = "default"
    """Classifier that hears emotions in the voice of clients whose header has emotion post-processing:
    default (trained on synthetic voices), a folder that `meshanim train audio2emotion` wrote, or none."""
    host: str = "127.0.0.1"
    """Address to listen at; 0.0.0.0 for all of the machine's."""
    port: int = 52000
    """0 for any that is free; it is printed."""
    tls: Annotated[tuple[Path, Path] | None, arg(metavar="KEY CERTIFICATE")] = None
    """Private key and certificate chain, PEM."""
    streams: int = 8
    """Most clients at once; more are refused with RESOURCE_EXHAUSTED."""
    seconds: float = 3600.0
    """Most sound of one stream."""
    idle: float = 60.0
    """Seconds without a message, or without one being taken, after which a stream is ended."""
    samples: int | None = None
    """Vertices that the blendshape solver looks at; all that shapes move if not given."""
    device: str = "cpu"
    """Where the network runs."""

    def __post_init__(self):
        if not 0 <= self.port < 65536:
            raise OptionError(f"port must be in 0 to 65535, not {self.port}")
        if self.streams < 1 or not self.seconds > 0 or not self.idle > 0:
            raise OptionError("streams must be at least 1, seconds and idle positive")


def _messages() -> tuple[Any, Any]:
    """grpc and the protocol's messages.

    Raises
    ------
    BackendError
        If the extra is not installed.
    """
    try:
        import grpc
        from nvidia_audio2face_3d import messages_pb2
    except ImportError as error:
        raise BackendError(
            f"the gRPC service needs the extra `serve` ({error}): pip install 'meshanim[serve]'"
        ) from error
    return grpc, messages_pb2


class Audio2FaceService:
    """`ProcessAudioStream` on a network, for any number of streams.

    Parameters
    ----------
    animator : Animator
        The network, its encoder and a head with blendshapes.
    options : ServeGrpcOptions
        Limits.

    Raises
    ------
    OptionError
        If the head has no blendshapes.
    """

    def __init__(self, animator: Animator, options: ServeGrpcOptions):
        self.grpc, self.messages = _messages()
        self.animator, self.options = animator, options
        head = animator.head
        if head is None or not head.expression_names:
            raise OptionError("the gRPC service needs a head with blendshapes: give --head")
        shapes = head.expression_names
        self.names = ARKIT_SHAPES if set(shapes) >= set(ARKIT_SHAPES) else tuple(shapes)
        self.rows = [shapes.index(name) for name in self.names]
        neutral = animator.open().mesh.vertices
        active = SolverOptions(active=self.names)
        self.solver = BlendshapeSolver.from_head(head, active, options.samples, neutral)
        self.emotions = told_emotions(animator.model)
        self.detector = None
        if self.emotions and options.audio2emotion != "none":
            self.detector = EmotionDetector(load_audio2emotion(options.audio2emotion))
        track = None if options.post is None else post_track(options.post)
        self.controls = None if track is None else track.first
        self.active = 0
        self.pool = ThreadPoolExecutor(options.streams, "speech")

    def handlers(self) -> tuple[Any, ...]:
        """What a grpc server is given: the service, and gRPC's own health check."""
        grpc = self.grpc
        stream = grpc.stream_stream_rpc_method_handler(
            self.process, response_serializer=self.messages.A2F3DAnimationDataStream.SerializeToString
        )
        check = grpc.unary_unary_rpc_method_handler(_check)
        return (
            grpc.method_handlers_generic_handler(SERVICE, {"ProcessAudioStream": stream}),
            grpc.method_handlers_generic_handler(HEALTH, {"Check": check}),
        )

    async def process(self, requests: object, context: Any) -> None:
        """One stream, from its header to its status, if there is room for it."""
        if self.active >= self.options.streams:
            text = f"all {self.options.streams} streams are taken"
            await context.abort(self.grpc.StatusCode.RESOURCE_EXHAUSTED, text)
        self.active += 1
        try:
            await self._answer(context)
        finally:
            self.active -= 1

    async def _answer(self, context: Any) -> None:
        grpc, codes = self.grpc, self.grpc.StatusCode
        try:
            header = await self._read(context)
            if header is None or not header.HasField("audio_stream_header"):
                raise RequestError("the first message must be a header")
            stream = _Stream(self, header.audio_stream_header)
            await self._write(context, stream.header())
            while True:
                message = await self._read(context)
                if message is None:
                    raise RequestError("the stream ended without end_of_audio")
                if message.HasField("audio_stream_header"):
                    raise RequestError("a second header")
                last = message.HasField("end_of_audio")
                sound, emotions = message.audio_with_emotion.audio_buffer, message.audio_with_emotion.emotions
                loop = asyncio.get_running_loop()
                parts = await loop.run_in_executor(self.pool, stream.advance, sound, emotions, last)
                for part in parts:
                    await self._write(context, part)
                if last:
                    break
            event = self.messages.Event(event_type=self.messages.END_OF_A2F_AUDIO_PROCESSING)
            await self._write(context, self.messages.A2F3DAnimationDataStream(event=event))
            await self._write(context, stream.status())
        except TooLong as error:
            await context.abort(codes.RESOURCE_EXHAUSTED, str(error))
        except MeshanimError as error:
            await context.abort(codes.INVALID_ARGUMENT, " ".join(str(error).split()))
        except TimeoutError:
            text = f"nothing was sent or taken for {self.options.idle:g} s"
            await context.abort(codes.DEADLINE_EXCEEDED, text)
        except grpc.aio.UsageError:
            # The client is gone: nobody is left to be told.
            return

    async def _read(self, context: Any) -> Any:
        """The next message; None at the end.

        Raises
        ------
        RequestError
            If it is none of this protocol.
        """
        from google.protobuf.message import DecodeError

        data = await asyncio.wait_for(context.read(), self.options.idle)
        if data is self.grpc.aio.EOF:
            return None
        try:
            message = self.messages.AudioWithEmotionStream.FromString(data)
        except DecodeError as error:
            raise RequestError("a message is not AudioWithEmotionStream") from error
        if not any(map(message.HasField, ("audio_stream_header", "audio_with_emotion", "end_of_audio"))):
            raise RequestError("a message is empty")
        return message

    async def _write(self, context: Any, message: Any) -> None:
        await asyncio.wait_for(context.write(message), self.options.idle)


async def _check(request: bytes, context: Any) -> bytes:
    return SERVING


class TooLong(MeshanimError):
    """A stream has more sound than the server takes."""


class _Stream:
    """What is known of one stream between its messages."""

    def __init__(self, service: Audio2FaceService, header: Any):
        self.service = service
        sound = header.audio_header
        if sound.channel_count != 1 or sound.bits_per_sample != 16:
            channels, bits = sound.channel_count, sound.bits_per_sample
            raise RequestError(f"sound must be PCM, 1 channel of 16 bits, not {channels} of {bits}")
        if not RATES[0] <= sound.samples_per_second <= RATES[1]:
            raise RequestError(
                f"{sound.samples_per_second} samples a second; expected {RATES[0]} to {RATES[1]}"
            )
        self.sound, self.rate = sound, sound.samples_per_second
        shapes = header.blendshape_params
        self.gain = self._by_shape(shapes.bs_weight_multipliers, 1.0)
        self.offset = self._by_shape(shapes.bs_weight_offsets, 0.0)
        self.clamp = shapes.enable_clamping_bs_weight
        self.unknown: set[str] = set()
        listens = header.HasField("emotion_post_processing_params")
        if listens and service.detector is None:
            self.unknown.add("emotion_post_processing_params")
        self.emotions = StreamEmotions(service.emotions, header, service.detector if listens else None)
        options = AnimationOptions(controls=self._controls(header.face_params))
        self.weights = WeightStream(service.animator, service.solver, self.rate, options)
        self.pending = bytearray()
        self.received, self.heard, self.sent, self.given = 0, 0, 0, 0

    def _controls(self, parameters: Any) -> PostTrack | None:
        """Post-processing: the service's, with what the header says of it."""
        if self.service.controls is None and not parameters.ByteSize():
            return None
        base = self.service.controls or PRESETS["neutral"]
        for name, value in {**parameters.float_params, **parameters.integer_params}.items():
            try:
                base = controls_of({name: value}, base)
            except ValueError:
                self.unknown.add(name)
        self.unknown |= set(parameters.float_array_params)
        return PostTrack.of(base)

    def _by_shape(self, values: Mapping[str, float], otherwise: float) -> np.ndarray:
        """Factors or offsets in the order of the shapes; names are known with a capital and without."""
        found = np.full(len(self.service.names), otherwise)
        rows = {name.lower(): row for row, name in enumerate(self.service.names)}
        for name, value in values.items():
            if not np.isfinite(value):
                raise RequestError(f"{name} is {value}")
            if name.lower() in rows:
                found[rows[name.lower()]] = value
        return found

    def header(self) -> Any:
        """The first answer: names of the shapes, and when this began."""
        from nvidia_ace.animation_pb2 import SkelAnimationHeader

        messages = self.service.messages
        names = [f"{name[:1].upper()}{name[1:]}" for name in self.service.names]
        return messages.A2F3DAnimationDataStream(
            animation_data_stream_header=messages.A2F3DAnimationDataStreamHeader(
                audio_header=self.sound,
                skel_animation_header=SkelAnimationHeader(blend_shapes=names),
                start_time_code_since_epoch=time.time(),
            )
        )

    def advance(self, sound: bytes, emotions: Any, last: bool) -> list[Any]:
        """Take sound and emotions; give an answer for every frame that is complete.

        Raises
        ------
        RequestError
            If the sound ends within a sample, there was none, or an emotion is out of range.
        TooLong
            If there is more of it than the server takes.
        """
        if emotions:
            keys = ((key.time_code, key.emotion) for key in emotions)
            self.emotions.tell(keys, self.given / self.weights.fps)
        self.pending += sound
        self.received += len(sound)
        if self.received > 2 * self.rate * self.service.options.seconds:
            raise TooLong(f"more than {self.service.options.seconds:g} s of sound")
        # Buffers may be cut anywhere, also within a sample.
        whole = self.received // 2 * 2
        if last and (self.received % 2 or not whole):
            raise RequestError("the sound ends within a sample" if whole else "there was no sound")
        fresh = bytes(self.pending[self.heard - self.sent : whole - self.sent])
        self.heard = whole
        samples = np.frombuffer(fresh, "<i2").astype(np.float32) / 32768
        self.emotions.hear(samples, last)
        if self.service.emotions:
            self.weights.feel(self.emotions.track)
        weights = self.weights.push(samples, last)
        weights = weights[:, self.service.rows] * self.gain + self.offset
        if self.clamp:
            weights = weights.clip(0, 1)
        frames = [self._frame(row, last and k == len(weights) - 1) for k, row in enumerate(weights)]
        self.emotions.forget(self.given / self.weights.fps)
        return frames

    def _frame(self, weights: Float64[np.ndarray, " shapes"], last: bool) -> Any:
        """The next frame: its weights, and the sound that belongs to it; at the end all that is left."""
        from nvidia_ace.animation_pb2 import (
            AnimationData,
            AudioWithTimeCode,
            FloatArrayWithTimeCode,
            SkelAnimation,
        )

        time_code = self.given / self.weights.fps
        self.given += 1
        until = self.heard if last else min(self.heard, 2 * round(self.given / self.weights.fps * self.rate))
        sound = bytes(self.pending[: until - self.sent])
        del self.pending[: len(sound)]
        frame = AnimationData(
            skel_animation=SkelAnimation(
                blend_shape_weights=[FloatArrayWithTimeCode(time_code=time_code, values=weights)]
            ),
            audio=AudioWithTimeCode(time_code=self.sent / 2 / self.rate, audio_buffer=sound),
        )
        if self.service.emotions:
            aggregate = self.emotions.aggregate(time_code + 0.5 / self.weights.fps)
            frame.metadata["emotion_aggregate"].type_url = f"type.googleapis.com/{AGGREGATE}"
            frame.metadata["emotion_aggregate"].value = aggregate.SerializeToString()
        self.sent += len(sound)
        return self.service.messages.A2F3DAnimationDataStream(animation_data=frame)

    def status(self) -> Any:
        """The last answer: success, or what was left out."""
        from nvidia_ace.status_pb2 import Status

        status = Status(code=Status.SUCCESS, message=f"{self.given} frames")
        unknown = self.unknown | self.emotions.unknown
        if unknown:
            text = f"without effect here: {', '.join(sorted(unknown))}"
            status = Status(code=Status.WARNING, message=text)
        return self.service.messages.A2F3DAnimationDataStream(status=status)


async def start_server(animator: Animator, options: ServeGrpcOptions) -> tuple[Any, int]:
    """A running grpc.aio server, and the port it listens at.

    Raises
    ------
    OptionError
        If the address cannot be listened at, or the head has no blendshapes.
    FileFormatError
        If the key or the certificate cannot be read.
    """
    service = Audio2FaceService(animator, options)
    grpc = service.grpc
    server = grpc.aio.server(
        options=[
            ("grpc.max_receive_message_length", MESSAGE),
            ("grpc.so_reuseport", 0),
            # A client that vanished without a word is noticed.
            ("grpc.keepalive_time_ms", 20_000),
            ("grpc.keepalive_timeout_ms", 10_000),
        ],
    )
    server.add_generic_rpc_handlers(service.handlers())
    address = f"{options.host}:{options.port}"
    try:
        if options.tls is None:
            port = server.add_insecure_port(address)
        else:
            key, certificate = (path.read_bytes() for path in options.tls)
            port = server.add_secure_port(address, grpc.ssl_server_credentials([(key, certificate)]))
    except OSError as error:
        raise FileFormatError(f"cannot read {error.filename}: {error.strerror}") from error
    except RuntimeError as error:
        raise OptionError(f"cannot listen at {address}: is the port taken?") from error
    await server.start()
    return server, port


def serve_grpc(options: ServeGrpcOptions) -> None:
    """Run the service until it is interrupted."""
    _messages()
    animator = Animator.from_pretrained(options.model, options.head, options.device)

    async def run() -> None:
        server, port = await start_server(animator, options)
        kind = "TLS" if options.tls else "plain"
        print(f"serving Audio2Face-3D gRPC at {options.host}:{port} ({kind})", flush=True)
        if told_emotions(animator.model) and options.audio2emotion == "default":
            print(
                "emotions are heard, where clients ask for it, by the default classifier: trained on "
                "synthetic voices, not validated on people (--audio2emotion none: not heard)",
                flush=True,
            )
        await server.wait_for_termination()

    asyncio.run(run())
