"""The compiled binding: equal to the float64 reference, forward and backward, on every instruction set."""

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from meshanim.errors import BackendError, OptionError
from meshanim.gaussians import Gaussians
from meshanim.gaussians.binding import Binding
from meshanim.geometry import TriangleMesh

_native = pytest.importorskip("meshanim._native", reason="the extension was not built")
SETS = ("generic", "avx2", "avx512")
AVAILABLE = SETS[: SETS.index(_native.instruction_set()) + 1]
FIELDS = ("means", "quaternions", "scales")


@pytest.fixture(params=AVAILABLE)
def instruction_set(request):
    _native.set_instruction_set(request.param)
    yield request.param
    _native.set_instruction_set(AVAILABLE[-1])


@pytest.fixture
def threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def ball(subdivisions: int) -> TriangleMesh:
    made = trimesh.creation.icosphere(subdivisions, 0.1)
    return TriangleMesh(np.array(made.vertices), np.array(made.faces))


def scene(mesh: TriangleMesh, count: int, frames: tuple[int, ...], own: tuple[int, ...] = (), seed: int = 0):
    """A binding in random order, its Gaussians (with a batch of their own), and posed vertices; float64."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, dtype=torch.float64, generator=generator)

    binding = Binding(mesh, torch.randint(mesh.n_faces, (count,), generator=generator))
    local = Gaussians(
        normal(*own, count, 3),
        normal(*own, count, 4) * normal(*own, count, 1).exp(),
        (0.5 * normal(*own, count, 3)).exp(),
        normal(count).sigmoid(),
        normal(count, 3).sigmoid(),
    )
    spread = 0.2 * np.sqrt(mesh.face_areas.mean())
    vertices = torch.from_numpy(mesh.vertices) + spread * normal(*frames, mesh.n_vertices, 3)
    # What single precision sees, so that the reference computes with the same numbers.
    return binding, local.to(torch.float32).to(torch.float64), vertices.float().double()


def run(binding: Binding, local: Gaussians, vertices: torch.Tensor, backend: str):
    """World fields, and gradients of a fixed random weighting of them to the local fields and vertices."""
    leaves = [getattr(local, name).clone().requires_grad_() for name in FIELDS]
    vertices = vertices.clone().requires_grad_()
    world = binding.to_world(Gaussians(*leaves, local.opacities, local.colors), vertices, backend=backend)
    out = [getattr(world, name) for name in FIELDS]
    generator = torch.Generator().manual_seed(1)
    weights = [torch.randn(part.shape, dtype=torch.float64, generator=generator).to(part) for part in out]
    gradients = torch.autograd.grad(
        sum((w * part).sum() for w, part in zip(weights, out)), [*leaves, vertices]
    )
    return [part.detach() for part in out], list(gradients)


def assert_equals_reference(binding: Binding, local: Gaussians, vertices: torch.Tensor) -> None:
    exact, exact_gradients = run(binding, local, vertices, "reference")
    out, gradients = run(binding, local.to(torch.float32), vertices.float(), "native")
    for ours, theirs in zip([*out, *gradients], [*exact, *exact_gradients]):
        assert ours.shape == theirs.shape
        error = (ours.double() - theirs).norm() / theirs.norm().clamp(min=1e-30)
        assert error < 2e-6 if ours is not gradients[-1] else error < 2e-5


@pytest.mark.parametrize(
    ("count", "frames", "own"),
    [
        (1, (), ()),
        (63, (), ()),
        (64, (3,), ()),
        (1000, (2, 2), ()),
        (300, (3,), (3,)),
        (300, (), (2,)),
        (65, (1,), ()),
    ],
)
def test_equals_the_reference(instruction_set, count, frames, own):
    assert_equals_reference(*scene(ball(2), count, frames, own))


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10**6), st.integers(1, 200), st.integers(1, 3))
def test_random_triangles(seed, count, frames):
    rng = np.random.default_rng(seed)
    corners = np.array([rng.choice(30, 3, replace=False) for _ in range(rng.integers(1, 90))])
    mesh = TriangleMesh(rng.standard_normal((30, 3)), corners)
    binding, local, vertices = scene(mesh, count, (frames,), seed=seed)
    exact, exact_gradients = run(binding, local, vertices, "reference")
    out, gradients = run(binding, local.to(torch.float32), vertices.float(), "native")
    for ours, theirs in zip(out, exact):
        torch.testing.assert_close(ours.double(), theirs, atol=1e-4, rtol=1e-4)
    for ours, theirs in zip(gradients, exact_gradients):
        # Needles among random triangles turn with the reciprocal of their height.
        assert (ours.double() - theirs).norm() < 2e-3 * theirs.norm()


def test_every_turn_of_a_triangle_gives_the_reference_quaternion(instruction_set):
    """All four forms of rotation to quaternion, with the sign of each."""
    generator = torch.Generator().manual_seed(3)
    corners = torch.randn(2000, 3, 3, dtype=torch.float64, generator=generator).float()
    mesh = TriangleMesh(corners.reshape(-1, 3).double().numpy(), np.arange(6000).reshape(-1, 3))
    binding = Binding(mesh, torch.arange(2000))
    unit = torch.tensor([[1.0, 0, 0, 0]]).repeat(2000, 1)
    local = Gaussians(torch.zeros(2000, 3), unit, torch.ones(2000, 3), torch.ones(2000), torch.ones(2000, 3))
    ours = binding.to_world(local, corners.reshape(-1, 3), backend="native").quaternions
    theirs = binding.to_world(
        local.to(torch.float64), corners.reshape(-1, 3).double(), backend="reference"
    ).quaternions
    largest = theirs.abs().argmax(1)
    assert torch.bincount(largest, minlength=4).min() > 100
    assert ((ours.double() - theirs).abs().amax(1) < 1e-4).float().mean() == 1


def test_same_numbers_on_any_number_of_threads(threads):
    binding, local, vertices = scene(ball(3), 5000, (3,))
    results = []
    for count in (1, 2, 3):
        threads(count)
        out, gradients = run(binding, local.to(torch.float32), vertices.float(), "native")
        results.append([*out, *gradients])
    for other in results[1:]:
        assert all(torch.equal(one, two) for one, two in zip(results[0], other))


def test_only_what_is_asked_for():
    binding, local, vertices = scene(ball(1), 50, (2,))
    local, vertices = local.to(torch.float32), vertices.float()
    _, whole = run(binding, local, vertices, "native")
    leaves = [getattr(local, name).clone().requires_grad_() for name in FIELDS]
    world = binding.to_world(Gaussians(*leaves, local.opacities, local.colors), vertices, backend="native")
    generator = torch.Generator().manual_seed(1)
    parts = [getattr(world, name) for name in FIELDS]
    weights = [torch.randn(part.shape, dtype=torch.float64, generator=generator).to(part) for part in parts]
    some = torch.autograd.grad(sum((w * part).sum() for w, part in zip(weights, parts)), leaves)
    assert all(torch.equal(one, two) for one, two in zip(some, whole))
    moving = vertices.clone().requires_grad_()
    binding.to_world(local, moving, backend="native").means.sum().backward()
    expected = torch.autograd.grad(
        binding.to_world(local.to(torch.float64), moving.double(), backend="reference").means.sum(), moving
    )[0]
    torch.testing.assert_close(moving.grad, expected, atol=2e-4, rtol=2e-4)


DEGENERATE = {
    "point": [[1.0, 2, 3]] * 3,
    "first side missing": [[1.0, 2, 3], [1, 2, 3], [0, 5, 1]],
    "second side missing": [[1.0, 2, 3], [0, 5, 1], [1, 2, 3]],
    "on a line": [[0.0, 0, 0], [1, 2, 3], [-2, -4, -6]],
    "on an axis": [[0.0, 0, 0], [0, 1, 0], [0, 2, 0]],
}


@pytest.mark.parametrize("name", DEGENERATE)
def test_triangles_without_area(instruction_set, name):
    mesh = TriangleMesh([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    binding, local, _ = scene(mesh, 3, ())
    local, vertices = local.to(torch.float32), torch.tensor(DEGENERATE[name])
    exact, _ = run(binding, local, vertices, "reference")
    out, gradients = run(binding, local, vertices, "native")
    for ours, theirs in zip(out, exact):
        torch.testing.assert_close(ours, theirs, atol=1e-5, rtol=1e-5)
    assert all(torch.isfinite(gradient).all() for gradient in gradients)


def test_nothing_in_nothing_out():
    binding, local, vertices = scene(ball(1), 0, (2,))
    world = binding.to_world(local.to(torch.float32), vertices.float(), backend="native")
    assert world.means.shape == (2, 0, 3)
    binding, local, vertices = scene(ball(1), 5, (0,))
    out, gradients = run(binding, local.to(torch.float32), vertices.float(), "native")
    assert out[1].shape == (0, 5, 4)
    assert not gradients[3].numel()


def test_auto_takes_the_kernel_where_it_applies():
    binding, local, vertices = scene(ball(1), 20, ())
    single = local.to(torch.float32)
    auto = binding.to_world(single, vertices.float())
    assert torch.equal(auto.means, binding.to_world(single, vertices.float(), backend="native").means)
    with pytest.raises(BackendError, match="float64"):
        binding.to_world(local, vertices, backend="native")
    with pytest.raises(OptionError, match="auto, native, reference"):
        binding.to_world(local, vertices, backend="cuda")


def test_operator_is_registered_for_tracing():
    binding, local, vertices = scene(ball(1), 20, (2,))
    local = local.to(torch.float32).map(lambda field: field[None].contiguous() if field.ndim > 1 else field)
    fields = (vertices.float(), *(getattr(local, name) for name in FIELDS))
    inputs = tuple(field.requires_grad_() for field in fields)
    torch.library.opcheck(torch.ops.meshanim.bind_gaussians.default, (*inputs, *binding._lists))


def test_the_benchmark_has_every_row():
    from meshanim.gaussians.binding_benchmark import BindingBenchmark, run

    results = run(BindingBenchmark(faces=200, per_face=2, frames=(1,), repeats=1))
    cases = {row.case for row in results.rows}
    assert len(cases) == 1
    for metric in ("forward", "forward + backward", "the same with vertices"):
        times = [results.value(*cases, name, metric) for name in ("native", "reference")]
        assert results.value(*cases, "reference / native", metric + " ratio") == times[1] / times[0]
