import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from splat_scenes import FIELDS, brute_force, cameras, hard, leaves, plain, relative

from meshanim.errors import BackendError, OptionError, ShapeError
from meshanim.gaussians import Cameras, Gaussians, rasterize
from meshanim.gaussians.splat.reference import project
from meshanim.gaussians.splat.rendering import RasterOptions


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize(("width", "height"), [(19, 23), (16, 7)])
def test_equals_compositing_gaussian_after_gaussian(width, height, antialiased):
    views = cameras(width, height, dtype=torch.float64)
    background = torch.tensor([0.1, 0.5, 0.9], dtype=torch.float64)
    weights = torch.randn(height, width, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    gradients, pictures = [], []
    for way in ("reference", "brute force"):
        scene = leaves(hard(28, seed=3), torch.float64)
        if way == "reference":
            out = rasterize(
                scene, views, background, antialiased=antialiased, depth="accumulated", backend="reference"
            )
            picture = torch.cat([out.rgb[0], out.alpha[0][..., None], out.depth[0][..., None]], -1)
        else:
            rgb, alpha, depth = brute_force(scene, views, background, antialiased)
            picture = torch.cat([rgb, alpha[..., None], depth[..., None]], -1)
        (picture * weights).sum().backward()
        pictures.append(picture.detach())
        gradients.append({name: getattr(scene, name).grad for name in FIELDS[:5]})
    torch.testing.assert_close(pictures[0], pictures[1], rtol=0, atol=1e-12)
    for name, gradient in gradients[0].items():
        assert relative(gradient, gradients[1][name]) < 1e-10, name


def test_a_single_gaussian_by_hand():
    """On the axis, isotropic, projected variance 1 + 0.3."""
    scene = Gaussians(
        torch.tensor([[0.0, 0.0, 2.0]]).double(),
        torch.tensor([[2.0, 0.0, 0.0, 0.0]]).double(),
        torch.full((1, 3), 0.02).double(),
        torch.tensor([0.8]).double(),
        torch.tensor([[1.0, 0.5]]).double(),
    )
    k = torch.tensor([[100.0, 0, 4.5], [0, 100, 3.5], [0, 0, 1]]).double()
    out = rasterize(
        scene, Cameras(torch.eye(4).double()[None], k[None], 9, 8), (0.0, 1.0), backend="reference"
    )
    alpha = 0.8 * math.exp(-0.5 * (1 + 4) / 1.3)
    assert float(out.alpha[0, 3, 4]) == pytest.approx(0.8)
    assert float(out.alpha[0, 5, 3]) == pytest.approx(alpha)
    assert out.rgb[0, 5, 3].tolist() == pytest.approx([alpha, 0.5 * alpha + 1 - alpha])
    assert float(out.depth[0, 5, 3]) == pytest.approx(2)
    assert out.radii.flatten().tolist() == [math.ceil(math.sqrt(2 * math.log(0.8 * 255) * 1.3))] * 2


@pytest.mark.parametrize("antialiased", [False, True])
def test_gradcheck(antialiased):
    scene = leaves(plain(5, seed=2, degree=1, size=0.3), torch.float64)
    views = cameras(9, 7, dtype=torch.float64)
    pose, background = views.world_to_camera.requires_grad_(), torch.rand(3).double().requires_grad_()

    def render(means, quaternions, scales, opacities, sh, pose, background):
        given = Gaussians(means, quaternions, scales, opacities, sh=sh)
        out = rasterize(
            given,
            Cameras(pose, views.intrinsics, 9, 7),
            background,
            antialiased=antialiased,
            backend="reference",
        )
        return out.rgb, out.alpha, out.depth

    inputs = (*(getattr(scene, name) for name in FIELDS if name != "colors"), pose, background)
    assert torch.autograd.gradcheck(render, inputs, fast_mode=True)


def test_a_batch_is_its_images():
    scene, views = hard(40, seed=1), cameras(20, 17, count=3)
    frames = torch.stack([scene.means, scene.means + 0.1])
    batched = Gaussians(frames, scene.quaternions, scene.scales, scene.opacities, scene.colors)
    out = rasterize(batched, views, torch.rand(3, 3), backend="reference")
    assert out.rgb.shape == (2, 3, 17, 20, 3)
    assert out.radii.shape == (2, 3, 40, 2)
    single = Gaussians(frames[1], scene.quaternions, scene.scales, scene.opacities, scene.colors)
    one = Cameras(views.world_to_camera[2:], views.intrinsics[2:], 20, 17)
    alone = rasterize(single, one, backend="reference")
    torch.testing.assert_close(out.alpha[1, 2], alone.alpha[0])
    torch.testing.assert_close(out.depth[1, 2], alone.depth[0])


def test_background_shows_through():
    out = rasterize(plain(3), cameras(8, 8, count=2), (0.2, 0.4, 0.6), backend="reference")
    light = (1 - out.alpha)[..., None]
    without = rasterize(plain(3), cameras(8, 8, count=2), backend="reference").rgb
    torch.testing.assert_close(out.rgb, without + light * torch.tensor([0.2, 0.4, 0.6]))


def test_screen_offsets_collect_the_gradient_to_positions():
    scene, views = leaves(plain(12, seed=4), torch.float64), cameras(20, 20, dtype=torch.float64)
    out = rasterize(scene, views, screen_gradients=True, backend="reference")
    assert float(out.screen_offsets.detach().abs().max()) == 0
    weight = torch.rand_like(out.rgb)
    (out.rgb * weight).sum().backward()
    step, moved = 1e-6, []
    for sign in (1, -1):  # a shift of the principal point moves all positions and, unclamped, nothing else
        k = views.intrinsics.clone()
        k[:, 0, 2] += sign * step
        wide = Cameras(views.world_to_camera, k, 20, 20)
        moved.append((rasterize(scene.detach(), wide, backend="reference").rgb * weight).sum())
    slope = (moved[0] - moved[1]) / (2 * step)
    torch.testing.assert_close(out.screen_offsets.grad[..., 0].sum(), slope, rtol=1e-5, atol=1e-6)


def test_memory_bound_changes_nothing(monkeypatch):
    from meshanim.gaussians.splat import reference

    scene, views = hard(80), cameras(50, 40)
    whole = rasterize(scene, views, backend="reference").rgb
    monkeypatch.setattr(reference, "PAIRS", 1)
    torch.testing.assert_close(rasterize(scene, views, backend="reference").rgb, whole)


def test_nothing_to_see():
    views = cameras(5, 4, count=2)
    nothing = plain(3).select(torch.zeros(3, dtype=torch.bool))
    for scene in (nothing, plain(3).map(lambda field: field - 50)):
        out = rasterize(scene, views, (0.5, 0.25, 1.0), backend="reference")
        assert float(out.alpha.abs().max()) == 0
        assert float(out.depth.abs().max()) == 0
        assert out.rgb.reshape(-1, 3).unique(dim=0).tolist() == [[0.5, 0.25, 1.0]]
        assert int(out.radii.abs().sum()) == 0


def test_near_and_far_cull_by_the_centre():
    scene = plain(50)
    views = cameras(16, 16)
    options = RasterOptions(3.9, 4.2, 0.3, False, 0.999, None)
    depths = project(scene, views.world_to_camera[0], views.intrinsics[0], (16, 16), options).depths
    out = rasterize(scene, views, near=3.9, far=4.2, backend="reference")
    drawn = (out.radii[0] > 0).all(-1)
    assert drawn.any()
    assert bool(((depths >= 3.9) & (depths <= 4.2))[drawn].all())


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("means", float("nan"), "means has 2 values that are not finite"),
        ("scales", float("inf"), "scales has 2 values that are not finite"),
        ("opacities", -float("inf"), "opacities has 2 values that are not finite"),
        ("colors", float("nan"), "colors has 2 values that are not finite"),
        ("quaternions", 0.0, "quaternions has 2 of length zero"),
    ],
)
def test_bad_values_are_named(field, value, said):
    scene = plain(6)
    broken = getattr(scene, field)
    if field == "quaternions":
        broken[1] = broken[4] = value
    else:
        broken.view(6, -1)[[1, 4], 0] = value
    with pytest.raises(ShapeError, match=said):
        rasterize(scene, cameras(4, 4), backend="reference")


