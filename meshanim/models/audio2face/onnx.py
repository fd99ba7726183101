"""Both networks as ONNX graphs, with the inputs and outputs of the public ones."""

import importlib.util
import warnings
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from meshanim.audio import SpeechEncoder
from meshanim.audio.pretrained import TransformerEncoder
from meshanim.errors import DependencyError, OptionError
from meshanim.files import written_whole
from meshanim.models.audio2face.diffusion import REACH, Audio2FaceDiffusion
from meshanim.models.audio2face.diffusion_stream import SECOND, block_frames
from meshanim.models.audio2face.regression import STEP_TIMES, STEPS, WINDOW, Audio2FaceRegression
from meshanim.models.audio2face.speech import RATE, features_at, hearing

__all__ = ["DiffusionGraph", "OnnxNames", "RegressionGraph", "export_onnx"]

OPSET = 18


@dataclass(frozen=True)
class OnnxNames:
    """Inputs and outputs of a graph with their shapes; None is any number."""

    inputs: dict[str, tuple[int | None, ...]]
    outputs: dict[str, tuple[int | None, ...]]


class _WindowHearing(nn.Module):
    """A transformer's features of windows of sound that are heard alone, at fixed times.

    Parameters
    ----------
    encoder : TransformerEncoder
    samples : int
        Of a window.
    times : (steps,)
        Seconds from its beginning.
    """

    matrix: Tensor

    def __init__(self, encoder: TransformerEncoder, samples: int, times: Tensor):
        super().__init__()
        self.model, self.layer, self.normalize = encoder.model, encoder.layer, encoder.normalize
        # Both interpolations are linear in the hidden states: one matrix.
        matrix = features_at(encoder.frames_of_states(samples), encoder.rate, times)
        self.register_buffer("matrix", matrix, persistent=False)

    def forward(self, windows: Float[Tensor, "batch samples"]) -> Float[Tensor, "batch steps dim"]:
        if self.normalize:
            centred = windows - windows.mean(1, keepdim=True)
            windows = centred / torch.sqrt(centred.square().mean(1, keepdim=True) + 1e-7)
        states = self.model(windows, output_hidden_states=True).hidden_states[self.layer]
        return self.matrix @ states


class RegressionGraph(nn.Module):
    """`input` (B, 1, 8320) and `emotion` (B, 1, 16 + E), implicit before explicit, to `result` (B, 1, state).

    The public graph hears through its own encoder. So does this one where the encoder is a transformer that
    hears window by window; any other is heard outside, and `features` (B, 25, D) at `STEP_TIMES` are a third
    input.

    Parameters
    ----------
    network : Audio2FaceRegression
    encoder : SpeechEncoder
        The one that it was trained with.
    """

    def __init__(self, network: Audio2FaceRegression, encoder: SpeechEncoder):
        super().__init__()
        self.network = network.deployed()
        self.hearing = None
        config = network.config
        if isinstance(encoder, TransformerEncoder) and config.hearing == "window":
            times = torch.from_numpy(STEP_TIMES) + WINDOW / 2 / RATE
            self.hearing = _WindowHearing(encoder, WINDOW, times)
        inputs: dict[str, tuple[int | None, ...]] = {
            "input": (None, 1, WINDOW),
            "emotion": (None, 1, config.implicit + len(config.emotions)),
        }
        if self.hearing is None:
            inputs["features"] = (None, STEPS, config.feature_dim)
        self.names = OnnxNames(inputs, {"result": (None, 1, network.actors.basis.width)})

    def forward(
        self,
        input: Float[Tensor, "batch 1 samples"],
        emotion: Float[Tensor, "batch 1 emotions"],
        features: Float[Tensor, "batch steps dim"] | None = None,
    ) -> Float[Tensor, "batch 1 state"]:
        windows = input[:, 0]
        if self.hearing is not None:
            features = self.hearing(windows)
        assert features is not None
        count = self.network.config.implicit
        implicit, explicit = emotion[:, 0, :count], emotion[:, 0, count:]
        return self.network(windows, features, explicit, implicit).states[:, None]


