"""GAVA: speech to a talking, turning head by attention over the mesh (Li et al., TVCG 2025)."""

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from huggingface_hub import ModelCard
from jaxtyping import Float, Int
from torch import Tensor, nn

from meshanim.attention import AttentionMaps, MeshGraph
from meshanim.errors import MeshError, OptionError, ShapeError
from meshanim.geometry import TriangleMesh
from meshanim.models.checkpoint import CONFIG, Checkpoint
from meshanim.models.gava_parts import (
    GlobalDecoder,
    PoseEncoder,
    TransformerDecoder,
    VertexEmbedding,
    WindowEncoder,
)
from meshanim.models.vertex_tokens import VertexTokens

__all__ = ["Gava", "GavaConfig", "GavaOutput", "Topology"]


@dataclass(frozen=True)
class Topology:
    """One of the meshes that a network animates.

    Parameters
    ----------
    name : str
        What it is called: the data set it comes from.
    head : str
        As `load_head` takes it; "" for any other mesh.
    fps : float
        Frames a second of its training data.
    """

    name: str
    head: str = ""
    fps: float = 30.0


@dataclass(frozen=True)
class GavaConfig:
    """What a GAVA network is made of. Source: Li et al., TVCG 2025, Sec. III and IV.

    Parameters
    ----------
    feature_dim : int
        Speech features a frame (the paper's DeepSpeech: 29).
    features : "LG", "L" or "G"
        Local and global features, or one of them (Table IV).
    fusion : "sum" or "concat"
        How local and global features become the hierarchical feature.
    decoder : "gava", "sa" or "mlp"
        Attention over mesh neighbours, over all vertices, or one global network (Table IV).
    width, layers, heads : int
        Token width and the attention blocks; the paper shows at least three layers.
    expansion : float
        Hidden features of a block's feed-forward layer, in widths.
    tokens : "vertices" or int
        One token a vertex (the paper), or attention on about that many vertices, displacements carried to
        the full mesh by a fixed geometric prolongation.
    window : int
        Speech-feature frames around a frame; W = 16 in the paper.
    mel_bands, mel_frames : int
        Shape of the mel window; F = 80 bands in the paper.
    pose : bool
        Whether the head pose is predicted; without it there is no pose token.
    rank : int
        Codes read from a speech window, and scalar fields over the vertices that they modulate.
    channels : int
        Features of the speech encoder's convolutions.
    dropout : float
        Of the speech encoder's features while training.
    eigenfunctions : int
        Laplace-Beltrami eigenfunctions among a vertex's descriptors.
    rings, self_loops
        The attention pattern, as in `MeshGraph.from_faces`.
    style : int
        Width of the style vector.
    subjects, emotions : sequence of str
        Names that styles were learned for. A subject that is not named gets the mean style.
    encoder : str
        The speech encoder whose features the network reads, as `load_encoder` takes it.
    feature_rate, mel_rate : float
        Frames a second of both inputs.
    fps : float
        Animation frames a second in training; any rate can be asked for.
    head : str
        The head whose topology this is, as `load_head` takes it; "" for any other mesh.
    topologies : sequence of Topology
        All of them where a network animates several, the one of `fps` and `head` first; `each` gives them.

    Raises
    ------
    OptionError
        If a number is out of range.
    """

    feature_dim: int
    features: Literal["LG", "L", "G"] = "LG"
    fusion: Literal["sum", "concat"] = "sum"
    decoder: Literal["gava", "sa", "mlp"] = "gava"
    width: int = 64
    layers: int = 3
    heads: int = 4
    expansion: float = 2.0
    tokens: int | Literal["vertices"] = "vertices"
    window: int = 16
    mel_bands: int = 80
    mel_frames: int = 32
    pose: bool = True
    rank: int = 64
    channels: int = 128
    dropout: float = 0.0
    eigenfunctions: int = 64
    rings: int = 1
    self_loops: bool = True
    style: int = 16
    subjects: Sequence[str] = ()
    emotions: Sequence[str] = ("neutral",)
    encoder: str = "visemes"
    feature_rate: float = 50.0
    mel_rate: float = 100.0
    fps: float = 30.0
    head: str = ""
    topologies: Sequence[Topology | Mapping[str, Any]] = ()

    def __post_init__(self):
        for name in ("feature_dim", "width", "layers", "heads", "window", "mel_bands", "mel_frames", "rank"):
            if getattr(self, name) < 1:
                raise OptionError(f"{name} must be at least 1, not {getattr(self, name)}")
        if self.tokens != "vertices" and not (isinstance(self.tokens, int) and self.tokens >= 4):
            raise OptionError(f'tokens must be "vertices" or a count of at least 4, not {self.tokens!r}')
        if self.width % self.heads:
            raise OptionError(f"width {self.width} is not a multiple of {self.heads} heads")
        object.__setattr__(self, "subjects", tuple(self.subjects))
        object.__setattr__(self, "emotions", tuple(self.emotions))
        entries = (Topology(**t) if isinstance(t, Mapping) else t for t in self.topologies)
        object.__setattr__(self, "topologies", tuple(entries))
        if self.decoder == "mlp" and len(self.topologies) > 1:
            raise OptionError('decoder "mlp" has weights for the vertices of one topology, not of several')

    @property
    def each(self) -> tuple[Topology, ...]:
        """The topologies; one without a name where a network animates one."""
        named = tuple(entry for entry in self.topologies if isinstance(entry, Topology))
        return named or (Topology("", self.head, self.fps),)


