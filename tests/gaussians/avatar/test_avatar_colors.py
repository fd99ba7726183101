"""The colour network: the compiled form equals the float64 reference, forward and backward."""

import pytest
import torch

from meshanim.errors import BackendError, OptionError
from meshanim.gaussians.avatar.colors import ExpressionColors

_native = pytest.importorskip("meshanim._native", reason="the extension was not built")
SETS = ("generic", "avx2", "avx512")
AVAILABLE = SETS[: SETS.index(_native.instruction_set()) + 1]
WIDE = 61


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


def scene(count: int, frames: int, latent: int = 8, hidden: int = 32):
    """A network that is far from its start, and what it reads; float64 with single precision's numbers."""
    torch.manual_seed(count + frames)
    network = ExpressionColors(latent, WIDE, hidden)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.normal_(0, parameter.shape[0] ** -0.5)
    return network.double(), torch.randn(count, latent).double(), torch.randn(frames, WIDE).double()


def run(network, latents, expression, backend: str):
    """Colours, and gradients of a fixed random weighting of them to all that the network reads."""
    leaves = [latents.clone().requires_grad_(), expression.clone().requires_grad_()]
    out = network(*leaves, backend=backend)
    generator = torch.Generator().manual_seed(1)
    weights = torch.randn(out.shape, dtype=torch.float64, generator=generator).to(out)
    parameters = list(network.parameters())
    return [out.detach(), *torch.autograd.grad((weights * out).sum(), [*leaves, *parameters])]


# One tile and a part, several chunks, no row; widths that are and are not whole vectors.
@pytest.mark.parametrize(
    ("count", "frames", "latent", "hidden"),
    [(1, 1, 8, 32), (70, 3, 8, 32), (3000, 1, 8, 32), (2048, 2, 5, 19), (90, 1, 17, 40), (64, 2, 1, 1)],
)
def test_equals_the_reference(instruction_set, count, frames, latent, hidden):
    network, latents, expression = scene(count, frames, latent, hidden)
    exact = run(network, latents, expression, "reference")
    single = run(network.float(), latents.float(), expression.float(), "native")
    for ours, theirs in zip(single, exact, strict=True):
        assert ours.shape == theirs.shape
        # Hidden units within rounding of zero may open in one precision only.
        assert (ours.double() - theirs).norm() <= 2e-5 * theirs.norm() + 1e-12


@pytest.mark.parametrize(("count", "frames", "rest"), [(70, 1, 8), (2100, 3, 3), (5, 2, 0)])
def test_harmonics_equal_the_reference(instruction_set, count, frames, rest):
    network, latents, expression = scene(count, frames)
    generator = torch.Generator().manual_seed(2)
    constant, others = (torch.randn(count, k, 3, generator=generator).double() for k in (1, rest))

    def both(backend, dtype):
        leaves = [t.to(dtype).clone().requires_grad_() for t in (latents, constant, others)]
        network.to(dtype)
        sh = network.harmonics(leaves[0], expression.to(dtype), *leaves[1:], backend=backend)
        weights = torch.randn(sh.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
        wanted = [*leaves, *network.parameters()]
        return [sh.detach(), *torch.autograd.grad((weights.to(sh) * sh).sum(), wanted)]

    exact = both("reference", torch.float64)
    assert exact[0].shape == (frames, count, 1 + rest, 3)
    for ours, theirs in zip(both("native", torch.float32), exact, strict=True):
        assert ours.shape == theirs.shape
        assert (ours.double() - theirs).norm() <= 2e-5 * theirs.norm() + 1e-12


def test_no_gaussians_and_no_gradient_asked_for(instruction_set):
    network, latents, expression = scene(0, 2)
    out = run(network.float(), latents.float(), expression.float(), "native")
    assert out[0].shape == (2, 0, 3)
    assert all(gradient.abs().sum() == 0 for gradient in out[1:])
    network, latents, expression = scene(5, 1)
    with torch.no_grad():
        assert network.float()(latents.float(), expression.float()).shape == (1, 5, 3)


def test_the_same_bits_for_any_number_of_threads(threads):
    network, latents, expression = scene(5000, 2)
    inputs = network.float(), latents.float(), expression.float()
    results = []
    for count in (1, 2, 3):
        threads(count)
        results.append(run(*inputs, "native"))
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_the_reference_passes_a_gradient_check():
    torch.manual_seed(3)
    network = ExpressionColors(3, 4, 5).double()
    with torch.no_grad():
        network.outer.normal_()
    inputs = torch.randn(6, 3).double().requires_grad_(), torch.randn(2, 4).double().requires_grad_()
    assert torch.autograd.gradcheck(lambda *given: network(*given, backend="reference"), inputs)


def test_not_a_number_is_not_hidden(instruction_set):
    network, latents, expression = scene(40, 1)
    latents[7, 0] = float("nan")
    out = network.float()(latents.float(), expression.float(), backend="native")
    assert out.isnan().any(-1).nonzero().tolist() == [[0, 7]]


def test_backends_are_named():
    network, latents, expression = scene(4, 1)
    with pytest.raises(OptionError, match="auto, native, reference"):
        network(latents, expression, backend="cuda")
    with pytest.raises(BackendError, match=r"float32 on the CPU, not torch\.float64"):
        network(latents, expression, backend="native")
    assert torch.equal(network(latents, expression), network(latents, expression, backend="reference"))