class DiffusionGraph(nn.Module):
    """One block of a stream: window, noise and states to frames and states.

    T is the number of frames from the block's first to the window's last: 23 at 30 frames a second, 45 at 60,
    fewer at the end of the speech. Inputs:

    - `window` (B, 16000): sound of one second around the block;
    - `identity` (B, I): one-hot, or a mixture;
    - `emotion` (B, T, E);
    - `input_latents` (steps, layers, B, width): the GRU's states, zeros at the beginning;
    - `noise` (B, steps + 1, T, D), of which the last is not used;
    - `input_frames` (steps, B, 4, D + 1): noisy frames before the block, and 1 for each that exists; zeros at
      the beginning.

    Outputs: `prediction` (B, T, D) in metres and radians, of which the block's frames are final;
    `output_latents` and `output_frames` for the next block.

    The public graph has no frames among its states (its mixing over time does not cross windows), noise for
    the frames before the block too, and emotions of the block alone. Where the encoder is no transformer that
    hears window by window, `features` (B, 4 + T, F) at the times of the four frames before the block and of
    the T frames take the place of `window`.

    Parameters
    ----------
    network : Audio2FaceDiffusion
    encoder : SpeechEncoder
        The one that it was trained with.
    steps : int, optional
        Denoising steps; the network's if not given.
    """

    def __init__(self, network: Audio2FaceDiffusion, encoder: SpeechEncoder, steps: int | None = None):
        super().__init__()
        config = network.config
        self.network = network
        self.plan = network.schedule.sampling(config.sampling if steps is None else steps)
        self.before, self.block, self.after = block_frames(config.fps)
        self.hearing = None
        if isinstance(encoder, TransformerEncoder) and hearing(encoder) == "window":
            first = round(self.before / config.fps * RATE)
            count = REACH + self.block + self.after
            frames = torch.arange(count, dtype=torch.float64) - REACH
            times = (frames + 0.5) / config.fps + first / RATE
            self.hearing = _WindowHearing(encoder, SECOND, times)
        # A layer at a time, so that the states at the block's end are outputs of its last frame.
        self.layers = nn.ModuleList(self._layer(number) for number in range(config.layers))
        moods, numbers, count = max(config.mood, 1), network.numbers, len(self.plan)
        state = (count, config.layers, None, config.width)
        left = (count, None, REACH, numbers + 1)
        heard: dict[str, tuple[int | None, ...]] = {"window": (None, SECOND)}
        if self.hearing is None:
            heard = {"features": (None, None, config.feature_dim)}
        self.names = OnnxNames(
            heard
            | {
                "identity": (None, len(config.identities)),
                "emotion": (None, None, moods),
                "input_latents": state,
                "noise": (None, count + 1, None, numbers),
                "input_frames": left,
            },
            {"prediction": (None, None, numbers), "output_latents": state, "output_frames": left},
        )

    def _layer(self, number: int) -> nn.GRU:
        whole = self.network.recurrent
        layer = nn.GRU(
            whole.input_size if number == 0 else whole.hidden_size, whole.hidden_size, batch_first=True
        )
        with torch.no_grad():
            for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh"):
                getattr(layer, f"{name}_l0").copy_(getattr(whole, f"{name}_l{number}"))
        return layer

    def forward(
        self,
        heard: Float[Tensor, "batch *heard"],
        identity: Float[Tensor, "batch identities"],
        emotion: Float[Tensor, "batch frames emotions"],
        input_latents: Float[Tensor, "steps layers batch width"],
        noise: Float[Tensor, "batch noises frames numbers"],
        input_frames: Float[Tensor, "steps batch left numbers1"],
    ) -> tuple[Tensor, Tensor, Tensor]:
        network = self.network
        count = emotion.shape[1]
        features = heard if self.hearing is None else self.hearing(heard)[:, : REACH + count]
        features = (features - network.feature_mean) / network.feature_scale
        if network.experts is not None:
            features = network.experts(features, identity)
        exists = functional.pad(input_frames[0, :, :, -1:], (0, 0, 0, count), value=1.0)
        # Frames that do not exist are zeros to the mixing, as at the edges.
        spoken = network.speech(features) * exists
        spoken = functional.mish(network.speech_mix(spoken.transpose(1, 2)).transpose(1, 2))[:, REACH:]
        mood = network.emotion(emotion)
        who = identity @ network.identity.weight
        x = noise[:, 0]
        clean, latents, frames = x, [], []
        for number, step in enumerate(self.plan):
            seen = torch.cat([input_frames[number, :, :, :-1], x], dim=1)
            kept = torch.cat([seen, exists], dim=2)[:, : REACH + self.block][:, -REACH:]
            frames.append(kept)
            trust = network.trust.weight[step.time]
            if network.geometry_mix is None:
                shape = trust * x
            else:
                parts = zip(network.parts, network.geometry)
                projected = [layer(trust * seen[..., part.columns]) for part, layer in parts]
                shape = torch.cat(projected, -1) * exists
                shape = network.geometry_mix(shape.transpose(1, 2)).transpose(1, 2)[:, REACH:]
            time = functional.mish(network.time.weight[step.time])
            still = torch.cat([time.expand(who.shape[0], -1), who], dim=-1)
            still = still[:, None].expand(-1, count, -1)
            hidden = inputs = torch.cat([spoken, shape, still, mood], dim=-1)
            for row, layer in enumerate(self.layers):
                hidden = layer(hidden, input_latents[number, row][None].contiguous())[0]
                latents.append(hidden[:, : self.block][:, -1])
            clean = network.decode(hidden, inputs)
            x = step.clean * clean + step.noisy * x
            if number + 1 < len(self.plan):
                x = x + step.deviation * noise[:, number + 1]
        states = torch.stack(latents).unflatten(0, (len(self.plan), len(self.layers)))
        return network.mean + x * network.scale, states, torch.stack(frames)


