import pytest
import torch

from meshanim.errors import OptionError, ShapeError
from meshanim.gaussians import Cameras, Gaussians
from meshanim.render.camera import portrait_camera


def some(n=5, batch=(), seed=0, **fields):
    generator = torch.Generator().manual_seed(seed)
    made = {
        "means": torch.randn(*batch, n, 3, generator=generator),
        "quaternions": torch.randn(n, 4, generator=generator),
        "scales": torch.rand(n, 3, generator=generator),
        "opacities": torch.rand(n, generator=generator),
    }
    if "sh" not in fields:
        made["colors"] = torch.rand(n, 3, generator=generator)
    return Gaussians(**(made | fields))


def test_fields_share_a_batch_that_some_leave_out():
    gaussians = some(batch=(2, 4), opacities=torch.rand(4, 5))
    assert len(gaussians) == 5
    assert gaussians.batch_shape == (2, 4)


def test_centres_may_be_what_all_frames_share():
    still = Gaussians(
        torch.zeros(5, 3), torch.ones(5, 4), torch.ones(5, 3), torch.ones(5), sh=torch.zeros(3, 5, 4, 3)
    )
    assert still.batch_shape == (3,)
    assert still.select(torch.tensor([1, 4])).sh.shape == (3, 2, 4, 3)


@pytest.mark.parametrize(("coefficients", "degree"), [(1, 0), (4, 1), (9, 2), (16, 3)])
def test_degree_of_harmonics(coefficients, degree):
    assert some(sh=torch.zeros(5, coefficients, 3)).sh_degree == degree
    assert some().sh_degree is None


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"scales": torch.rand(4, 3)}, "scales has 4 Gaussians, means has 5"),
        ({"quaternions": torch.rand(5, 3)}, r"quaternions must be \(\.\.\., N, 4\), not \(5, 3\)"),
        ({"opacities": torch.rand(5).double()}, "opacities is torch.float64"),
        ({"sh": torch.zeros(5, 5, 3)}, "1, 4, 9 or 16 coefficients, not 5"),
        ({"means": torch.rand(2, 5, 3), "opacities": torch.rand(3, 5)}, "batch dimensions do not fit"),
    ],
)
def test_wrong_shapes_are_named(unchecked, fields, said):
    with pytest.raises(ShapeError, match=said):
        some(**fields)


def test_either_colors_or_harmonics():
    with pytest.raises(OptionError, match="either colors or sh"):
        some(colors=torch.rand(5, 3), sh=torch.zeros(5, 1, 3))


def test_select_and_concatenate_are_inverse():
    gaussians = some(batch=(3,))
    first = torch.tensor([True, False, True, False, False])
    order = torch.tensor([0, 2, 1, 3, 4])
    joined = Gaussians.concatenate([gaussians.select(first), gaussians.select(~first)])
    torch.testing.assert_close(joined.means, gaussians.means[:, order])
    torch.testing.assert_close(joined.opacities, gaussians.opacities[order])
    with pytest.raises(ShapeError, match="same fields"):
        Gaussians.concatenate([gaussians, some()])


def test_cameras_of_the_mesh_renderer_project_alike():
    points = torch.rand(20, 3, dtype=torch.float64) * 0.1
    views = [portrait_camera(points.numpy(), 64, 48, azimuth) for azimuth in (0.0, 0.4)]
    cameras = Cameras.of(views, torch.float64)
    assert (len(cameras), cameras.width, cameras.height) == (2, 64, 48)
    for index, view in enumerate(views):
        ours = points @ cameras.world_to_camera[index, :3, :3].T + cameras.world_to_camera[index, :3, 3]
        ours = ours @ cameras.intrinsics[index].T
        expected = torch.from_numpy(view.project(points.numpy()))
        torch.testing.assert_close(ours[:, :2] / ours[:, 2:], expected[:, :2])
        torch.testing.assert_close(cameras.positions[index], torch.from_numpy(view.position))


def test_scaled_cameras_see_the_same():
    view = portrait_camera(torch.rand(20, 3).numpy(), 64, 48)
    half = Cameras.of(view).scaled(32, 24)
    torch.testing.assert_close(half.intrinsics, Cameras.of(view.scaled(0.5)).intrinsics)


def test_wrong_cameras_are_named(unchecked):
    eye, k = torch.eye(4)[None], torch.eye(3)[None]
    with pytest.raises(ShapeError, match="no skew"):
        Cameras(eye, k + torch.tensor([[0.0, 1, 0], [0, 0, 0], [0, 0, 0]]), 4, 4)
    with pytest.raises(ShapeError, match="not finite"):
        Cameras(eye * torch.nan, k, 4, 4)
    with pytest.raises(ShapeError, match="intrinsics of 2"):
        Cameras(eye, k.repeat(2, 1, 1), 4, 4)
    with pytest.raises(OptionError, match="positive, not 0 x 4"):
        Cameras(eye, k, 0, 4)
    with pytest.raises(OptionError, match="one image size"):
        Cameras.of([portrait_camera(torch.rand(9, 3).numpy(), size, 48) for size in (48, 64)])
