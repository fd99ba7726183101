"""The parts of GAVA: what a vertex is, how a speech window is read, and the three decoders."""

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from meshanim.attention import AttentionMaps, MeshAttention, MeshGraph
from meshanim.errors import OptionError

__all__ = [
    "DenseAttention",
    "GlobalDecoder",
    "PoseEncoder",
    "SparseRows",
    "TransformerDecoder",
    "VertexEmbedding",
    "WindowEncoder",
]


class _SparseProduct(torch.autograd.Function):
    """Rows of a sparse matrix times a dense one, with the transpose at hand for the gradient."""

    @staticmethod
    def forward(context, dense: Tensor, *parts: Tensor) -> Tensor:
        context.save_for_backward(*parts)
        offsets, columns, values = parts[:3]
        return functional.embedding_bag(
            columns, dense, offsets, mode="sum", per_sample_weights=values, include_last_offset=True
        )

    @staticmethod
    def backward(context, gradient: Tensor):
        parts = context.saved_tensors
        offsets, columns, values = parts[3:]
        back = functional.embedding_bag(
            columns,
            gradient.contiguous(),
            offsets,
            mode="sum",
            per_sample_weights=values,
            include_last_offset=True,
        )
        return back, None, None, None, None, None, None


class SparseRows(nn.Module):
    """A fixed sparse matrix that carries vertex attributes from one mesh to another.

    Parameters
    ----------
    rows, columns : (nonzeros,) int
        Positions.
    values : (nonzeros,)
        Weights; each row of a prolongation sums to one.
    shape : (int, int)
        Rows and columns of the matrix.
    """

    def __init__(
        self,
        rows: Int[Tensor, " nonzeros"],
        columns: Int[Tensor, " nonzeros"],
        values: Float[Tensor, " nonzeros"],
        shape: tuple[int, int],
    ):
        super().__init__()
        self.shape = shape
        self.register_buffer("rows", rows.to(torch.int32))
        self.register_buffer("columns", columns.to(torch.int32))
        self.register_buffer("values", values.to(torch.float32))
        matrix = (*_grouped(rows, columns, shape[0]), values), (*_grouped(columns, rows, shape[1]), values)
        for name, (order, offsets, others, weights) in zip(("forward", "backward"), matrix):
            self.register_buffer(f"{name}_offsets", offsets, persistent=False)
            self.register_buffer(f"{name}_columns", others, persistent=False)
            self.register_buffer(f"{name}_values", weights[order].to(torch.float32), persistent=False)

    def forward(self, attributes: Float[Tensor, "batch columns width"]) -> Float[Tensor, "batch rows width"]:
        """Carry attributes over: one sparse product for the whole batch."""
        batch, columns, width = attributes.shape
        flat = attributes.transpose(0, 1).reshape(columns, batch * width)
        flat = flat.float() if flat.dtype in (torch.float16, torch.bfloat16) else flat
        parts = [
            getattr(self, f"{direction}_{part}")
            for direction in ("forward", "backward")
            for part in ("offsets", "columns", "values")
        ]
        parts = [part.to(flat) if part.is_floating_point() else part for part in parts]
        carried = _SparseProduct.apply(flat, *parts)
        return carried.reshape(-1, batch, width).transpose(0, 1)