def export_onnx(
    network: Audio2FaceRegression | Audio2FaceDiffusion,
    encoder: SpeechEncoder,
    path: str | Path,
    steps: int | None = None,
) -> OnnxNames:
    """Write a network as an ONNX file, and say what its inputs and outputs are.

    Parameters
    ----------
    network : Audio2FaceRegression or Audio2FaceDiffusion
        In eval mode.
    encoder : SpeechEncoder
        The one that it was trained with.
    path : path
        A file .onnx.
    steps : int, optional
        Denoising steps of a diffusion network; its own if not given.

    Raises
    ------
    OptionError
        If the path does not end in .onnx, the encoder does not fit, or a regression network is given steps.
    DependencyError
        If the extra `onnx` is not installed.
    """
    if importlib.util.find_spec("onnx") is None:  # the exporter writes files with it
        raise DependencyError("onnx", "onnx")
    if Path(path).suffix.lower() != ".onnx":
        raise OptionError(f"a network is written as .onnx, not {path}")
    if encoder.dim != network.config.feature_dim:
        raise OptionError(
            f"encoder {encoder.name} gives {encoder.dim} features, the network reads "
            f"{network.config.feature_dim}: it was trained with {network.config.encoder}"
        )
    graph: RegressionGraph | DiffusionGraph
    if isinstance(network, Audio2FaceRegression):
        if steps is not None:
            raise OptionError("a regression network has no denoising steps")
        graph = RegressionGraph(network, encoder)
    else:
        graph = DiffusionGraph(network, encoder, steps)
    graph = graph.cpu().eval()
    names = graph.names
    ranks = names.inputs | names.outputs
    axes = {name: {k: f"{name}_{k}" for k, size in enumerate(ranks[name]) if size is None} for name in ranks}
    with written_whole(path) as temporary, warnings.catch_warnings():
        # About the exporter's age, and names of axes; the tests run what it writes.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            graph,
            tuple(_example(names).values()),
            str(temporary),
            dynamo=False,
            opset_version=OPSET,
            input_names=list(names.inputs),
            output_names=list(names.outputs),
            dynamic_axes=axes,
        )
    return names


def _example(names: OnnxNames, batch: int = 2, frames: int = 20) -> dict[str, Tensor]:
    """Inputs that a graph can be traced with."""
    generator = torch.Generator().manual_seed(0)
    found = {}
    for name, shape in names.inputs.items():
        free = {"input_latents": [batch], "input_frames": [batch]}.get(name, [batch, frames])
        if name == "features":
            free = [batch, REACH + frames]
        sizes = iter(free)
        found[name] = torch.rand(
            [next(sizes) if size is None else size for size in shape], generator=generator
        )
    return found
