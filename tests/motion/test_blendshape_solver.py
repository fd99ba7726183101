"""The blendshape solve against trusted solvers of the same problem, written down independently."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from meshanim import _native
from meshanim.errors import BackendError, OptionError, ShapeError
from meshanim.heads import load_head
from meshanim.motion import box_programs
from meshanim.motion.blendshape_solver import (
    BlendshapeSolver,
    JawTracking,
    SolverOptions,
    mirrored_pairs,
    solve_blendshapes,
)
from meshanim.motion.box_programs import BoxPrograms, ProgramState
from meshanim.motion.vertex_sampling import VertexSampling, nasolabial_folds, sample_vertices

NAMES = ("jawOpen", "mouthSmileLeft", "mouthSmileRight", "cheekPuff", "cheekSuck", "browInnerUp", "idle")


@pytest.fixture(scope="module")
def head():
    return load_head("default")


@pytest.fixture(scope="module")
def made():
    """A rig of random shapes with different reach, and frames that are noisy mixtures of them."""
    rng = np.random.default_rng(3)
    neutral = rng.normal(0, 0.05, (90, 3))
    deltas = rng.normal(0, 1, (7, 90, 3)) * rng.uniform(0.002, 0.02, (7, 1, 1))
    deltas[1:3, 40:] = 0
    weights = rng.uniform(-0.4, 1.4, (40, 7))
    frames = neutral + np.tensordot(weights, deltas, 1) + rng.normal(0, 0.002, (40, 90, 3))
    return neutral, deltas, frames


def trusted(neutral, deltas, names, frames, options, sampling=None, upper=None, previous=None):
    """Eq. 12 and 13 as rows of one bounded least squares problem a frame, solved by scipy."""
    n = len(deltas)
    unit = np.linalg.norm(np.ptp(neutral, axis=0)) / options.template_size
    at = np.arange(len(neutral)) if sampling is None else sampling.vertices
    weight = np.ones(len(at)) if sampling is None else sampling.weights
    root = np.sqrt(weight / weight.sum())[:, None]
    rows = [(root * deltas[:, at] / unit).reshape(n, -1).T, np.sqrt(options.l2) * np.eye(n)]
    rows += [np.sqrt(options.l1) * np.ones((1, n)), np.sqrt(options.temporal) * np.eye(n)]
    pairs = mirrored_pairs(names) if options.symmetric is None else options.symmetric
    for a, b in pairs:
        row = np.zeros((1, n))
        row[0, names.index(a)], row[0, names.index(b)] = 1, -1
        rows.append(np.sqrt(options.symmetry) * row)
    matrix = np.concatenate(rows)
    solved = []
    for frame in frames:
        goal = np.zeros(len(matrix))
        moved = (root * (frame - neutral)[at] / unit).ravel()
        goal[: len(moved)] = moved
        if previous is not None:
            start = len(moved) + n + 1
            goal[start : start + n] = np.sqrt(options.temporal) * previous
        bound = np.ones(n) if upper is None else upper
        w = lsq_linear(matrix, goal, (0, np.maximum(bound, 1e-13)), method="bvls", tol=1e-15, max_iter=2000).x
        solved.append(w)
        if previous is not None:
            previous = w
    return np.array(solved)


def kkt_residual(gram, linear, weights):
    """By how much the optimality conditions of the box are violated."""
    slope = weights @ gram - linear
    free = np.abs(slope)
    at_zero, at_one = weights <= 0, weights >= 1
    return np.where(at_zero, np.maximum(-slope, 0), np.where(at_one, np.maximum(slope, 0), free)).max()


@pytest.mark.parametrize("backend", ["native", "reference"])
@pytest.mark.parametrize(
    "options",
    [
        SolverOptions(l2=1e-3, l1=0),
        SolverOptions(l2=1e-2, l1=1e-2),
        SolverOptions(l2=1e-3, symmetry=0.3),
        SolverOptions(l2=1e-3, symmetry=0.3, symmetric=(("jawOpen", "idle"),), template_size=3.0),
    ],
)
def test_exact_against_scipy(made, backend, options):
    neutral, deltas, frames = made
    found = solve_blendshapes(frames, neutral, deltas, NAMES, options, backend=backend)
    expected = trusted(neutral, deltas, NAMES, frames, options)
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert 0.1 < (found == 0).mean() < 0.6  # the box matters
    assert (found == 1).any()


@given(
    seed=st.integers(0, 2**31),
    n=st.integers(1, 24),
    spread=st.floats(0, 5),
    shift=st.floats(-2, 2),
    pairs=st.integers(0, 3),
)
@settings(max_examples=150, deadline=None)
def test_programs_satisfy_kkt(seed, n, spread, shift, pairs):
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(n + 3, n)) * 10 ** rng.uniform(-spread / 2, 0, n)
    gram = matrix.T @ matrix + 1e-6 * np.eye(n)
    linear = (rng.normal(shift, 1, (45, n)) @ gram) if seed % 2 else rng.normal(shift, 1, (45, n))
    exclusive = rng.permutation(n)[: 2 * min(pairs, n // 2)].reshape(-1, 2).astype(np.int32)
    state = ProgramState.start(n)
    state.bound[:] = rng.integers(-1, 2, n)
    found = BoxPrograms(gram, np.zeros((0, 2), np.int32)).solve(linear, state, backend="native")
    assert ((found >= 0) & (found <= 1)).all()
    scale = max(np.abs(linear).max(), gram.diagonal().max())
    assert kkt_residual(gram, linear, found) < 1e-10 * scale
    programs = BoxPrograms(gram, exclusive)
    twice = programs.solve(linear, ProgramState.start(n), backend="native")
    lower = np.where(
        found[:, exclusive[:, 0]] < found[:, exclusive[:, 1]] - 1e-9, exclusive[:, 0], exclusive[:, 1]
    )
    for row, w, dropped, b in zip(found, twice, lower, linear):
        assert (w[dropped] == 0).all()
        free = np.setdiff1d(np.arange(n), dropped)
        if len(dropped) == 0:
            np.testing.assert_allclose(w, row, atol=1e-9)
        if len(free):
            assert kkt_residual(gram[np.ix_(free, free)], b[None, free], w[None, free]) < 1e-10 * scale


@given(seed=st.integers(0, 2**31), strength=st.floats(0, 2), feedback=st.floats(0, 2))
@settings(max_examples=20, deadline=None)
def test_native_programs_equal_reference(seed, strength, feedback):
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(20, 9))
    gram, linear = matrix.T @ matrix + 0.1 * np.eye(9), rng.normal(3, 8, (12, 9))
    extra = np.outer(matrix[0], matrix[0])
    programs = BoxPrograms(gram, np.array([[0, 4], [7, 2]], np.int32), feedback * np.eye(9), extra)
    strengths = strength * rng.uniform(size=12)
    native, reference = ProgramState.start(9), ProgramState.start(9)
    found = programs.solve(linear, native, strengths, "native")
    np.testing.assert_allclose(found, programs.solve(linear, reference, strengths, "reference"), atol=1e-9)
    np.testing.assert_allclose(native.previous, found[-1])
    np.testing.assert_allclose(reference.previous, native.previous, atol=1e-9)


def test_exact_on_the_default_head(head):
    """Real shapes, real numbers of vertices, weights that the box cuts: to 1e-6 in float64 and in float32."""
    rng = np.random.default_rng(0)
    solver = BlendshapeSolver.from_head(head)
    weights = np.clip(rng.normal(0.1, 0.4, (24, 53)), 0, 1)
    frames = solver.reconstruct(weights).astype(np.float64) + rng.normal(0, 3e-4, (24, 5124, 3))
    found = solver(frames)
    expected = trusted(
        solver.neutral,
        solver.deltas.astype(np.float64),
        head.expression_names,
        frames[:6],
        solver.options,
        solver.sampling,
    )
    np.testing.assert_allclose(found[:6], expected, atol=1e-6)
    np.testing.assert_allclose(
        solver(frames.astype(np.float32)), solver(frames.astype(np.float32).astype(np.float64)), atol=5e-6
    )
    reference = BlendshapeSolver.from_head(head, backend="reference")
    np.testing.assert_allclose(found[:4], reference(frames[:4]), atol=1e-9)
    exact = solver(solver.reconstruct(weights))
    assert np.abs(exact - weights).max() < 0.1
    assert np.median(np.abs(exact - weights)) < 0.002
    error = np.linalg.norm(solver.reconstruct(exact) - solver.reconstruct(weights), axis=2)
    assert error.max() < 2e-4  # of moves of several centimetres


@pytest.mark.parametrize("isa", ["generic", "avx2", "avx512"])
def test_every_instruction_set(head, isa):
    best = _native.instruction_set()
    try:
        _native.set_instruction_set(isa)
    except ValueError:
        pytest.skip(f"no {isa} here")
    try:
        rng = np.random.default_rng(1)
        for options in (SolverOptions(), SolverOptions(temporal=1e-3)):
            solver = BlendshapeSolver.from_head(head, options, samples=700)
            frames = solver.reconstruct(rng.uniform(-0.2, 0.6, (19, 53))).astype(np.float32)
            np.testing.assert_allclose(solver(frames), solver(frames.astype(np.float64)), atol=2e-5)
    finally:
        _native.set_instruction_set(best)


def test_same_bits_for_any_number_of_threads(head):
    solver = BlendshapeSolver.from_head(head, samples=500)
    rng = np.random.default_rng(2)
    frames = solver.reconstruct(rng.uniform(-0.3, 0.7, (150, 53))).astype(np.float32)
    threads = torch.get_num_threads()
    try:
        results = []
        for count in (1, 2, 3, 7):
            torch.set_num_threads(count)
            results.append(solver(frames))
    finally:
        torch.set_num_threads(threads)
    assert all(np.array_equal(result, results[0]) for result in results[1:])


@pytest.mark.parametrize("backend", ["native", "reference"])
def test_temporal_term_and_streaming(made, backend):
    neutral, deltas, frames = made
    options = SolverOptions(l2=1e-3, l1=0, temporal=2.0)
    solver = BlendshapeSolver(neutral, deltas, NAMES, options, backend=backend)
    whole = solver(frames)
    expected = trusted(neutral, deltas, NAMES, frames, options, previous=np.zeros(7))
    np.testing.assert_allclose(whole, expected, atol=1e-8)
    stream = solver.stream()
    parts = [stream.push(part) for part in np.split(frames, [1, 2, 9, 9, 30])]
    np.testing.assert_allclose(np.concatenate(parts), whole, atol=1e-9)
    free = solve_blendshapes(frames, neutral, deltas, NAMES, SolverOptions(l2=1e-3, l1=0))
    assert np.abs(np.diff(whole, axis=0)).mean() < 0.8 * np.abs(np.diff(free, axis=0)).mean()
    np.testing.assert_array_equal(solver(frames), whole)  # nothing is left over from a call


def test_cancelling_pairs_in_two_passes(made):
    neutral, deltas, frames = made
    deltas = deltas.copy()
    deltas[4] = -0.5 * deltas[3] + 0.3 * deltas[4]
    options = SolverOptions(l2=1e-3, l1=0, cancelling=(("cheekPuff", "cheekSuck"),))
    found = solve_blendshapes(frames, neutral, deltas, NAMES, options)
    once = trusted(neutral, deltas, NAMES, frames, options)
    both = (once[:, 3] > 1e-9) & (once[:, 4] > 1e-9)
    assert both.any()
    assert (found[:, 3] * found[:, 4] == 0).all()
    for t, frame in enumerate(frames):
        upper = np.ones(7)
        upper[3 if once[t, 3] < once[t, 4] else 4] = 0
        expected = trusted(neutral, deltas, NAMES, frame[None], options, upper=upper)[0]
        np.testing.assert_allclose(found[t], expected, atol=1e-8)


def test_active_subset_multipliers_and_offsets(made):
    neutral, deltas, frames = made
    active = ("browInnerUp", "jawOpen", "cheekPuff")
    options = SolverOptions(
        l2=1e-3,
        active=active,
        cancelling=(("cheekPuff", "cheekSuck"),),  # one of them is not active: left out
        multipliers={"jawOpen": 1.5},
        offsets={"jawOpen": 0.1, "idle": 0.25},
    )
    found = solve_blendshapes(frames, neutral, deltas, NAMES, options)
    rows = [5, 0, 3]
    expected = trusted(neutral, deltas[rows], active, frames, SolverOptions(l2=1e-3))
    np.testing.assert_allclose(found[:, [5, 3]], expected[:, [0, 2]], atol=1e-9)
    np.testing.assert_allclose(found[:, 0], 1.5 * expected[:, 1] + 0.1, atol=1e-9)
    assert (found[:, [1, 2, 4]] == 0).all()
    assert (found[:, 6] == 0.25).all()


def test_size_units_and_resolution_change_nothing(made):
    neutral, deltas, frames = made
    options = SolverOptions(l2=1e-2, l1=1e-3, symmetry=0.1)
    base = solve_blendshapes(frames, neutral, deltas, NAMES, options)
    centimetres = solve_blendshapes(100 * frames, 100 * neutral, 100 * deltas, NAMES, options)
    np.testing.assert_allclose(centimetres, base, atol=1e-9)
    twice = solve_blendshapes(
        np.tile(frames, (1, 2, 1)), np.tile(neutral, (2, 1)), np.tile(deltas, (1, 2, 1)), NAMES, options
    )
    np.testing.assert_allclose(twice, base, atol=1e-9)
    half = VertexSampling(np.arange(90)[::-1].copy(), np.where(np.arange(90) < 45, 1.0, 0.0))
    weighted = solve_blendshapes(frames, neutral, deltas, NAMES, options, half)
    moved = frames.copy()
    moved[:, :45] += 1.0  # vertices without weight
    np.testing.assert_allclose(
        solve_blendshapes(moved, neutral, deltas, NAMES, options, half), weighted, atol=1e-9
    )


def test_nvidia_parity(made):
    """Their normal equations solved by bounded least squares, with a hundredth of the pull."""
    neutral, deltas, frames = made
    options = SolverOptions(l2=3e-2, l1=1e-2, temporal=0.5, symmetry=0.2, nvidia_parity=True)
    found = solve_blendshapes(frames, neutral, deltas, NAMES, options)
    s = (np.linalg.norm(np.ptp(neutral, axis=0)) / 54.7) ** 2
    d = deltas.reshape(7, -1).T
    count = len(neutral)
    pair = np.zeros((1, 7))
    pair[0, 1], pair[0, 2] = 1, -1
    # Strengths in NVIDIA's own scaling, of which ours are a share of the number of vertices.
    l1, l2, temporal, symmetry = (
        np.sqrt(1e-2 * count / 0.25),
        3e-2 * count / 10,
        0.5 * count / 100,
        0.2 * count / 10,
    )
    a = d.T @ d + l1**2 * 0.25 * s * np.ones((7, 7)) + l2 * 10 * s * np.eye(7)
    a += temporal * 100 * s * np.eye(7) + symmetry * 10 * s * pair.T @ pair
    previous = np.zeros(7)
    for frame, w in zip(frames, found):
        b = d.T @ (frame - neutral).ravel() + temporal * s * previous
        previous = lsq_linear(a / s, b / s, (0, 1), method="bvls", tol=1e-15, max_iter=2000).x
        np.testing.assert_allclose(w, previous, atol=1e-8)
    consistent = solve_blendshapes(
        frames, neutral, deltas, NAMES, SolverOptions(l2=3e-2, l1=1e-2, temporal=0.5, symmetry=0.2)
    )
    assert np.abs(consistent - found).max() > 0.05


@pytest.mark.parametrize("backend", ["native", "reference"])
def test_jaw_term(made, backend):
    neutral, deltas, frames = made
    jaw = JawTracking(np.arange(50, 60), np.array([[1, 2], [3, 4]]))
    options = SolverOptions(l2=1e-3, l1=0, jaw=4.0, jaw_sigma=0.01)
    solver = BlendshapeSolver(neutral, deltas, NAMES, options, jaw=jaw, backend=backend)
    rng = np.random.default_rng(5)
    moves, gaps = rng.normal(0, 0.006, (40, 3)), rng.uniform(0, 0.02, 40)
    found = solver(frames, moves, gaps)
    unit = np.linalg.norm(np.ptp(neutral, axis=0)) / 54.7
    c = deltas[:, 50:60].mean(1).T / unit
    base = np.concatenate([deltas.reshape(7, -1).T / unit / np.sqrt(90), np.sqrt(1e-3) * np.eye(7)])
    strengths = []
    for frame, w, move, gap in zip(frames, found, moves, gaps):
        wide = 2 * 0.01**2
        strengths.append(4.0 * np.exp(-(move @ move) / wide) * (1 - np.exp(-(gap**2) / wide)))
        root = np.sqrt(strengths[-1])
        goal = np.concatenate(
            [(frame - neutral).ravel() / unit / np.sqrt(90), np.zeros(7), root * move / unit]
        )
        expected = lsq_linear(
            np.vstack([base, root * c]), goal, (0, 1), method="bvls", tol=1e-15, max_iter=2000
        ).x
        np.testing.assert_allclose(w, expected, atol=1e-8)
    assert np.ptp(strengths) > 1
    measured = frames[:, 50:60].mean(1) - neutral[50:60].mean(0)
    lips = np.maximum((frames[:, [1, 3], 1] - frames[:, [2, 4], 1]).mean(1), 0)
    np.testing.assert_allclose(solver(frames), solver(frames, measured, lips), atol=1e-9)
    with pytest.raises(ShapeError, match="NaN"):
        solver(frames, moves * np.nan, gaps)


def test_the_jaw_term_keeps_the_jaw_shut_behind_open_lips(head):
    """Sec. 9.4: the lips of an EE are open on a closed jaw; skin that no shape explains must not open it."""
    names = list(head.expression_names)
    ee = head.expression({"mouthLowerDownLeft": 0.9, "mouthLowerDownRight": 0.9, "mouthStretchLeft": 0.4})
    vertices = head.deform(expression=ee).numpy()
    lower_face = np.setdiff1d(head.regions["face"], head.regions["upper_face"])
    vertices[:, lower_face, 1] -= 0.002  # two millimetres that only a jaw would give
    jaw = names.index("jawOpen")
    plain = BlendshapeSolver.from_head(head)(vertices)[0, jaw]
    driven = BlendshapeSolver.from_head(head, SolverOptions(jaw=2.0))(vertices)[0, jaw]
    assert plain > 0.03
    assert driven < 0.5 * plain


def test_sampling_follows_importance(head):
    every, some = sample_vertices(head), sample_vertices(head, 600)
    assert len(some.vertices) == 600
    assert set(some.vertices) <= set(every.vertices)
    np.testing.assert_allclose(some.weights.sum(), every.weights.sum())
    for region in ("scalp", "neck", "ears"):
        assert not np.isin(every.vertices, head.regions[region]).any()

    def density(region):
        area = head.mesh.mass.diagonal()
        inside = np.intersect1d(head.regions[region], every.vertices)
        return np.isin(some.vertices, inside).sum() / area[inside].sum()

    cheeks = np.setdiff1d(
        head.regions["face"],
        np.concatenate([head.regions["lips"], head.regions["eyelids"], nasolabial_folds(head)]),
    )
    elsewhere = np.isin(some.vertices, cheeks).sum() / head.mesh.mass.diagonal()[cheeks].sum()
    for region in ("lips", "eyelids"):
        assert density(region) > 2 * elsewhere
    folds = head.mesh.vertices[nasolabial_folds(head)]
    assert len(folds) > 20
    assert ((np.abs(folds[:, 0]) > 0.005) & (np.abs(folds[:, 0]) < 0.045)).all()
    assert ((folds[:, 1] > -0.06) & (folds[:, 1] < 0.01)).all()
    assert abs((folds[:, 0] > 0).mean() - 0.5) < 0.1
    rng = np.random.default_rng(0)
    solver, fewer = BlendshapeSolver.from_head(head), BlendshapeSolver.from_head(head, samples=600)
    truth = np.clip(rng.normal(0, 0.3, (10, 53)), 0, 1)
    frames = solver.reconstruct(truth)
    rest = np.linalg.norm(fewer.reconstruct(fewer(frames)) - frames, axis=2)
    assert rest[:, head.regions["face"]].max() < 1e-3
    with pytest.raises(OptionError, match="positive"):
        sample_vertices(head, 0)
    with pytest.raises(OptionError, match="no region cheek"):
        sample_vertices(head, importance={"cheek": 2.0})


def test_bad_input_is_named(made, head, unchecked, monkeypatch):
    neutral, deltas, frames = made
    solver = BlendshapeSolver(neutral, deltas, NAMES)
    assert solver(frames[:0]).shape == (0, 7)
    with pytest.raises(ShapeError, match=r"\(frames, 90, 3\)"):
        solver(frames[:, :-1])
    with pytest.raises(ShapeError, match=r"\(frames, 90, 3\)"):
        solver(frames[0])
    for dtype in (np.float32, np.float64):
        broken = frames.astype(dtype)
        broken[5, 7, 1] = np.nan
        with pytest.raises(ShapeError, match="first is 5"):
            solver(broken)
    with pytest.raises(ShapeError, match="weights must be"):
        solver.reconstruct(np.zeros((3, 6)))
    with pytest.raises(ShapeError, match="deltas of shape"):
        BlendshapeSolver(neutral[:-1], deltas, NAMES)
    with pytest.raises(ShapeError, match="NaN"):
        BlendshapeSolver(neutral, deltas + np.inf, NAMES)
    with pytest.raises(ShapeError, match="no size"):
        BlendshapeSolver(np.zeros((90, 3)), deltas, NAMES)
    for options, message in (
        ({"active": ("smile",)}, "no shape named smile"),
        ({"active": ()}, "no shape is active"),
        ({"cancelling": (("jawOpen", "jawOpen"),)}, "twice"),
        ({"multipliers": {"smirk": 2.0}}, "smirk"),
        ({"offsets": {"idle": np.nan}}, "finite"),
        ({"jaw": 1.0}, "JawTracking"),
        ({"l2": -1.0}, "l2 must be"),
        ({"template_size": 0.0}, "template_size"),
        ({"jaw": 1.0, "nvidia_parity": True}, "no jaw term"),
    ):
        with pytest.raises(OptionError, match=message):
            BlendshapeSolver(neutral, deltas, NAMES, SolverOptions(**options))
    jaw = JawTracking(np.arange(5), np.array([[1, 2]]))
    with pytest.raises(ShapeError, match="40 frames"):
        BlendshapeSolver(neutral, deltas, NAMES, SolverOptions(jaw=1.0), jaw=jaw)(frames, np.zeros((3, 3)))
    alike = deltas.copy()
    alike[6] = 0
    alike[3] = alike[4]
    with pytest.raises(OptionError, match="apart"):
        BlendshapeSolver(neutral, alike, NAMES, SolverOptions(l2=0, l1=0))
    ridge = solve_blendshapes(frames, neutral, alike, NAMES, SolverOptions(l2=1e-6, l1=0))
    assert (ridge[:, 6] == 0).all()
    np.testing.assert_allclose(ridge[:, 3], ridge[:, 4], atol=1e-6)
    with pytest.raises(ShapeError, match="different"):
        VertexSampling(np.array([1, 1]), np.ones(2))
    with pytest.raises(ShapeError, match="all zero"):
        VertexSampling(np.array([1, 2]), np.zeros(2))
    with pytest.raises(ShapeError, match="sampled vertex 90"):
        BlendshapeSolver(neutral, deltas, NAMES, sampling=VertexSampling(np.array([90]), np.ones(1)))
    with pytest.raises(OptionError, match="no backend"):
        BlendshapeSolver(neutral, deltas, NAMES, backend="gpu")
    monkeypatch.setattr(box_programs, "_native", None)
    with pytest.raises(BackendError, match="not built"):
        BlendshapeSolver(neutral, deltas, NAMES, backend="native")
    assert BlendshapeSolver(neutral, deltas, NAMES).backend == "reference"
