import numpy as np
import pytest
import torch

from meshanim.errors import OptionError
from meshanim.heads import HeadParameters, load_head
from meshanim.render import Renderer, rasterize
from meshanim.render.drawn_surface import drawn_surface
from meshanim.render.lighting import plain_background
from meshanim.render.look import PersonParameters, make_appearance
from meshanim.render.rasterizer import native_available

pytestmark = pytest.mark.skipif(not native_available(), reason="the extension is not built")
SIZE = 128


@pytest.fixture(scope="module")
def head():
    return load_head("default")


@pytest.fixture(scope="module")
def appearance(head):
    return make_appearance(head, PersonParameters(hair="buzz", hair_length=0.008, seed=3), size=256)


@pytest.fixture(scope="module")
def renderer(head, appearance):
    return Renderer(head, appearance, SIZE, SIZE, threads=1)


@pytest.fixture(scope="module")
def posed(head, appearance):
    weights = {"jawOpen": 0.6, "mouthSmileLeft": 0.7, "eyeLookOutLeft": 0.8, "eyeLookInRight": 0.8}
    params = HeadParameters(
        shape=torch.from_numpy(appearance.shape)[None],
        expression=head.expression(weights),
        neck=torch.tensor([[0.1, 0.4, -0.1]]),
    )
    with torch.no_grad():
        return head(params)


def test_fine_is_what_the_renderer_draws(head, appearance, renderer, posed):
    surface = drawn_surface(head, appearance, "fine")
    renderer.frame(posed[0].numpy())
    drawn = renderer._stage.geometry
    assert np.array_equal(surface.faces, drawn.faces)
    assert np.abs(surface(posed)[0].numpy() - drawn.vertices).max() < 1e-6


def test_vertices_of_skin_and_tongue_at_coarse_are_vertices_of_the_drawn_surface(head, appearance, posed):
    coarse, fine = (drawn_surface(head, appearance, detail) for detail in ("coarse", "fine"))
    assert 11_000 < len(coarse.faces) < 13_500
    count = coarse.operator.shape[0]
    near = torch.cdist(coarse(posed)[0, :count].double(), fine(posed)[0].double()).min(1).values
    assert near.max() < 1e-7
    # The control cage itself is somewhere else.
    cage = torch.cdist(posed[0, head.parts["skin"].vertices].double(), fine(posed)[0].double()).min(1).values
    assert cage.mean() > 1e-4


def test_coarse_covers_what_is_seen(head, appearance, renderer, posed):
    coarse = drawn_surface(head, appearance, "coarse")
    maps = renderer.maps(posed[0].numpy())
    buffers = rasterize(coarse(posed)[0].numpy(), coarse.faces, renderer.camera, cull_backfaces=True)
    assert (maps.mask != buffers.mask).mean() < 0.005
    both = maps.mask & buffers.mask
    assert np.abs(maps.depth[both] - buffers.depth[both]).mean() < 3e-4


def test_unknown_detail(head, appearance):
    with pytest.raises(OptionError, match="coarse or fine"):
        drawn_surface(head, appearance, "finest")


def test_regions_of_the_frame_agree_with_those_at_pixel_centres(renderer, posed):
    renderer.frame(posed[0].numpy())
    region, names = renderer.frame_regions()
    maps = renderer.maps(posed[0].numpy())
    assert names == maps.region_names
    assert (region == maps.region).mean() > 0.97
    assert (region == names.index("mouth_lining")).sum() + (region == names.index("tongue")).sum() > 5


def test_strands_cover_the_scalp_and_not_the_face(renderer, posed):
    renderer.frame(posed[0].numpy())
    region, names = renderer.frame_regions()
    cover = renderer.strand_cover("hair")
    assert cover.min() >= 0
    assert cover.max() <= 1
    assert cover[region == names.index("nose")].max() == 0
    assert cover[region == names.index("scalp")].mean() > 0.1
    assert np.array_equal(cover, renderer.strand_cover("hair"))
    assert not renderer.strand_cover("wig").any()


def test_another_camera_draws_as_a_renderer_made_for_it(head, appearance, renderer, posed):
    from meshanim.render import head_camera

    camera = head_camera(appearance, SIZE, SIZE, azimuth=0.5)
    other = renderer.seen_from(camera).frame(posed[0].numpy())
    made = Renderer(head, appearance, camera=camera, threads=1).frame(posed[0].numpy())
    assert np.abs(other.astype(int) - made).mean() < 0.5  # textures may be one step finer
    assert np.array_equal(
        renderer.frame(posed[0].numpy()), Renderer(head, appearance, SIZE, SIZE).frame(posed[0].numpy())
    )


@pytest.mark.parametrize("color", [(0.0, 0.0, 0.0), (178 / 255, 64 / 255, 200 / 255), (1.0, 1.0, 1.0)])
def test_plain_background_is_that_colour_after_the_tone_curve(head, appearance, posed, color):
    background = plain_background(SIZE, SIZE, color)
    image = Renderer(head, appearance, SIZE, SIZE, background=background, threads=1).frame(posed[0].numpy())
    assert np.array_equal(image[0, 0], np.round(255 * np.array(color)))
