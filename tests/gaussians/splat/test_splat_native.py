import threading

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from splat_scenes import FIELDS, cameras, hard, leaves, plain, relative

from meshanim.errors import OptionError, ShapeError
from meshanim.gaussians import Cameras, Gaussians, rasterize
from meshanim.gaussians.splat import native

pytestmark = pytest.mark.skipif(not native.available(), reason="the extension is not built")


@pytest.fixture(params=["generic", "avx2", "avx512"])
def instruction_set(request):
    from meshanim import _native

    before = _native.instruction_set()
    try:
        _native.set_instruction_set(request.param)
    except ValueError:
        pytest.skip(f"no {request.param} here")
    yield request.param
    _native.set_instruction_set(before)


def render(scene, views, background, backend, dtype, **options):
    scene, views = leaves(scene, dtype), views.to(dtype)
    pose, behind = views.world_to_camera.requires_grad_(), background.to(dtype).requires_grad_()
    out = rasterize(
        scene,
        Cameras(pose, views.intrinsics, views.width, views.height),
        behind,
        depth="accumulated",
        screen_gradients=True,
        backend=backend,
        **options,
    )
    inputs = {name: getattr(scene, name) for name in FIELDS if getattr(scene, name) is not None}
    inputs |= {"pose": pose, "background": behind, "screen": out.screen_offsets}
    return out, torch.cat([out.rgb, out.alpha[..., None], out.depth[..., None]], -1), inputs


def compare(scene, views, gradients=True, **options):
    """Forward within 2e-6, gradients within 2e-5 of float64; returns which pixels a threshold sets apart."""
    channels = 3 if scene.colors is None else scene.colors.shape[-1]
    background = torch.rand(channels, generator=torch.Generator().manual_seed(7))
    exact, truth, exact_inputs = render(scene, views, background, "reference", torch.float64, **options)
    fast, picture, inputs = render(scene, views, background, "native", torch.float32, **options)
    assert int((fast.radii != exact.radii).sum()) <= 0.001 * fast.radii.numel()
    # On another side of a threshold: a Gaussian at 1 / 255, or the last one of a pixel.
    apart = (picture.detach() - truth.detach()).abs().amax(-1) > 2e-5 * truth.detach().abs().max()
    weights = torch.randn(truth.shape, generator=torch.Generator().manual_seed(8), dtype=torch.float64)
    weights[apart] = 0
    assert relative(picture[~apart], truth[~apart]) < 2e-6
    if gradients:
        (truth * weights).sum().backward()
        (picture * weights.float()).sum().backward()
        for name, leaf in inputs.items():
            expected = exact_inputs[name].grad
            if float(expected.norm()) > 0:
                assert relative(leaf.grad, expected) < 2e-5, name
            else:
                assert float(leaf.grad.abs().max()) < 1e-6, name
    return apart


@pytest.mark.parametrize(
    ("n", "width", "height", "options", "made"),
    [
        (210, 53, 45, {}, {}),
        (140, 70, 33, {}, {"degree": 3}),
        (140, 40, 40, {"antialiased": True}, {}),
        (70, 19, 34, {"max_alpha": 0.9, "eps2d": 0.1}, {"channels": 6}),
    ],
)
def test_equals_the_reference_on_hard_scenes(instruction_set, n, width, height, options, made):
    apart = compare(hard(n, seed=1, **made), cameras(width, height, count=2, seed=3), **options)
    assert int(apart.sum()) <= 0.001 * apart.numel()


@pytest.mark.parametrize(
    ("channels", "degree"),
    [(1, None), (2, None), (3, None), (4, None), (5, None), (9, None), (3, 0), (3, 1), (3, 2)],
)
def test_equals_the_reference_for_any_channels_and_degree(channels, degree):
    compare(plain(40, seed=2, channels=channels, degree=degree), cameras(17, 12))


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 40), (33, 1), (16, 16), (31, 17)])
def test_odd_sizes(instruction_set, width, height):
    compare(plain(30, seed=5, size=0.4), cameras(width, height, seed=1))


