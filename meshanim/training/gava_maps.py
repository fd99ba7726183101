"""What `meshanim evaluate gava-maps` draws: where a GAVA network attends (Figs. 7, 10 and 11)."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw
from torch import Tensor

from meshanim.audio import feature_windows, load_encoder, log_mel
from meshanim.datasets.meshanim_format import MeshanimDataset, MotionSequence
from meshanim.errors import OptionError
from meshanim.files import written_whole
from meshanim.heads import load_head
from meshanim.models.gava import Gava
from meshanim.render import portrait_camera, render_mesh
from meshanim.training.gava_evaluation import describe, load_gava, topology_of

__all__ = ["GavaMapsOptions", "VertexMaps", "draw_gava_maps", "vertex_maps"]

PALETTE = np.array([[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]]) / 255
"""sRGB from least to most attention, evenly spaced."""


@dataclass(frozen=True)
class VertexMaps:
    """Attention of every block, mean over its heads, carried from the tokens to all vertices.

    Parameters
    ----------
    audio : (L, F, V)
        The most that any vertex attends to this one, in [0, 1]: the column maximum of the attention matrix
        without the pose token (Figs. 10 and 11).
    pose : (L, F, V), optional
        The pose token's row (Fig. 7) in even shares: 1 where a vertex gets 1/N of the N vertices' part.
    vertices : (F, V, 3)
        The frames the network makes, zero pose, metres.
    rotation : (F, 3)
        The head poses it makes, rotation vectors, radians; zero without a pose token.
    """

    audio: Float[Tensor, "layers frames vertices"]
    pose: Float[Tensor, "layers frames vertices"] | None
    vertices: Float[Tensor, "frames vertices 3"]
    rotation: Float[Tensor, "frames 3"]


@dataclass(frozen=True)
class GavaMapsOptions:
    """Draw where a GAVA checkpoint attends: audio maps of each layer and the pose map, a row a sound.

    Example: meshanim evaluate gava-maps --data corpus --output maps.jpg --phonemes AA M IY
    """

    data: Path
    """Folder of a data set in the project's format."""
    output: Path = Path("maps.jpg")
    """The picture."""
    models: tuple[str, ...] = ("default",)
    """default, or folders that meshanim train gava wrote; one below the other."""
    phonemes: tuple[str, ...] = ("AA", "M", "IY")
    """Sounds (ARPAbet) at whose middle a frame is taken."""
    sequence: str = ""
    """Which sequence; the first of the test split that has the phonemes if not given."""
    size: int = 200
    """Pixels a tile."""

    def __post_init__(self):
        if not self.models or not self.phonemes or self.size < 32:
            raise OptionError("give at least one model, one phoneme, and a size of at least 32 pixels")


def vertex_maps(
    model: Gava,
    window: Float[Tensor, "frames window dim"],
    mel: Float[Tensor, "frames mel_frames bands"] | None,
    template: Float[Tensor, "vertices 3"],
    style: Float[Tensor, "1 style"],
) -> VertexMaps:
    """The attention maps of frames, on the full mesh.

    Parameters
    ----------
    model : Gava
        With an attention decoder.
    window, mel
        Inputs of the frames, as `Gava.forward` takes them.
    template : (V, 3)
        The subject at rest, metres.
    style : (1, style)
        As `Gava.style_of` gives it.

    Raises
    ------
    OptionError
        With decoder "mlp", which has no attention.
    """
    with torch.inference_mode():
        inputs = (window, mel, model.embed(template[None]), style.expand(len(window), -1))
        maps = model.attention_maps(*inputs)
        out = model(*inputs)
        audio = torch.stack([_on_vertices(model, m.received.mean(-1)) for m in maps])
        rows = [m.global_row.mean(-1) for m in maps if m.global_row is not None]
        shares = [row / row.sum(1, keepdim=True) * row.shape[1] for row in rows]
        pose = torch.stack([_on_vertices(model, share) for share in shares]) if shares else None
    return VertexMaps(audio, pose, template + out.displacements, out.pose)


def _on_vertices(model: Gava, values: Float[Tensor, "frames tokens"]) -> Float[Tensor, "frames vertices"]:
    spread = model.surface.prolong(values[..., None].expand(-1, -1, 3))[..., 0]
    # Between tokens, moving least squares can leave the range of the tokens.
    return spread.clamp(values.amin(1, keepdim=True), values.amax(1, keepdim=True))