class GavaOutput(NamedTuple):
    """Displacements from the template in metres, zero pose, and head rotation vectors in radians."""

    displacements: Float[Tensor, "batch vertices 3"]
    pose: Float[Tensor, "batch 3"]


class Gava(Checkpoint):
    """Speech windows and a template mesh to vertex displacements and a head pose.

    Every vertex has an embedding made from its geometry. Codes read from the speech window modulate it into
    the local feature of that vertex; a global feature is added; attention over mesh neighbours refines them;
    a last token, which sees all vertices and is seen by none, carries the head pose.

    Parameters
    ----------
    config : GavaConfig
        The network.
    surface : TriangleMesh or VertexTokens
        The mesh to animate, any topology. A mesh is turned into tokens with the options of `config`.
    others : sequence of TriangleMesh or VertexTokens
        Further topologies, in the order of `config.topologies`: the weights are shared, tokens, attention
        graph, embedding and prolongation are each one's own. `on` chooses.

    Notes
    -----
    The paper leaves the feature networks to its supplement. Ours: per-vertex embeddings from Laplace-Beltrami
    eigenfunctions, position and normal, modulated by low-rank codes, so that no parameter count depends on
    the mesh (but for decoder "mlp"); the static part of the embedding also serves as positional encoding
    with features "G".
    """

    title = "GAVA"
    config: GavaConfig
    surface: VertexTokens
    feature_mean: Tensor
    feature_scale: Tensor
    mel_mean: Tensor
    mel_scale: Tensor
    pose_mean: Tensor
    pose_scale: Tensor
    decoder: TransformerDecoder | GlobalDecoder
    others: nn.ModuleList

    def __init__(
        self,
        config: GavaConfig,
        surface: TriangleMesh | VertexTokens,
        others: Sequence[TriangleMesh | VertexTokens] = (),
    ):
        super().__init__()
        self.config = config
        if len(others) + 1 != len(config.each):
            raise OptionError(f"{len(config.each)} topologies are named, there are {len(others) + 1}")
        surface, *rest = (
            VertexTokens.from_mesh(one, config.tokens, config.eigenfunctions)
            if isinstance(one, TriangleMesh)
            else one
            for one in (surface, *others)
        )
        self.surface = surface
        self.others = nn.ModuleList(rest)
        width, rank = config.width, config.rank
        self.register_buffer("feature_mean", torch.zeros(config.feature_dim))
        self.register_buffer("feature_scale", torch.ones(config.feature_dim))
        self.register_buffer("mel_mean", torch.full((config.mel_bands,), -8.0))
        self.register_buffer("mel_scale", torch.full((config.mel_bands,), 3.0))
        self.register_buffer("pose_mean", torch.zeros(3))
        self.register_buffer("pose_scale", torch.full((3,), 0.05))
        self.subject_styles = nn.Embedding(len(config.subjects) + 1, config.style)
        self.emotion_styles = nn.Embedding(max(len(config.emotions), 1), config.style)
        nn.init.normal_(self.subject_styles.weight, std=0.1)
        nn.init.normal_(self.emotion_styles.weight, std=0.1)

        code = 2 * config.channels
        self.speech = WindowEncoder(
            config.feature_dim, config.window, config.style, config.channels, code, config.dropout
        )
        self.embedding = VertexEmbedding(surface.descriptors.shape[1], 2 * rank, rank)
        self.to_token = nn.Parameter(torch.randn(rank, width) * rank**-0.5)
        self.codes = nn.Linear(code, rank) if "L" in config.features else None
        self.global_attribute = nn.Linear(code, width) if "G" in config.features else None
        self.fuse = nn.Linear(2 * width, width) if config.fusion == "concat" else None
        self.pose_feature = PoseEncoder(config.mel_bands, config.style, width) if config.pose else None
        if config.decoder == "mlp":
            inputs = width if config.features == "G" else width * surface.n_tokens
            self.decoder = GlobalDecoder(inputs, width * config.pose, width, surface.n_tokens)
        else:
            self.decoder = TransformerDecoder(
                width, config.layers, config.heads, config.expansion, dense=config.decoder == "sa"
            )

    @property
    def n_vertices(self) -> int:
        return self.surface.n_vertices

    @property
    def mesh(self) -> TriangleMesh:
        """The reference template and its faces."""
        return self.surface.mesh

    @property
    def n_topologies(self) -> int:
        return 1 + len(self.others)

    def on(self, topology: int | str) -> "Gava":
        """This network on one of its topologies: a view that shares all weights, and saves as that one alone.

        Raises
        ------
        OptionError
            If there is no such topology.
        """
        if self.n_topologies == 1 and topology == 0:
            return self
        names = [entry.name for entry in self.config.each]
        number = names.index(topology) if topology in names else topology
        if not isinstance(number, int) or not 0 <= number < len(names):
            raise OptionError(
                f"no topology {topology!r} in this checkpoint; it has {', '.join(names) or 'one'}"
            )
        entry = self.config.each[number]
        view = copy.copy(self)
        view._modules = dict(self._modules)
        view._modules["surface"] = self.surface if number == 0 else self.others[number - 1]
        view._modules["others"] = nn.ModuleList()
        view.config = replace(self.config, head=entry.head, fps=entry.fps, topologies=())
        return view

    def graph(self) -> MeshGraph:
        """The attention pattern on the module's device."""
        return self.surface.graph(self.config.rings, self.config.self_loops, self.config.pose)

    # -- conditioning -------------------------------------------------------------------------------------

    def style(
        self,
        subjects: Int[Tensor, " batch"],
        emotions: Int[Tensor, " batch"] | None = None,
        intensities: Float[Tensor, " batch"] | None = None,
    ) -> Float[Tensor, "batch style"]:
        """Style vectors of training subjects (index -1: the mean style, for anyone else) and emotions."""
        style = self.subject_styles(torch.where(subjects < 0, len(self.config.subjects), subjects))
        if emotions is not None:
            emotion = self.emotion_styles(emotions)
            # Emotion 0 is neutral: it has no vector of its own.
            strength = (emotions > 0).to(emotion) if intensities is None else intensities * (emotions > 0)
            style = style + emotion * strength[:, None]
        return style

    def style_of(
        self, subject: str | None = None, emotion: str = "neutral", intensity: float = 1.0
    ) -> Float[Tensor, "1 style"]:
        """The style vector of a training subject by name (None: the mean style) with an emotion.

        Raises
        ------
        OptionError
            If the checkpoint has no such subject or emotion.
        """
        known = self.config.subjects
        if subject is not None and subject not in known:
            raise OptionError(f"no style {subject!r} in this checkpoint; it has {', '.join(known) or 'none'}")
        if emotion not in self.config.emotions:
            raise OptionError(
                f"no emotion {emotion!r} in this checkpoint; it has {', '.join(self.config.emotions)}"
            )
        device = self.to_token.device
        index = torch.tensor([-1 if subject is None else known.index(subject)], device=device)
        number = torch.tensor([self.config.emotions.index(emotion)], device=device)
        return self.style(index, number, torch.tensor([intensity], device=device))

    def styles_over_time(
        self, subject: str | None, strengths: Float[Tensor, "frames emotions"]
    ) -> Float[Tensor, "frames style"]:
        """Style vectors of frames whose emotions change and mix.

        Parameters
        ----------
        subject : str, optional
            As `style_of`.
        strengths : (T, E)
            Of the checkpoint's emotions but neutral, which is the first.
        """
        return self.style_of(subject) + strengths.to(self.to_token.device) @ self.emotion_styles.weight[1:]

    def embed(self, templates: Float[Tensor, "subjects vertices 3"]) -> Float[Tensor, "subjects tokens rank"]:
        """Vertex embeddings of subjects by their templates, metres; once a subject, not once a frame.

        Raises
        ------
        MeshError
            If the templates have another number of vertices than the checkpoint.
        """
        if templates.shape[1] != self.n_vertices:
            raise MeshError(
                f"the template has {templates.shape[1]} vertices, this checkpoint's mesh {self.n_vertices}: "
                "carry the template over to its topology, or train on yours"
            )
        return self.embedding(self.surface.descriptors, self.surface.identity(templates))

    # -- frames -------------------------------------------------------------------------------------------

    def tokens(
        self,
        window: Float[Tensor, "batch window dim"],
        mel: Float[Tensor, "batch frames bands"] | None,
        embedding: Float[Tensor, "subjects tokens rank"],
        style: Float[Tensor, "batch style"],
        subject: Int[Tensor, " batch"] | None = None,
    ) -> tuple[Tensor, Tensor | None]:
        """Hierarchical features of the vertices, (batch, tokens, width), and the pose feature.

        One token, the global feature, for decoder "mlp" with features "G".
        """
        self._check(window, mel)
        code = self.speech((window - self.feature_mean) / self.feature_scale, style)
        pose = None
        if self.pose_feature is not None and mel is not None:
            pose = self.pose_feature((mel - self.mel_mean) / self.mel_scale, style)
        if self.global_attribute is not None and self.config.decoder == "mlp" and self.codes is None:
            return self.global_attribute(code)[:, None], pose
        # Modulating the rows of the small matrix is the same as modulating every vertex's embedding.
        if self.codes is None:
            matrices = self.to_token.expand(len(window), -1, -1)
        else:
            matrices = (1 + self.codes(code))[..., None] * self.to_token
        if subject is not None and len(embedding) > 1:
            embedding = embedding[subject]
        features = embedding @ matrices
        if self.global_attribute is not None:
            attribute = self.global_attribute(code)[:, None]
            if self.fuse is None:
                features = features + attribute
            else:
                features = self.fuse(torch.cat([features, attribute.expand_as(features)], dim=-1))
        elif self.fuse is not None:
            features = self.fuse(torch.cat([features, torch.zeros_like(features)], dim=-1))
        return features, pose

    def forward(
        self,
        window: Float[Tensor, "batch window dim"],
        mel: Float[Tensor, "batch frames bands"] | None,
        embedding: Float[Tensor, "subjects tokens rank"],
        style: Float[Tensor, "batch style"],
        subject: Int[Tensor, " batch"] | None = None,
    ) -> GavaOutput:
        """Displacements and pose of a batch of frames.

        Parameters
        ----------
        window : (B, W, D)
            Speech features around each frame.
        mel : (B, L, F) or None
            Log-mel frames around each frame; may be None without pose.
        embedding : (S, tokens, rank)
            What `embed` gave.
        style : (B, style)
            What `style` gave.
        subject : (B,), optional
            Rows of `embedding`; not needed with one subject.

        Raises
        ------
        ShapeError
            If an input is empty, of another shape than the network's, or holds NaN.
        """
        features, pose_feature = self.tokens(window, mel, embedding, style, subject)
        if isinstance(self.decoder, GlobalDecoder):
            moved, turned = self.decoder(features.flatten(1), pose_feature)
        else:
            if pose_feature is not None:
                features = torch.cat([features, pose_feature[:, None]], dim=1)
            moved, turned = self.decoder(features, self.graph())
        displacements = self.surface.prolong(moved * self.surface.amplitude[:, None])
        if turned is None:
            pose = window.new_zeros(len(window), 3)
        else:
            pose = self.pose_mean + turned.float() * self.pose_scale
        return GavaOutput(displacements, pose)

    @torch.no_grad()
    def attention_maps(
        self,
        window: Float[Tensor, "batch window dim"],
        mel: Float[Tensor, "batch frames bands"] | None,
        embedding: Float[Tensor, "subjects tokens rank"],
        style: Float[Tensor, "batch style"],
        subject: Int[Tensor, " batch"] | None = None,
    ) -> list[AttentionMaps]:
        """Of every block: the attention each token receives, and the pose token's row (Figs. 7, 10, 11).

        Raises
        ------
        OptionError
            With decoder "mlp", which has no attention.
        """
        if not isinstance(self.decoder, TransformerDecoder):
            raise OptionError('decoder "mlp" has no attention maps')
        features, pose_feature = self.tokens(window, mel, embedding, style, subject)
        if pose_feature is not None:
            features = torch.cat([features, pose_feature[:, None]], dim=1)
        return self.decoder.maps(features, self.graph())

    def _check(self, window: Tensor, mel: Tensor | None) -> None:
        config = self.config
        if window.shape[1:] != (config.window, config.feature_dim) or not len(window):
            raise ShapeError(
                f"speech windows must have shape (frames, {config.window}, {config.feature_dim}), not "
                f"{tuple(window.shape)}: this checkpoint reads features of encoder {config.encoder!r}"
            )
        if config.pose and (mel is None or mel.shape != (len(window), config.mel_frames, config.mel_bands)):
            given = None if mel is None else tuple(mel.shape)
            expected = (len(window), config.mel_frames, config.mel_bands)
            raise ShapeError(f"mel windows must have shape {expected}, not {given}")
        if not torch.compiler.is_compiling():
            for name, tensor in (("speech windows", window), ("mel windows", mel)):
                if tensor is not None and not torch.isfinite(tensor).all():
                    raise ShapeError(f"{name} hold NaN or infinite values: clean the audio first")

    # -- files --------------------------------------------------------------------------------------------

    def generate_model_card(self, *args, **kwargs) -> ModelCard:
        """README.md of a saved folder, where whoever saves it has not written another."""
        return ModelCard(model_card(self))

    @classmethod
    def restored(cls, config: GavaConfig, state: Mapping[str, Tensor], file: Callable[[str], Path]) -> "Gava":
        prefixes = ["surface.", *(f"others.{k}." for k in range(len(config.each) - 1))]
        surfaces = [
            VertexTokens.from_state({n.removeprefix(p): t for n, t in state.items() if n.startswith(p)})
            for p in prefixes
        ]
        model = cls(config, surfaces[0], surfaces[1:])
        model.load_state_dict(state)
        return model