@pytest.mark.parametrize(
    ("options", "error", "said"),
    [
        ({"near": 0.0}, OptionError, "0 < near < far"),
        ({"eps2d": -1.0}, OptionError, "eps2d"),
        ({"max_alpha": 1.0}, OptionError, "max_alpha"),
        ({"depth": "mean"}, OptionError, "'expected', 'accumulated' or None, not 'mean'"),
        ({"backend": "gpu"}, OptionError, "'gpu' is not one of auto, native, cuda, reference"),
        ({"backend": "cuda"}, BackendError, "NVIDIA GPU"),
        ({"background": (0.0, 1.0)}, ShapeError, r"background \(2,\) does not fit 3 channels"),
    ],
)
def test_bad_options_are_named(unchecked, options, error, said):
    with pytest.raises(error, match=said):
        rasterize(plain(2), cameras(4, 4), **options)


def test_cameras_of_another_batch_or_type(unchecked):
    scene, views = plain(4), cameras(4, 4)
    batched = Gaussians(
        scene.means.expand(2, 4, 3), scene.quaternions, scene.scales, scene.opacities, scene.colors
    )
    three = Cameras(views.world_to_camera.expand(3, 1, 4, 4), views.intrinsics, 4, 4)
    with pytest.raises(ShapeError, match="do not fit the Gaussians' batch"):
        rasterize(batched, three)
    with pytest.raises(ShapeError, match=r"use cameras\.to"):
        rasterize(scene, views.to(torch.float64))


def test_harmonics_are_seen_from_the_camera_lifted_and_clamped():
    scene, views = plain(1, degree=1), cameras(12, 12)
    sh = torch.zeros(1, 4, 3)
    sh[0, :, 0] = torch.tensor([0.2, 0.3, -0.4, 0.5])
    sh[0, 0, 1] = -10
    wide = Gaussians(torch.zeros(1, 3), scene.quaternions, torch.full((1, 3), 3.0), torch.ones(1), sh=sh)
    out = rasterize(wide, views, backend="reference")
    x, y, z = -views.positions[0] / views.positions[0].norm()
    red = 0.5 + 0.28209479 * 0.2 + 0.48860251 * (-0.3 * y - 0.4 * z - 0.5 * x)
    color = out.rgb[0, 5, 6] / out.alpha[0, 5, 6]
    torch.testing.assert_close(color, torch.stack([red, torch.tensor(0.0), torch.tensor(0.5)]))


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 20), st.integers(1, 20))
def test_light_is_conserved(seed, width, height):
    """Of white on white comes white, whatever the scene."""
    scene = hard(21, seed)
    white = Gaussians(
        scene.means, scene.quaternions, scene.scales, scene.opacities, torch.ones_like(scene.colors)
    )
    out = rasterize(white, cameras(width, height, seed=seed), (1.0, 1.0, 1.0), backend="reference")
    torch.testing.assert_close(out.rgb, torch.ones_like(out.rgb), rtol=0, atol=1e-5)
    assert bool(((out.alpha >= 0) & (out.alpha < 1)).all())
