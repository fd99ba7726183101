"""Vertices to blendshape weights: a box-constrained least squares problem a frame, factorised once."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from meshanim.errors import OptionError, ShapeError
from meshanim.heads import Head
from meshanim.motion.box_programs import Backend, BoxPrograms, ProgramState, chosen_backend
from meshanim.motion.displacement_products import DisplacementProducts
from meshanim.motion.vertex_sampling import VertexSampling, sample_vertices

__all__ = [
    "BlendshapeSolver",
    "BlendshapeStream",
    "JawTracking",
    "SolverOptions",
    "mirrored_pairs",
    "solve_blendshapes",
]

Pairs = tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class SolverOptions:
    """Terms of the solve (Audio2Face-3D, Eq. 12, 13, 18 and 19).

    The objective is E(w) = data + l2 |w|² + l1 (1'w)² + temporal |w - w_previous|² + symmetry |S w|² +
    jaw_t |C w - d_jaw|², over 0 <= w <= 1. The data term is the weighted mean over the sampled vertices of
    |dv - D w|², in square units of the head: its bounding box measures `template_size` of them, so that for
    a grown-up's whole head a unit is about 8 mm, and no strength depends on units, size or number of
    vertices.

    Parameters
    ----------
    l2 : float
        Ridge.
    l1 : float
        Sparsity, by the paper's quadratic proxy.
    temporal : float
        Pull towards the weights of the frame before.
    symmetry : float
        Pull of the `symmetric` pairs towards equal weights.
    jaw : float
        Strength l0 of the jaw term, which is l0 exp(-|d_jaw|² / 2 s²) (1 - exp(-lip² / 2 s²)) in each frame.
    jaw_sigma : float
        s, metres: a typical move of the jaw.
    active : tuple of str, optional
        Shapes that are solved for, all if not given; the others stay at zero.
    cancelling : tuple of pairs of str
        Shapes that exclude each other: after a first solve the smaller of each pair is held at zero and the
        rest solved again. Pairs that are not both active are left out.
    symmetric : tuple of pairs of str, optional
        `mirrored_pairs` if not given.
    multipliers, offsets : mapping of str to float
        Applied to the weights at the end: w * multiplier + offset, also of inactive shapes.
    template_size : float
        Units along the diagonal of the bounding box of the neutral.
    nvidia_parity : bool
        Reproduce two things that NVIDIA's own solver does: minimise |A w - b|² over the box for the normal
        equations A w = b, which is another problem as soon as a weight is at a bound; and pull towards the
        previous weights with a hundredth of `temporal`, while the whole of it acts as ridge.

    Raises
    ------
    OptionError
        If a strength is negative or not finite.
    """

    l2: float = 1e-5
    l1: float = 1e-6
    temporal: float = 0.0
    symmetry: float = 0.0
    jaw: float = 0.0
    jaw_sigma: float = 0.005
    active: tuple[str, ...] | None = None
    cancelling: Pairs = ()
    symmetric: Pairs | None = None
    multipliers: Mapping[str, float] = field(default_factory=dict)
    offsets: Mapping[str, float] = field(default_factory=dict)
    template_size: float = 54.7
    nvidia_parity: bool = False

    def __post_init__(self):
        for name in ("l2", "l1", "temporal", "symmetry", "jaw"):
            if not 0 <= getattr(self, name) < np.inf:
                raise OptionError(f"{name} must be finite and not negative, not {getattr(self, name)}")
        for name in ("jaw_sigma", "template_size"):
            if not 0 < getattr(self, name) < np.inf:
                raise OptionError(f"{name} must be finite and positive, not {getattr(self, name)}")
        if self.jaw and self.nvidia_parity:
            raise OptionError("NVIDIA's solver has no jaw term: jaw needs nvidia_parity off")


@dataclass(frozen=True)
class JawTracking:
    """Where the jaw term reads the jaw and the lips.

    Parameters
    ----------
    vertices : (n,) int
        Vertices whose mean move is the jaw's: lower teeth, or the chin.
    lip_pairs : (P, 2) int
        Upper and lower vertices of the middle of the mouth.
    """

    vertices: Int[np.ndarray, " jaw"]
    lip_pairs: Int[np.ndarray, "pairs 2"]

    @classmethod
    def of_head(cls, head: Head) -> "JawTracking":
        """From the head's teeth that `jawOpen` moves, or its jaw region, and its lip pairs.

        Raises
        ------
        OptionError
            If the head names no lip pairs, or has neither.
        """
        pairs = getattr(head, "lip_pairs", None)
        if pairs is None:
            raise OptionError("the jaw term needs lip pairs, which this head does not name: give JawTracking")
        vertices = head.regions["jaw"]
        if "jawOpen" in head.expression_names and len(head.regions["teeth"]):
            row = head.expression_names.index("jawOpen")
            travel = head.expression_directions[row].detach().cpu().unflatten(0, (-1, 3)).norm(dim=1).numpy()
            teeth = head.regions["teeth"]
            vertices = teeth[travel[teeth] > 0.5 * travel[teeth].max()]
        if not len(vertices):
            raise OptionError("the jaw term needs teeth or a jaw region, which this head does not have")
        return cls(vertices, np.asarray(pairs, np.int64))


def mirrored_pairs(names: Sequence[str]) -> Pairs:
    """Pairs XLeft, XRight among ARKit's names that a face mostly moves alike: not gaze, jaw or mouth."""
    stems = [name.removesuffix("Left") for name in names if name.endswith("Left")]
    return tuple(
        (f"{stem}Left", f"{stem}Right")
        for stem in stems
        if f"{stem}Right" in names and stem not in ("", "jaw", "mouth") and not stem.startswith("eyeLook")
    )


class BlendshapeSolver:
    """Finds the weights of blendshapes that come closest to given vertices (Audio2Face-3D, Sec. 6 and 9.4).

    The Gram matrix of the shapes is made here; a frame costs one product with the shapes and one small
    quadratic program, which is solved exactly (KKT residual 1e-11 of the largest entry). float32 vertices
    are multiplied in float32 where the native extension is built, float64 ones in float64; all else is
    float64.

    Parameters
    ----------
    neutral : (V, 3) float
        The face at rest that displacements are from, metres (any unit, in truth).
    deltas : (E, V, 3) float
        What each shape adds at weight 1.
    names : (E,) str
    options : SolverOptions, optional
    sampling : VertexSampling, optional
        Vertices that count; all alike if not given. `from_head` chooses them.
    jaw : JawTracking, optional
        Needed if the jaw term has a strength.
    backend : "auto", "native" or "reference"

    Raises
    ------
    ShapeError
        If the arrays do not fit together or hold NaN.
    OptionError
        If an option names a shape that does not exist, or the sampled vertices and the strengths do not
        determine the weights.
    BackendError
        If a backend was asked for that is not built.
    """

    def __init__(
        self,
        neutral: Float[np.ndarray, "vertices 3"],
        deltas: Float[np.ndarray, "shapes vertices2 3"],
        names: Sequence[str],
        options: SolverOptions | None = None,
        sampling: VertexSampling | None = None,
        jaw: JawTracking | None = None,
        backend: Backend = "auto",
    ):
        self.options = options = SolverOptions() if options is None else options
        self.names = tuple(names)
        self.backend = chosen_backend(backend)
        self.neutral = np.asarray(neutral, np.float64)
        self.deltas = np.asarray(deltas)
        if self.deltas.shape != (len(self.names), len(self.neutral), 3) or not len(self.names):
            raise ShapeError(
                f"{len(self.names)} names and {len(self.neutral)} vertices need deltas of shape "
                f"({len(self.names)}, {len(self.neutral)}, 3), not {self.deltas.shape}"
            )
        if not (np.isfinite(self.neutral).all() and np.isfinite(self.deltas).all()):
            raise ShapeError("the neutral or the deltas hold NaN or infinite numbers")
        self.sampling = sampling or VertexSampling(np.arange(len(neutral)), np.ones(len(neutral)))
        if self.sampling.vertices.max() >= len(self.neutral):
            raise ShapeError(f"sampled vertex {self.sampling.vertices.max()} of {len(self.neutral)}")
        self.unit = float(np.linalg.norm(np.ptp(self.neutral, axis=0))) / options.template_size
        if not self.unit > 0:
            raise ShapeError("all vertices of the neutral coincide: it has no size")
        self.active = self._rows_of(self.names if options.active is None else options.active)
        if not len(self.active):
            raise OptionError("no shape is active")
        self.jaw = jaw
        if options.jaw and jaw is None:
            raise OptionError("the jaw term needs a JawTracking")
        self._multiplier, self._offset = (
            self._by_name(options.multipliers, 1),
            self._by_name(options.offsets, 0),
        )
        self._products = DisplacementProducts(
            self.neutral, self.deltas[self.active], self.sampling, self.unit, self.backend
        )
        self._programs, self._premultiplier = self._make_programs()

    @classmethod
    def from_head(
        cls,
        head: Head,
        options: SolverOptions | None = None,
        samples: int | None = None,
        neutral: Float[np.ndarray, "vertices 3"] | None = None,
        backend: Backend = "auto",
    ) -> "BlendshapeSolver":
        """The solver of a head's expressions.

        Parameters
        ----------
        head : Head
        options : SolverOptions, optional
        samples : int, optional
            How many vertices to look at, as in `sample_vertices`.
        neutral : (V, 3), optional
            Whose face moves; the head's template if not given.
        """
        deltas = head.expression_directions.detach().cpu().unflatten(1, (-1, 3)).numpy()
        needs_jaw = options is not None and options.jaw > 0
        return cls(
            head.mesh.vertices if neutral is None else neutral,
            deltas,
            head.expression_names,
            options,
            sample_vertices(head, samples),
            JawTracking.of_head(head) if needs_jaw else None,
            backend,
        )

    def __call__(
        self,
        vertices: Float[np.ndarray, "frames vertices 3"],
        jaw: Float[np.ndarray, "frames 3"] | None = None,
        lip_gap: Float[np.ndarray, " frames"] | None = None,
    ) -> Float[np.ndarray, "frames shapes"]:
        """Weights of every frame. Frames are solved on all of torch's threads where no term ties them.

        Parameters
        ----------
        vertices : (T, V, 3) float32 or float64
            In the unit of the neutral, without head pose.
        jaw : (T, 3), optional
            Moves of the jaw that the jaw term follows; those of its vertices in the frames if not given.
        lip_gap : (T,), optional
            Vertical distance between the lips; that of the lip pairs in the frames if not given.

        Returns
        -------
        (T, E) float64

        Raises
        ------
        ShapeError
            If the vertices are not those of the neutral in number, or a sampled one is NaN or infinite.
        """
        return self.stream().push(vertices, jaw, lip_gap)

    def stream(self) -> "BlendshapeStream":
        """A sequence that is solved as its frames arrive."""
        return BlendshapeStream(self)

    def reconstruct(
        self, weights: Float[np.ndarray, "frames shapes"]
    ) -> Float[np.ndarray, "frames vertices 3"]:
        """neutral + D w, in the precision of the deltas (Eq. 11)."""
        if weights.ndim != 2 or weights.shape[1] != len(self.names):
            raise ShapeError(f"weights must be (frames, {len(self.names)}), not {weights.shape}")
        flat = self.deltas.reshape(len(self.names), -1)
        moved = weights.astype(flat.dtype) @ flat
        return moved.reshape(len(weights), -1, 3) + self.neutral.astype(flat.dtype)

    @cached_property
    def gram(self) -> Float[np.ndarray, "active active"]:
        """Half the Hessian of E without the jaw term, over the active shapes."""
        options, n = self.options, len(self.active)
        gram = (
            self._products.gram + (options.l2 + options.temporal) * np.eye(n) + options.l1 * np.ones((n, n))
        )
        for first, second in self._active_pairs(
            mirrored_pairs(self.names) if options.symmetric is None else options.symmetric
        ):
            row = np.zeros(n)
            row[[first, second]] = 1, -1
            gram += options.symmetry * np.outer(row, row)
        return gram

    def _make_programs(self) -> tuple[BoxPrograms, np.ndarray | None]:
        options, gram = self.options, self.gram
        pairs = np.array(self._active_pairs(options.cancelling), np.int32).reshape(-1, 2)
        pull = options.temporal * np.eye(len(gram)) if options.temporal else None
        premultiplier = None
        if options.nvidia_parity:
            premultiplier = gram
            pull = None if pull is None else gram @ pull / 100
            gram = gram @ gram
        values, vectors = np.linalg.eigh(gram)
        if values[0] <= 1e-13 * values[-1]:
            worst = np.argsort(-np.abs(vectors[:, 0]))[:3]
            raise OptionError(
                f"the sampled vertices do not tell the weights of {', '.join(self._names_of(worst))} apart "
                "(their shapes move nothing there, or move alike): raise l2 or leave some inactive"
            )
        extra = self._jaw_shapes @ self._jaw_shapes.T if options.jaw else None
        return BoxPrograms(gram, pairs, pull, extra), premultiplier

    @cached_property
    def _jaw_shapes(self) -> Float[np.ndarray, "active 3"]:
        """C of Eq. 18, transposed, in units of the head."""
        if self.jaw is None:
            raise OptionError("the jaw term needs a JawTracking")
        return self.deltas[self.active][:, self.jaw.vertices].mean(1, dtype=np.float64) / self.unit

    def _solve(
        self,
        vertices: np.ndarray,
        state: ProgramState,
        jaw: np.ndarray | None,
        lip_gap: np.ndarray | None,
    ) -> Float[np.ndarray, "frames shapes"]:
        if vertices.ndim != 3 or vertices.shape[1:] != self.neutral.shape:
            raise ShapeError(f"vertices must be (frames, {len(self.neutral)}, 3), not {vertices.shape}")
        linear = self._products(vertices)
        if not np.isfinite(linear).all():
            bad = np.flatnonzero(~np.isfinite(linear).all(1))
            raise ShapeError(f"{len(bad)} frames hold NaN or infinite vertices, the first is {bad[0]}")
        if self._premultiplier is not None:
            linear = linear @ self._premultiplier
        strength = None
        if self.options.jaw:
            moved, strength = self._jaw_term(vertices, jaw, lip_gap)
            linear = linear + strength[:, None] * (moved / self.unit @ self._jaw_shapes.T)
        solved = self._programs.solve(linear, state, strength, self.backend)
        weights = np.zeros((len(vertices), len(self.names)))
        weights[:, self.active] = solved
        weights *= self._multiplier
        weights += self._offset
        return weights

    def _jaw_term(
        self, vertices: np.ndarray, jaw: np.ndarray | None, lip_gap: np.ndarray | None
    ) -> tuple[Float[np.ndarray, "frames 3"], Float[np.ndarray, " frames"]]:
        assert self.jaw is not None  # checked at the beginning
        if jaw is None:
            at = self.jaw.vertices
            jaw = vertices[:, at].mean(1, dtype=np.float64) - self.neutral[at].mean(0)
        if lip_gap is None:
            upper, lower = self.jaw.lip_pairs.T
            lip_gap = (vertices[:, upper, 1] - vertices[:, lower, 1]).mean(1, dtype=np.float64).clip(0)
        if jaw.shape != (len(vertices), 3) or lip_gap.shape != (len(vertices),):
            raise ShapeError(
                f"jaw and lip_gap must have a row for each of {len(vertices)} frames, not {jaw.shape} and "
                f"{lip_gap.shape}"
            )
        wide = 2 * self.options.jaw_sigma**2
        strength = self.options.jaw * np.exp(-(jaw**2).sum(1) / wide) * -np.expm1(-(lip_gap**2) / wide)
        if not np.isfinite(strength).all():
            raise ShapeError("jaw or lip_gap holds NaN or infinite numbers")
        return jaw, strength

    def _rows_of(self, names: Sequence[str]) -> Int[np.ndarray, " rows"]:
        unknown = [name for name in names if name not in self.names]
        if unknown:
            raise OptionError(f"no shape named {', '.join(unknown)}; there are {', '.join(self.names)}")
        return np.array([self.names.index(name) for name in dict.fromkeys(names)], np.int64)

    def _names_of(self, active: np.ndarray) -> list[str]:
        return [self.names[self.active[index]] for index in active]

    def _active_pairs(self, pairs: Pairs) -> list[tuple[int, int]]:
        place = {row: index for index, row in enumerate(self.active.tolist())}
        rows = [self._rows_of(pair).tolist() for pair in pairs]
        if any(len(row) != 2 for row in rows):
            raise OptionError("a pair names one shape twice")
        return [(place[a], place[b]) for a, b in rows if a in place and b in place]

    def _by_name(self, values: Mapping[str, float], otherwise: float) -> Float[np.ndarray, " shapes"]:
        result = np.full(len(self.names), float(otherwise))
        result[self._rows_of(list(values))] = list(values.values())
        if not np.isfinite(result).all():
            raise OptionError("multipliers and offsets must be finite")
        return result


class BlendshapeStream:
    """One sequence of a solver, frame by frame: what `BlendshapeSolver.stream` gives.

    Frames of all calls have the weights that the solver gives for the whole sequence, up to rounding.
    """

    def __init__(self, solver: BlendshapeSolver):
        self.solver = solver
        self._state = ProgramState.start(len(solver.active))

    def push(
        self,
        vertices: Float[np.ndarray, "frames vertices 3"],
        jaw: Float[np.ndarray, "frames 3"] | None = None,
        lip_gap: Float[np.ndarray, " frames"] | None = None,
    ) -> Float[np.ndarray, "frames shapes"]:
        """Weights of the next frames, one or many; arguments and errors as of the solver."""
        return self.solver._solve(vertices, self._state, jaw, lip_gap)


def solve_blendshapes(
    vertices: Float[np.ndarray, "frames vertices 3"],
    neutral: Float[np.ndarray, "vertices 3"],
    deltas: Float[np.ndarray, "shapes vertices2 3"],
    names: Sequence[str],
    options: SolverOptions | None = None,
    sampling: VertexSampling | None = None,
    backend: Backend = "auto",
) -> Float[np.ndarray, "frames shapes"]:
    """Weights of frames in one call; `BlendshapeSolver` keeps what is made once for the next call."""
    return BlendshapeSolver(neutral, deltas, names, options, sampling, backend=backend)(vertices)