def model_card(model: Gava, sections: Mapping[str, str] | None = None) -> str:
    """README.md of a checkpoint: what it is, how to use it, and what else is known, by heading."""
    config = model.config
    surfaces = [model.surface, *model.others]
    rows = []
    for entry, surface in zip(config.each, surfaces, strict=True):
        head = f", head `{entry.head}`" if entry.head else ""
        name = f"{entry.name}: " if entry.name else ""
        counts = f"{surface.n_vertices:,} vertices, {surface.n_tokens:,} tokens"
        rows.append(f"- {name}{counts}, {entry.fps:g} frames a second{head}")
    text = [
        "---\nlibrary_name: meshanim\ntags: [talking-head, speech-driven-animation]\n---",
        "# GAVA: speech to a talking head",
        "Speech to vertex displacements and head pose by attention over the mesh (Li et al., TVCG 2025).",
        "    meshanim animate speech.wav -o talk.mp4 --model FOLDER",
        f"Features `{config.features}`, decoder `{config.decoder}`, width {config.width}, "
        f"{config.layers} layers, {config.heads} heads, rank {config.rank}. Speech encoder "
        f"`{config.encoder}`. Everything else is in `{CONFIG}`.",
        "\n".join(rows),
        f"Styles: {', '.join(config.subjects) or 'none'}. Emotions: {', '.join(config.emotions)}.",
    ]
    for heading, content in (sections or {}).items():
        text += [f"## {heading}", content]
    return "\n\n".join(text) + "\n"