def test_dense_opaque_scenes_stop_early(instruction_set):
    scene = plain(1500, seed=6, size=0.4)
    opaque = Gaussians(scene.means, scene.quaternions, scene.scales, torch.full((1500,), 0.97), scene.colors)
    compare(opaque, cameras(24, 20, seed=2))


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 60), st.integers(1, 40), st.integers(1, 40), st.booleans())
def test_equals_the_reference_on_any_scene(seed, n, width, height, antialiased):
    compare(hard(n, seed), cameras(width, height, seed=seed), gradients=False, antialiased=antialiased)


def test_share_of_pixels_beyond_a_threshold():
    apart = [
        compare(hard(140, seed), cameras(48, 48, seed=seed), gradients=False) for seed in range(100, 104)
    ]
    assert float(torch.stack(apart).double().mean()) < 0.001


@pytest.mark.parametrize("harmonic", [False, True])
def test_the_same_bits_for_any_number_of_threads(harmonic):
    scene = hard(3000, seed=9, size=0.05, degree=2 if harmonic else None)
    views, background = cameras(90, 70, count=2), torch.rand(3)
    threads, results = torch.get_num_threads(), []
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            _, picture, inputs = render(scene, views, background, "native", torch.float32)
            weights = torch.linspace(-1, 1, picture.numel()).view(picture.shape)
            (picture * weights).sum().backward()
            results.append([picture.detach(), *(leaf.grad for leaf in inputs.values())])
    finally:
        torch.set_num_threads(threads)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other))


def test_a_batch_is_its_images_and_shared_fields_sum_their_gradients():
    base, views = plain(60, seed=3, degree=1), cameras(33, 20, count=2)
    moved = torch.stack([base.means, base.means + 0.1, base.means - 0.2])[:, None]
    scene = leaves(Gaussians(moved, base.quaternions, base.scales, base.opacities, sh=base.sh))
    out = rasterize(scene, views)
    assert out.rgb.shape == (3, 1, 2, 20, 33, 3)
    weights = torch.rand_like(out.rgb)
    (out.rgb * weights).sum().backward()
    total = torch.zeros_like(base.sh)
    for frame in range(3):
        single = leaves(Gaussians(moved[frame, 0], base.quaternions, base.scales, base.opacities, sh=base.sh))
        for camera in range(2):
            one = Cameras(
                views.world_to_camera[camera : camera + 1], views.intrinsics[camera : camera + 1], 33, 20
            )
            alone = rasterize(single, one, depth=None)
            torch.testing.assert_close(out.alpha[frame, 0, camera], alone.alpha[0], rtol=0, atol=0)
            (alone.rgb[0] * weights[frame, 0, camera]).sum().backward()
        total += single.sh.grad
        torch.testing.assert_close(scene.means.grad[frame, 0], single.means.grad, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(scene.sh.grad, total, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 5])
