"""gsplat's own torch functions, where it is installed, and its CUDA kernels, where there is a GPU."""

import sys
from types import ModuleType

import pytest
import torch
from splat_scenes import cameras, hard, leaves, plain, relative

from meshanim.errors import BackendError, DependencyError, OptionError
from meshanim.gaussians import Gaussians, rasterize
from meshanim.gaussians.harmonics import harmonics
from meshanim.gaussians.splat import cuda
from meshanim.gaussians.splat.reference import project
from meshanim.gaussians.splat.rendering import RasterOptions


@pytest.fixture(scope="module")
def torch_gsplat():
    return pytest.importorskip("gsplat.cuda._torch_impl")


@pytest.mark.parametrize("antialiased", [False, True])
def test_projection_is_gsplats(torch_gsplat, antialiased):
    scene, views = hard(140, seed=2), cameras(60, 40, dtype=torch.float64)
    scene = scene.to(torch.float64)
    options = RasterOptions(0.01, 1e10, 0.3, antialiased, 0.999, None)
    ours = project(scene, views.world_to_camera[0], views.intrinsics[0], (60, 40), options)
    covariances, _ = torch_gsplat._quat_scale_to_covar_preci(
        scene.quaternions, scene.scales, compute_preci=False
    )
    radii, positions, depths, conics, compensations = torch_gsplat._fully_fused_projection(
        scene.means, covariances, views.world_to_camera, views.intrinsics, 60, 40, calc_compensations=True
    )
    seen = ours.visible
    assert int(seen.sum()) > 60
    assert bool((radii[0][seen] > 0).all())  # its torch boxes do not know the opacity: they are larger
    torch.testing.assert_close(ours.positions[seen], positions[0][seen])
    torch.testing.assert_close(ours.depths[seen], depths[0][seen])
    torch.testing.assert_close(ours.conics[seen], conics[0][seen], rtol=1e-6, atol=1e-9)
    opacities = scene.opacities * (compensations[0] if antialiased else 1)
    torch.testing.assert_close(ours.opacities[seen], opacities[seen], rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_harmonics_are_gsplats(torch_gsplat, degree):
    directions = torch.nn.functional.normalize(torch.randn(30, 3, dtype=torch.float64), dim=-1)
    coefficients = torch.randn(30, (degree + 1) ** 2, 3, dtype=torch.float64)
    expected = torch_gsplat._spherical_harmonics(degree, directions, coefficients)
    torch.testing.assert_close((harmonics(directions, degree)[..., None] * coefficients).sum(-2), expected)


class Stages(ModuleType):
    """gsplat's five stages by its own torch code and, for pixels, by what its kernels do."""

    __version__ = "1.5.3"

    def __init__(self, impl):
        super().__init__("gsplat")
        self.impl = impl

    def fully_fused_projection(
        self, means, covars, quats, scales, viewmats, Ks, width, height, *, eps2d, near_plane, far_plane,
        packed, calc_compensations, opacities,
    ):  # fmt: skip
        assert covars is None
        assert not packed
        covars, _ = self.impl._quat_scale_to_covar_preci(quats, scales, compute_preci=False)
        return self.impl._fully_fused_projection(
            means, covars, viewmats, Ks, width, height, eps2d, near_plane, far_plane, calc_compensations
        )

    def spherical_harmonics(self, degree, directions, coefficients, masks):
        return self.impl._spherical_harmonics(degree, directions, coefficients)

    def isect_tiles(self, positions, radii, depths, tile, columns, rows):
        return self.impl._isect_tiles(positions, radii, depths, tile, columns, rows)

    def isect_offset_encode(self, keys, n_images, columns, rows):
        return self.impl._isect_offset_encode(keys, n_images, columns, rows)

    def rasterize_to_pixels(
        self, positions, conics, colors, opacities, width, height, tile, offsets, members, backgrounds
    ):
        starts = [*offsets.flatten().tolist(), len(members)]
        rows, columns = offsets.shape[-2:]
        count = positions.shape[-2]
        flat = [
            field.reshape(-1, *field.shape[positions.ndim - 1 :]) for field in (positions, conics, colors)
        ]
        weight = opacities.reshape(-1)
        pictures, alphas = [], []
        for image, background in enumerate(backgrounds.reshape(-1, backgrounds.shape[-1])):
            picture, left = [], []
            for pixel in range(width * height):
                x, y = pixel % width, pixel // width
                place = image * rows * columns + y // tile * columns + x // tile
                light, color = weight.new_ones(()), torch.zeros_like(background)
                for member in members[starts[place] : starts[place + 1]].tolist():
                    assert member // count == image
                    dx, dy = flat[0][member] - positions.new_tensor([x + 0.5, y + 0.5])
                    a, b, c = flat[1][member]
                    alpha = weight[member] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
                    alpha = alpha.clamp_max(0.999)
                    if alpha < 1 / 255:
                        continue
                    if light * (1 - alpha) <= 1e-4:
                        break
                    color = color + alpha * light * flat[2][member]
                    light = light * (1 - alpha)
                picture.append(color + light * background)
                left.append(light)
            pictures.append(torch.stack(picture).reshape(height, width, -1))
            alphas.append(1 - torch.stack(left).reshape(height, width, 1))
        size = (*positions.shape[:-2], height, width, -1)
        return torch.stack(pictures).reshape(size), torch.stack(alphas).reshape(size)


@pytest.mark.parametrize("options", [{}, {"antialiased": True, "depth": "accumulated"}, {"depth": None}])
def test_the_cuda_backend_puts_gsplats_stages_together(torch_gsplat, monkeypatch, options):
    monkeypatch.setattr(cuda, "_gsplat", lambda max_alpha: Stages(torch_gsplat))
    base, views = plain(12, seed=3, degree=1, size=0.25), cameras(18, 9, count=2)
    moved = Gaussians(
        torch.stack([base.means, base.means + 0.1]), base.quaternions, base.scales, base.opacities, sh=base.sh
    )
    background = torch.rand(2, 3)
    results = []
    for backend in ("cuda", "reference"):
        scene = leaves(moved)
        if backend == "cuda":
            settings = RasterOptions(
                0.01, 1e10, 0.3, options.get("antialiased", False), 0.999, options.get("depth", "expected")
            )
            offsets = torch.zeros(2, 2, 12, 2, requires_grad=True)
            images = torch.Size((2, 2))
            out = cuda.rasterize_cuda(scene, views, background, images, settings, offsets)
        else:
            out = rasterize(scene, views, background, screen_gradients=True, backend=backend, **options)
        (out.rgb.square().sum() + out.alpha.sum()).backward()
        results.append((out, scene, out.screen_offsets.grad))
    (out, scene, moved_by), (expected, truth, should) = results
    torch.testing.assert_close(out.rgb, expected.rgb)
    torch.testing.assert_close(out.alpha, expected.alpha)
    assert (out.depth is None) == (expected.depth is None)
    if out.depth is not None:
        torch.testing.assert_close(out.depth, expected.depth, rtol=1e-4, atol=1e-4)
    assert relative(moved_by, should) < 1e-4
    assert relative(scene.sh.grad, truth.sh.grad) < 1e-4
    assert relative(scene.means.grad, truth.means.grad) < 1e-4


def fake(monkeypatch, **backend):
    contents = {"gsplat": {"__version__": "1.5.3"}, "gsplat.cuda": {}, "gsplat.cuda._backend": backend}
    for name, values in contents.items():
        module = ModuleType(name)
        vars(module).update(values)
        monkeypatch.setitem(sys.modules, name, module)


def test_what_is_missing_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(DependencyError, match=r"meshanim\[cuda\]"):
        cuda._gsplat(0.999)


@pytest.mark.parametrize("backend", [{"_C": None}, {}])  # without a toolkit; with one that failed
def test_kernels_that_were_not_built_are_named(monkeypatch, backend):
    fake(monkeypatch, **backend)
    with pytest.raises(BackendError, match="install a CUDA toolkit"):
        cuda._gsplat(0.999)


def test_max_alpha_is_compiled_in(monkeypatch):
    fake(monkeypatch, _C=object())
    assert cuda._gsplat(0.999).__version__ == "1.5.3"
    with pytest.raises(OptionError, match=r"max_alpha=0\.999"):
        cuda._gsplat(0.9)


@pytest.mark.cuda
@pytest.mark.parametrize("antialiased", [False, True])
def test_cuda_kernels_equal_the_reference(antialiased):
    pytest.importorskip("gsplat")
    scene, views = hard(210, seed=1, degree=2), cameras(53, 45, count=2, seed=3)
    results = []
    for device, backend in (("cuda", "cuda"), ("cpu", "reference")):
        given = leaves(scene.to(device))
        out = rasterize(given, views.to(device), antialiased=antialiased, backend=backend)
        results.append((out, given))
    (out, given), (expected, truth) = results
    apart = (out.rgb.cpu() - expected.rgb).abs().amax(-1) > 1e-3
    assert float(apart.double().mean()) < 0.005
    weights = (~apart)[..., None].float()
    (out.rgb.cpu() * weights).sum().backward()
    (expected.rgb * weights).sum().backward()
    for name in ("means", "scales", "opacities", "sh"):
        assert relative(getattr(given, name).grad.cpu(), getattr(truth, name).grad) < 1e-3, name
