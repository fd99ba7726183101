import pytest
import torch

from meshanim.gaussians import rasterize
from meshanim.gaussians.splat import native
from meshanim.gaussians.splat.benchmark import SplatBenchmark, run, training_step, workload


def test_workload_is_a_surface_in_view():
    scene, views = workload(2000, 96)
    assert len(scene) == 2000
    alpha = rasterize(scene, views, depth=None).alpha[0]
    assert float(alpha[48, 48]) > 0.9
    assert float(alpha[0].max()) == 0
    assert 0.2 < float((alpha > 0.5).float().mean()) < 0.7


@pytest.mark.skipif(not native.available(), reason="the extension is not built")
def test_rows_and_ratios():
    results = run(SplatBenchmark(sizes=((600, 48),), reference=600, repeats=2))
    case = "600 Gaussians, 48 x 48"
    fast, slow = (results.value(case, name, "forward") for name in ("native", "reference"))
    assert results.value(case, "reference / native", "forward ratio") == pytest.approx(slow / fast)
    pairs = results.value(case, "native", "pairs of pixel and Gaussian")
    scene, views = workload(600, 48)
    area = rasterize(scene, views, depth=None).radii.double().clamp_min(1).prod(-1).sum() * torch.pi
    assert 0.2 * float(area) < pairs < 4 * float(area)
    assert 0 < results.value(case, "native", "forward of peak") < 100
    milliseconds = results.value(case, "native", "training step")
    assert results.value(case, "native", "training steps") == pytest.approx(1e3 / milliseconds)


def test_the_training_step_learns():
    step = training_step(600, 48)
    losses = [float(step()) for _ in range(40)]
    assert losses[-1] < 0.8 * losses[0]