def draw_gava_maps(options: GavaMapsOptions) -> UInt8[np.ndarray, "height width 3"]:
    """Draw and write the picture: for each model and phoneme the frame, its audio maps, and the pose map.

    Colours of a column of one model span the same range, from the 1st to the 99th percentile, which is
    printed on the tiles.

    Raises
    ------
    OptionError
        If no sequence has the phonemes, or a model does not fit the data set or has no attention.
    """
    dataset = MeshanimDataset(options.data)
    sequence = _sequence(dataset, options)
    moments = [_middle(sequence, symbol) for symbol in options.phonemes]
    parts = [_drawn(name, dataset, sequence, moments, options) for name in options.models]
    width = max(part.shape[1] for part in parts)
    picture = np.concatenate([np.pad(p, ((0, 0), (0, width - p.shape[1]), (0, 0))) for p in parts])
    with written_whole(options.output) as temporary:
        Image.fromarray(picture).save(temporary, quality=88)
    return picture


def _sequence(dataset: MeshanimDataset, options: GavaMapsOptions) -> MotionSequence:
    names = [options.sequence] if options.sequence else dataset.split("test")
    for name in names:
        sequence = dataset[name]
        if set(options.phonemes) <= {p.symbol for p in sequence.phonemes}:
            return sequence
    where = options.sequence or "no sequence of the test split"
    raise OptionError(
        f"{where} has {'not ' * bool(options.sequence)}all of {', '.join(options.phonemes)}: "
        "choose other --phonemes or another --sequence"
    )


def _middle(sequence: MotionSequence, symbol: str) -> int:
    phoneme = next(p for p in sequence.phonemes if p.symbol == symbol)
    return min(int((phoneme.start + phoneme.end) / 2 * sequence.info.fps), len(sequence) - 1)


def _drawn(
    name: str,
    dataset: MeshanimDataset,
    sequence: MotionSequence,
    moments: Sequence[int],
    options: GavaMapsOptions,
) -> UInt8[np.ndarray, "height width 3"]:
    model = topology_of(load_gava(name), dataset)
    config, info = model.config, sequence.info
    features, mel = load_encoder(config.encoder)(sequence.audio).float(), log_mel(sequence.audio)

    def windows(track: Tensor, rate: float, width: int) -> Tensor:
        return torch.cat([feature_windows(track, rate, info.fps, 1, width, frame) for frame in moments])

    subject = info.subject if info.subject in config.subjects else None
    emotion = info.emotion if info.emotion in config.emotions else "neutral"
    with torch.inference_mode():
        style = model.style_of(subject, emotion, float(info.intensity))
    template = torch.from_numpy(dataset.subjects[info.subject].template)
    maps = vertex_maps(
        model,
        windows(features, config.feature_rate, config.window),
        windows(mel, config.mel_rate, config.mel_frames) if config.pose else None,
        template,
        style,
    )
    columns = {f"audio, layer {k + 1}": layer for k, layer in enumerate(maps.audio)}
    if maps.pose is not None:
        columns |= {f"pose, layer {len(maps.pose)}": maps.pose[-1]}
    heads = maps.vertices
    if dataset.head:
        heads = load_head(dataset.head).pose(maps.vertices, maps.rotation)
    camera = portrait_camera(template.numpy(), options.size, options.size, azimuth=0.35)
    rows = []
    for i, (symbol, frame) in enumerate(zip(options.phonemes, moments)):
        vertices = heads[i].numpy()
        label = f"{describe(name, model)}\n{symbol}, {(frame + 0.5) / info.fps:.2f} s"
        tiles = [_labelled(render_mesh(vertices, dataset.surface, camera), label)]
        for title, values in columns.items():
            low, high = np.percentile(values.numpy(), [1, 99])
            colors = _colors(values[i].numpy(), low, high)
            tile = render_mesh(vertices, dataset.surface, camera, colors)
            tiles.append(_labelled(tile, f"{title}\n{low:.2g} to {high:.2g}"))
        rows.append(np.concatenate(tiles, axis=1))
    return np.concatenate(rows)


def _colors(values: np.ndarray, low: float, high: float) -> Float[np.ndarray, "vertices 3"]:
    place = np.clip((values - low) / max(high - low, 1e-12), 0, 1)
    stops = np.linspace(0, 1, len(PALETTE))
    return np.stack([np.interp(place, stops, channel) for channel in PALETTE.T], axis=1)


def _labelled(tile: UInt8[np.ndarray, "height width 3"], text: str) -> UInt8[np.ndarray, "height width 3"]:
    image = Image.fromarray(tile)
    ImageDraw.Draw(image).text((6, 4), text, fill=(245, 245, 245), stroke_width=1, stroke_fill=(0, 0, 0))
    return np.asarray(image)