def test_colors_of_all_images_sum_their_gradients(channels, instruction_set):
    # 37: groups of Gaussians that are not whole; most of them are out of the second camera's sight.
    generator = torch.Generator().manual_seed(5)
    base, views = plain(37, seed=5), cameras(33, 20, count=3)
    views.world_to_camera[1, 2, 3] -= 4.0
    colors = torch.rand(37, channels, generator=generator)
    scene = leaves(Gaussians(base.means, base.quaternions, base.scales, base.opacities, colors))
    out = rasterize(scene, views, torch.zeros(channels), depth=None)
    weights = torch.rand(out.rgb.shape, generator=generator)
    (out.rgb * weights).sum().backward()
    total = {name: torch.zeros_like(getattr(scene, name)) for name in ("means", "colors")}
    for camera in range(3):
        single, rows = (
            scene.map(lambda field: field.detach().clone().requires_grad_()),
            slice(camera, camera + 1),
        )
        one = Cameras(views.world_to_camera[rows], views.intrinsics[rows], 33, 20)
        (rasterize(single, one, torch.zeros(channels), depth=None).rgb[0] * weights[camera]).sum().backward()
        for name, sum_ in total.items():
            sum_ += getattr(single, name).grad
    for name, sum_ in total.items():
        torch.testing.assert_close(getattr(scene, name).grad, sum_, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("threads", [1, 2])
def test_too_many_tiles_are_named(threads):
    n, size = 70_000, 2896  # each covers all of 181 x 181 tiles
    scene = Gaussians(
        torch.tensor([0.0, 0.0, 2.0]).expand(n, 3),
        torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(n, 4),
        torch.full((n, 3), 10.0),
        torch.full((n,), 0.5),
        torch.zeros(n, 1),
    )
    k = torch.tensor([[size, 0, size / 2], [0, size, size / 2], [0, 0, 1]])
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(threads)
        with pytest.raises(ValueError, match="too many tiles; render fewer images"):
            rasterize(scene, Cameras(torch.eye(4)[None], k[None], size, size), torch.zeros(1), depth=None)
    finally:
        torch.set_num_threads(before)


def test_two_graphs_interleaved():
    views = cameras(40, 30)
    scenes = [leaves(hard(300, seed)) for seed in (1, 2)]
    expected = []
    for scene in scenes:
        rasterize(scene, views).rgb.square().sum().backward()
        expected.append(scene.means.grad.clone())
        scene.means.grad = None
    losses = [rasterize(scene, views).rgb.square().sum() for scene in scenes]
    for loss in losses:
        loss.backward()
    assert all(torch.equal(scene.means.grad, grad) for scene, grad in zip(scenes, expected))
    with pytest.raises(RuntimeError, match="second time"):
        losses[0].backward()


def test_renders_from_several_python_threads():
    views, scenes = cameras(50, 40), [hard(400, seed) for seed in range(4)]
    expected = [rasterize(scene, views).rgb for scene in scenes]
    found = [None] * len(scenes)

    def work(index):
        for _ in range(5):
            found[index] = rasterize(scenes[index], views).rgb

    workers = [threading.Thread(target=work, args=(index,)) for index in range(len(scenes))]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert all(torch.equal(a, b) for a, b in zip(found, expected))


@pytest.mark.parametrize("layout", ["planes", "pixels", "expanded"])
def test_gradients_of_any_layout(layout):
    scene, views = leaves(plain(50, seed=8)), cameras(21, 18)
    rgb = rasterize(scene, views, depth=None).rgb
    gradient = torch.rand(1, 18, 21, 3)
    if layout == "planes":
        gradient = gradient.permute(0, 3, 1, 2).contiguous().permute(0, 2, 3, 1)
    elif layout == "expanded":
        gradient = torch.tensor(0.5).expand(1, 18, 21, 3)
    (means,) = torch.autograd.grad(rgb, scene.means, gradient, retain_graph=True)
    (again,) = torch.autograd.grad(rgb, scene.means, gradient.contiguous())
    assert torch.equal(means, again)


def test_strided_fields_and_no_gradients_give_the_same_bits():
    scene, views = plain(60, seed=9), cameras(24, 20)
    expected = rasterize(leaves(scene), views).rgb.detach()
    assert torch.equal(rasterize(scene, views).rgb, expected)
    strided = scene.map(lambda field: torch.stack([field, field], -1)[..., 0])
    assert not strided.means.is_contiguous()
    assert torch.equal(rasterize(strided, views).rgb, expected)
    given = strided.map(lambda field: field.detach().requires_grad_())
    assert torch.equal(rasterize(given, views).rgb, expected)
    with torch.no_grad():
        assert torch.equal(rasterize(given, views).rgb, expected)


def test_lazily_negated_fields_and_gradients():
    scene, views = plain(60, seed=9), cameras(24, 20)
    negated = torch.complex(torch.zeros(60), -scene.opacities).conj().imag
    gradient = torch.complex(torch.zeros(1, 20, 24), torch.rand(1, 20, 24)).conj().imag
    assert (negated.is_neg(), gradient.is_neg()) == (True, True)
    found = []
    for opacities, weights in ((negated, gradient), (scene.opacities, gradient.resolve_neg())):
        means = scene.means.clone().requires_grad_()
        out = rasterize(Gaussians(means, scene.quaternions, scene.scales, opacities, scene.colors), views)
        found.append((out.rgb.detach(), torch.autograd.grad(out.alpha, means, weights)[0]))
    assert all(torch.equal(a, b) for a, b in zip(*found))


def test_images_lie_pixel_by_pixel():
    out = rasterize(plain(20), cameras(9, 7, count=2))
    assert all(image.is_contiguous() for image in (out.rgb, out.alpha, out.depth))


def test_the_memory_of_fields_outlives_them():
    scene, views = leaves(plain(5000, seed=3)), cameras(30, 20)
    expected = torch.autograd.grad(rasterize(scene, views).rgb.square().sum(), scene.scales)[0]
    out = rasterize(scene, views)
    for name in FIELDS[:-1]:
        field = getattr(scene, name)
        field.data = torch.full_like(field, 1e6)
    filler = [torch.full((5000, 3), 1e6) for _ in range(20)]
    assert torch.equal(torch.autograd.grad(out.rgb.square().sum(), scene.scales)[0], expected)
    assert len(filler) == 20


def test_a_field_changed_before_backward_is_noticed():
    scene, views = leaves(plain(20)), cameras(9, 9)
    out = rasterize(scene, views)
    with torch.no_grad():
        scene.means.add_(1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        out.rgb.sum().backward()


def test_depth_without_a_gradient_costs_nothing_and_changes_nothing():
    scene, views = leaves(plain(50, seed=8, channels=4)), cameras(21, 18)
    weights = torch.rand(1, 18, 21, 4)
    grads = [
        torch.autograd.grad((rasterize(scene, views, depth=mode).rgb * weights).sum(), scene.means)[0]
        for mode in (None, "expected")
    ]
    torch.testing.assert_close(*grads)


def test_only_the_gradients_that_are_wanted():
    scene = plain(20)
    scales = scene.scales.clone().requires_grad_()
    out = rasterize(
        Gaussians(scene.means, scene.quaternions, scales, scene.opacities, scene.colors), cameras(9, 9)
    )
    out.alpha.sum().backward()
    assert float(scales.grad.abs().sum()) > 0


def test_nothing_to_see(instruction_set):
    views = cameras(19, 4, count=2)
    nothing = plain(3).select(torch.zeros(3, dtype=torch.bool))
    for scene in (leaves(nothing), leaves(plain(3).map(lambda field: field - 50))):
        out = rasterize(scene, views, (0.5, 0.25, 1.0))
        assert float(out.alpha.detach().abs().max()) == 0
        assert out.rgb.detach().reshape(-1, 3).unique(dim=0).tolist() == [[0.5, 0.25, 1.0]]
        out.rgb.sum().backward()
        assert float(scene.means.grad.abs().sum()) == 0


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("means", float("nan"), "means has 2 values that are not finite"),
        ("scales", float("inf"), "scales has 2 values that are not finite"),
        ("opacities", -float("inf"), "opacities has 2 values that are not finite"),
        ("colors", float("nan"), "colors has 2 values that are not finite"),
        ("sh", float("nan"), "sh has 2 values that are not finite"),
        ("quaternions", 0.0, "quaternions has 2 of length zero"),
    ],
)
def test_bad_values_are_named(instruction_set, field, value, said):
    scene = plain(6, degree=1 if field == "sh" else None)
    broken = getattr(scene, field)
    if field == "quaternions":
        broken[1] = broken[4] = value
    else:
        broken.view(6, -1)[[1, 4], 0] = value
    with pytest.raises(ShapeError, match=said):
        rasterize(scene, cameras(9, 9), backend="native")


@pytest.mark.parametrize("length", [1e-25, 1e25])
def test_quaternions_of_any_length(length):
    scene, views = plain(20), cameras(12, 12)
    scaled = Gaussians(scene.means, scene.quaternions * length, scene.scales, scene.opacities, scene.colors)
    torch.testing.assert_close(rasterize(scaled, views).rgb, rasterize(scene, views).rgb)


def test_no_gradients_to_intrinsics():
    views = cameras(9, 9)
    views.intrinsics.requires_grad_()
    with pytest.raises(OptionError, match="backend='reference'"):
        rasterize(plain(3), views, backend="native")
    out = rasterize(plain(3), views, backend="reference")
    out.rgb.sum().backward()
    assert float(views.intrinsics.grad.abs().sum()) > 0


def test_memory_goes_back_to_the_pool():
    from meshanim import _native

    scene, views = leaves(plain(500)), cameras(64, 64)
    used = _native.pool_bytes()[0]
    for _ in range(3):
        out = rasterize(scene, views)
        out.rgb.sum().backward()
    del out
    assert _native.pool_bytes()[0] == used