def _grouped(rows: Tensor, columns: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """The order that sorts entries by row, where each row starts and the last ends, and the columns."""
    order = torch.argsort(rows, stable=True)
    sizes = torch.bincount(rows.long(), minlength=count)
    offsets = torch.cat([sizes.new_zeros(1), sizes.cumsum(0)])
    return order, offsets, columns[order].long()


class WindowEncoder(nn.Module):
    """Convolutions over a window of speech features, halved in time until two steps are left.

    Parameters
    ----------
    dim : int
        Features a frame.
    window : int
        Frames.
    style : int
        Width of the style vector, which shifts every frame after the first projection.
    channels : int
        Features of the convolutions.
    out : int
        Features of the code.
    dropout : float
        While training, of every hidden feature.
    """

    def __init__(self, dim: int, window: int, style: int, channels: int, out: int, dropout: float = 0.0):
        super().__init__()
        self.dropout = nn.Dropout(dropout)
        self.project = nn.Linear(dim, channels)
        self.style = nn.Linear(style, channels, bias=False)
        layers, steps = [], window
        while steps > 2:
            layers.append(nn.Conv1d(channels, channels, 3, stride=2, padding=1))
            steps = (steps + 1) // 2
        self.convolutions = nn.ModuleList(layers)
        self.read = nn.Linear(steps * channels, out)

    def forward(
        self, window: Float[Tensor, "batch window dim"], style: Float[Tensor, "batch style"]
    ) -> Float[Tensor, "batch out"]:
        steps = functional.gelu(self.project(window) + self.style(style)[:, None]).transpose(1, 2)
        for convolution in self.convolutions:
            steps = functional.gelu(convolution(self.dropout(steps)))
        steps = self.dropout(steps)
        return functional.gelu(self.read(steps.flatten(1)))


class PoseEncoder(nn.Module):
    """LSTM over the mel frames around a frame; its last state is the pose feature (GAVA, Sec. III-B).

    Parameters
    ----------
    bands : int
        Mel bands.
    style : int
        Width of the style vector.
    width : int
        Features of the state and of the pose feature.
    """

    def __init__(self, bands: int, style: int, width: int):
        super().__init__()
        self.lstm = nn.LSTM(bands, width, batch_first=True)
        self.style = nn.Linear(style, width, bias=False)
        self.read = nn.Linear(width, width)

    def forward(
        self, mel: Float[Tensor, "batch frames bands"], style: Float[Tensor, "batch style"]
    ) -> Float[Tensor, "batch width"]:
        _, (state, _) = self.lstm(mel)
        return self.read(state[0]) + self.style(style)


class VertexEmbedding(nn.Module):
    """What a vertex is, from geometry alone: a small network on its descriptors.

    The number of parameters does not depend on the mesh.

    Parameters
    ----------
    descriptors : int
        Fixed features a vertex.
    hidden : int
        Width of the two hidden layers.
    rank : int
        Features of the embedding: one scalar field over the head for each code.
    """

    def __init__(self, descriptors: int, hidden: int, rank: int):
        super().__init__()
        self.network = nn.Sequential(
            nn.Linear(descriptors + 3, hidden),
            nn.GELU(),
            nn.Linear(hidden, hidden),
            nn.GELU(),
            nn.Linear(hidden, rank),
        )

    def forward(
        self,
        descriptors: Float[Tensor, "tokens descriptors"],
        identity: Float[Tensor, "subjects tokens 3"],
    ) -> Float[Tensor, "subjects tokens rank"]:
        """Embed the vertices of each subject; `identity` is template minus reference in centimetres."""
        first = self.network[0]
        assert isinstance(first, nn.Linear)
        shared = functional.linear(descriptors, first.weight[:, :-3], first.bias)
        hidden = shared + functional.linear(identity, first.weight[:, -3:])
        for layer in list(self.network)[1:]:
            hidden = layer(hidden)
        return hidden


class DenseAttention(nn.Module):
    """Every vertex attends to every vertex: the ablation "SA". The pose token sees all and is seen by none.

    Parameters
    ----------
    width, heads : int
        As in `MeshAttention`.
    """

    def __init__(self, width: int, heads: int):
        super().__init__()
        if width % heads:
            raise OptionError(f"width {width} is not a multiple of {heads} heads")
        self.heads = heads
        self.project_in = nn.Linear(width, 3 * width)
        self.project_out = nn.Linear(width, width)

    def forward(
        self, tokens: Float[Tensor, "batch tokens width"], graph: MeshGraph
    ) -> Float[Tensor, "batch tokens width"]:
        query, key, value = self._project(tokens)
        n = graph.n_vertices
        attended = functional.scaled_dot_product_attention(query[:, :, :n], key[:, :, :n], value[:, :, :n])
        if graph.global_token:
            last = functional.scaled_dot_product_attention(query[:, :, n:], key, value)
            attended = torch.cat([attended, last], dim=2)
        return self.project_out(attended.transpose(1, 2).flatten(2))

    @torch.no_grad()
    def maps(self, tokens: Float[Tensor, "batch tokens width"], graph: MeshGraph) -> AttentionMaps:
        """As `MeshAttention.maps`; quadratic in the vertices."""
        query, key, _ = self._project(tokens)
        scores = query @ key.transpose(2, 3) * query.shape[-1] ** -0.5
        n = graph.n_vertices
        received = scores[:, :, :n, :n].softmax(-1).amax(2).transpose(1, 2)
        row = scores[:, :, -1].softmax(-1)[..., :n].transpose(1, 2) if graph.global_token else None
        return AttentionMaps(received, row)

    def _project(self, tokens: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        fused = self.project_in(tokens).unflatten(-1, (3, self.heads, -1))
        query, key, value = fused.permute(2, 0, 3, 1, 4).unbind(0)
        return query, key, value


class _Block(nn.Module):
    def __init__(self, width: int, heads: int, expansion: float, dense: bool):
        super().__init__()
        hidden = round(width * expansion)
        self.norm_attention = nn.LayerNorm(width)
        self.attention = DenseAttention(width, heads) if dense else MeshAttention(width, heads)
        self.norm_feedforward = nn.LayerNorm(width)
        self.widen = nn.Linear(width, hidden)
        self.narrow = nn.Linear(hidden, width)

    def forward(self, tokens: Tensor, graph: MeshGraph) -> Tensor:
        tokens = tokens + self.attention(self.norm_attention(tokens), graph)
        return tokens + self.narrow(functional.gelu(self.widen(self.norm_feedforward(tokens))))


class TransformerDecoder(nn.Module):
    """Attention blocks (pre-norm, residual) and the two heads.

    The heads read the residual stream without a last normalisation, so that how far a vertex moves is not
    divided out. Both start at zero: an untrained model holds the template still.

    Parameters
    ----------
    width, layers, heads : int
        Of the blocks.
    expansion : float
        Hidden features of the feed-forward layer, in widths.
    dense : bool
        All-pairs attention (the ablation SA) in place of the mesh's neighbours.
    """

    def __init__(self, width: int, layers: int, heads: int, expansion: float, dense: bool):
        super().__init__()
        self.blocks = nn.ModuleList(_Block(width, heads, expansion, dense) for _ in range(layers))
        self.displacement = _zero(nn.Linear(width, 3))
        self.pose = _zero(nn.Linear(width, 3))

    def forward(
        self, tokens: Float[Tensor, "batch tokens width"], graph: MeshGraph
    ) -> tuple[Float[Tensor, "batch vertices 3"], Float[Tensor, "batch 3"] | None]:
        for block in self.blocks:
            tokens = block(tokens, graph)
        pose = self.pose(tokens[:, -1]) if graph.global_token else None
        return self.displacement(tokens[:, : graph.n_vertices]), pose

    def start_as_identity(self) -> None:
        """Make every block give what it is given, until it learns."""
        for block in self.blocks:
            assert isinstance(block, _Block)
            _zero(block.attention.project_out)
            _zero(block.narrow)

    @torch.no_grad()
    def maps(self, tokens: Float[Tensor, "batch tokens width"], graph: MeshGraph) -> list[AttentionMaps]:
        """The attention maps of every block."""
        maps = []
        for block in self.blocks:
            assert isinstance(block, _Block)
            maps.append(block.attention.maps(block.norm_attention(tokens), graph))
            tokens = block(tokens, graph)
        return maps


class GlobalDecoder(nn.Module):
    """All vertices at once through one hidden layer: the ablation "MLP" (VOCA's kind of decoder).

    Its parameters grow with the number of vertices; features of the vertices, where there are any, are
    read side by side.

    Parameters
    ----------
    features : int
        All input features of a frame.
    pose_width : int
        Features of the pose feature; 0 without pose.
    hidden : int
        Hidden features.
    vertices : int
        Vertices that move.
    """

    def __init__(self, features: int, pose_width: int, hidden: int, vertices: int):
        super().__init__()
        self.first = nn.Linear(features, hidden)
        self.second = nn.Linear(hidden, hidden)
        self.displacement = _zero(nn.Linear(hidden, 3 * vertices))
        self.pose = _zero(nn.Linear(pose_width, 3)) if pose_width else None

    def forward(
        self, features: Float[Tensor, "batch features"], pose: Float[Tensor, "batch pose"] | None
    ) -> tuple[Float[Tensor, "batch vertices 3"], Float[Tensor, "batch 3"] | None]:
        hidden = functional.gelu(self.second(functional.gelu(self.first(features))))
        turned = None if self.pose is None or pose is None else self.pose(functional.gelu(pose))
        return self.displacement(hidden).unflatten(-1, (-1, 3)), turned


def _zero(layer: nn.Linear) -> nn.Linear:
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer
