import math
from dataclasses import replace

import pytest
import torch
from made_capture import made_avatar, write_rig

from meshanim.errors import OptionError
from meshanim.gaussians.avatar.density import DensityStatistics, refine, reset_opacities
from meshanim.gaussians.avatar.model import GAUSSIAN_FIELDS
from meshanim.gaussians.avatar.optimizer import carry, make_optimizer, rate_at
from meshanim.gaussians.avatar.settings import PRESETS, Density, Rate, preset
from meshanim.geometry import triangle_frames

TOP = Density("top", limit=90, prune_opacity=0.02)
SCREEN = Density("screen", threshold=1.0, clone_below=0.01)


@pytest.fixture
def avatar(tmp_path):
    return made_avatar(write_rig(tmp_path / "rig.npz"), latent=2)


def measured(avatar, gradient):
    statistics = DensityStatistics(len(avatar))
    seen = torch.ones(len(avatar), dtype=torch.bool)
    for _ in range(3):
        statistics.add(gradient, seen, torch.full((len(avatar),), 5))
    return statistics


def test_mean_is_over_the_pictures_that_show_a_gaussian():
    statistics = DensityStatistics(2)
    statistics.add(torch.tensor([1.0, 5.0]), torch.tensor([True, False]), torch.tensor([3, 9]))
    statistics.add(torch.tensor([3.0, 4.0]), torch.tensor([True, True]), torch.tensor([2, 1]))
    assert statistics.mean.tolist() == [2.0, 4.0]
    assert statistics.radius.tolist() == [3, 1]


def test_top_splits_in_local_units_along_the_longest_axis(avatar):
    gradient = torch.zeros(80)
    gradient[[7, 30]] = torch.tensor([2.0, 1.0])
    with torch.no_grad():
        avatar.scales[7] = torch.tensor([0.1, 0.8, 0.2]).log()
        avatar.rotations[7] = torch.tensor([math.cos(math.pi / 4), 0, 0, math.sin(math.pi / 4)])  # y to -x
    before = avatar.local()
    refined = refine(avatar, measured(avatar, gradient), TOP, left=5, extent=1.0, was_reset=False, seed=0)
    assert refined.parent[-2:].tolist() == [7, 30]
    assert refined.fresh.tolist() == [False] * 80 + [True] * 2
    after = avatar.local()
    apart = (after.means[80] - after.means[7]).detach()
    assert apart.abs().tolist() == pytest.approx([2 * 0.55 * 0.8, 0, 0], abs=1e-6)
    middle = (after.means[80] + after.means[7]) / 2
    assert torch.allclose(middle, before.means[7], atol=1e-6)
    shrunk = (before.scales[7] / after.scales[80]).detach() / math.exp(0.05)
    assert shrunk.tolist() == pytest.approx([1, 1.7, 1], rel=1e-5)
    assert torch.equal(after.means[:7], before.means[:7])


def test_top_reaches_its_limit_in_equal_parts_and_stops_there(avatar):
    counts = []
    for left in (3, 2, 1):
        refine(avatar, measured(avatar, torch.rand(len(avatar))), TOP, left, 1.0, False, seed=0)
        counts.append(len(avatar))
    assert counts == [83, 86, 90]
    refine(avatar, measured(avatar, torch.rand(90)), TOP, 1, 1.0, False, seed=0)
    assert len(avatar) == 90


def test_every_triangle_keeps_its_most_opaque(avatar):
    with torch.no_grad():
        avatar.opacities[:] = -9
    refine(avatar, measured(avatar, torch.zeros(80)), TOP, 1, 1.0, False, seed=0)
    assert len(avatar) == 80
    with torch.no_grad():
        avatar.opacities[:] = 1
    refine(avatar, measured(avatar, torch.rand(80)), TOP, 1, 1.0, False, seed=0)
    with torch.no_grad():
        avatar.opacities[80:] = -9
        avatar.opacities[80] = 3
        avatar.opacities[avatar.face == avatar.face[80]] -= 12  # twins, both nearly transparent
    face = avatar.face[80]
    refine(avatar, measured(avatar, torch.zeros(90)), replace(TOP, limit=0), 1, 1.0, False, seed=0)
    assert torch.equal(avatar.binding.count, torch.ones(80, dtype=torch.int64))
    assert torch.sigmoid(avatar.opacities[avatar.face == face]) < 0.02


def test_screen_clones_small_and_draws_two_of_large(avatar):
    size = triangle_frames(avatar.binding.rest, avatar.binding.faces).scale.float() * 0.7
    extent = float(size.median()) / 0.01
    gradient = torch.zeros(80)
    small, large = int(size.argmin()), int(size.argmax())
    gradient[[small, large]] = 2.0
    before = {name: getattr(avatar, name).detach().clone() for name in GAUSSIAN_FIELDS}
    refined = refine(avatar, measured(avatar, gradient), SCREEN, 1, extent, False, seed=4)
    assert refined.parent.tolist()[79:] == [small, large, large]
    assert sum(refined.fresh.tolist()) == 3
    assert torch.equal(avatar.means[79], before["means"][small])
    children = avatar.local().scales[80:].detach()
    assert torch.allclose(children, before["scales"][large].exp() / 1.6)
    spread = (avatar.means[80:] - before["means"][large]).detach() / before["scales"][large].exp()
    assert 0.05 < spread.abs().amax() < 5  # of the local scale: not millimetres of the world


def test_screen_prunes_large_ones_only_after_a_reset(avatar):
    with torch.no_grad():
        avatar.scales[3] += 8
    calm = measured(avatar, torch.zeros(80))
    avatar.face = torch.cat([avatar.face[:3], avatar.face[2:3], avatar.face[4:]])  # its triangle has another
    assert len(refine(avatar, calm, SCREEN, 1, 1.0, False, seed=0).parent) == 80
    assert len(refine(avatar, measured(avatar, torch.zeros(80)), SCREEN, 1, 1.0, True, seed=0).parent) == 79


def test_momentum_follows_the_gaussians(avatar):
    optimizer = make_optimizer(avatar, None, PRESETS["small"], 1.0)
    loss = sum((p * torch.randn(p.shape)).sum() for p in avatar.parameters())
    loss.backward()
    optimizer.step()
    before = {k: optimizer.state[avatar.means][k].clone() for k in ("exp_avg", "exp_avg_sq")}
    old = avatar.means
    with torch.no_grad():
        avatar.opacities[11] = -9
    avatar.face = torch.cat([avatar.face[:11], avatar.face[10:11], avatar.face[12:]])
    refined = refine(avatar, measured(avatar, torch.rand(80)), TOP, 1, 1.0, False, seed=0)
    carry(optimizer, avatar, refined)
    assert 11 not in refined.parent
    assert old not in optimizer.state
    state = optimizer.state[avatar.means]
    assert torch.equal(state["exp_avg_sq"], before["exp_avg_sq"][refined.parent])
    assert torch.equal(state["exp_avg"][~refined.fresh], before["exp_avg"][refined.parent[~refined.fresh]])
    assert not state["exp_avg"][refined.fresh].any()
    avatar.means.sum().backward()
    moved = avatar.means.detach().clone()
    for group in optimizer.param_groups:
        group["lr"] = 0.1
    optimizer.step()
    assert (avatar.means < moved)[refined.fresh].all()


def test_reset_leaves_a_hundredth(avatar):
    reset_opacities(avatar)
    assert torch.sigmoid(avatar.opacities).tolist() == pytest.approx([0.01] * 80, rel=1e-4)


def test_rates_rise_hold_and_fall():
    rate = Rate(2.0, end=0.03, level=0.3, delay=50, delay_factor=0.02)
    assert rate_at(rate, 0, 1000) == pytest.approx(0.04)
    assert rate_at(rate, 50, 1000) == rate_at(rate, 300, 1000) == pytest.approx(2.0)
    assert rate_at(rate, 650, 1000) == pytest.approx(2.0 * 0.03**0.5)
    assert rate_at(rate, 1000, 1000) == pytest.approx(0.06)
    # GaussianAvatars' positions: 5e-3 to 5e-5 over 600,000 steps.
    paper = PRESETS["paper"]
    assert rate_at(paper.rates["means"], 300_000, 600_000) == pytest.approx(5e-4)


def test_paper_has_the_published_numbers():
    paper = preset("paper", 802)
    steps, density = paper.iterations, paper.density
    assert (steps, density.start * steps, density.every * steps) == (600_000, 10_000, pytest.approx(2_000))
    assert density.reset_every * steps == pytest.approx(60_000)
    assert (density.threshold, density.prune_opacity, paper.color.sh_degree) == (2e-4, 0.005, 3)
    assert paper.color.sh_every * steps == pytest.approx(1000)
    with pytest.raises(OptionError, match="no preset"):
        preset("huge", 256)
    assert preset("small", 512).coarse > 0 == preset("small", 256).coarse
