import numpy as np
import pytest

from meshanim.errors import OptionError, ShapeError
from meshanim.geometry import TriangleMesh
from meshanim.render import STUDIO, Light, Lighting, portrait_camera, render_mesh
from meshanim.render.rasterizer import native_available

pytestmark = pytest.mark.skipif(not native_available(), reason="the extension is not built")
BLACK = np.zeros((64, 64, 3), np.float32)


def sphere(rings=40, segments=60, radius=0.1):
    t, p = np.meshgrid(
        np.linspace(0, np.pi, rings), np.arange(segments) / segments * 2 * np.pi, indexing="ij"
    )
    points = np.stack([np.sin(t) * np.sin(p), np.cos(t), np.sin(t) * np.cos(p)], -1).reshape(-1, 3)
    row = np.arange(rings - 1)[:, None] * segments
    here, there = np.arange(segments)[None], (np.arange(segments)[None] + 1) % segments
    quads = np.stack([row + here, row + segments + here, row + segments + there, row + there], -1)
    quads = quads.reshape(-1, 4)
    return TriangleMesh(radius * points, np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]]))


@pytest.fixture(scope="module")
def ball():
    return sphere()


def frontal(sky=0.3):
    return Lighting((Light((0.0, 0.0, 1.0), (1.0, 1.0, 1.0), 2.0),), (sky,) * 3, (sky,) * 3, (0.0, 0.0, 1.0))


def picture(mesh, **options):
    camera = portrait_camera(mesh.vertices, 64, 64)
    return render_mesh(mesh.vertices, mesh, camera, **options)


@pytest.mark.parametrize("quality", ["draft", "full"])
def test_a_sphere_is_a_lit_disc(ball, quality):
    image = picture(ball, quality=quality, background=BLACK, lighting=frontal()).astype(float).mean(-1)
    y, x = np.mgrid[:64, :64] + 0.5
    radius = np.hypot(x - 32, y - 32) / (32 * 0.92)
    assert (image[radius > 1.05] == 0).all()
    assert (image[radius < 0.97] > 30).all()
    # Brighter in the middle than at the rim, falling monotonically (Lambert) within the dither of 8 bits.
    rings = [image[(radius >= a) & (radius < a + 0.1)].mean() for a in np.arange(0, 0.9, 0.1)]
    assert (np.diff(rings) < 1).all()
    np.testing.assert_allclose(image, image[:, ::-1], atol=16)


def test_edges_are_smooth_in_full_quality(ball):
    image = picture(ball, quality="full", background=BLACK).max(-1)
    middle = image[32, 32]
    assert ((image > 5) & (image < 0.6 * middle)).sum() > 20


def test_threads_do_not_change_the_picture(ball):
    images = [picture(ball, threads=threads) for threads in (1, 2, 3)]
    assert all(np.array_equal(images[0], other) for other in images[1:])


def test_colors_are_kept(ball):
    red = np.tile(np.array([0.8, 0.1, 0.1]), (ball.n_vertices, 1))
    image = picture(ball, colors=red, background=BLACK).astype(int)
    middle = image[24:40, 24:40].reshape(-1, 3)
    assert (middle[:, 0] > middle[:, 1] + 60).all()


def test_more_light_is_brighter_and_no_light_is_black(ball):
    dark = Lighting((Light((0.0, 0.0, 1.0), (1.0, 1.0, 1.0), 0.0),), (0.0,) * 3, (0.0,) * 3, (0.0, 0.0, 1.0))
    assert picture(ball, lighting=dark, background=BLACK).max() < 60  # the reflected sky remains
    assert picture(ball, lighting=frontal(0.6)).mean() > picture(ball, lighting=frontal(0.1)).mean()


def test_shadow_falls_on_what_is_behind(ball):
    """A small ball between the light and a large one darkens its middle."""
    small = sphere(20, 30, 0.02)
    vertices = np.concatenate([ball.vertices, small.vertices + np.array([0.0, 0.0, 0.3])])
    mesh = TriangleMesh(vertices, np.concatenate([ball.faces, small.faces + ball.n_vertices]))
    light = Lighting((Light((0.0, 0.0, 1.0), (1.0, 1.0, 1.0), 2.0),), (0.1,) * 3, (0.1,) * 3, (0.0, 0.0, 1.0))
    camera = portrait_camera(ball.vertices, 64, 64, azimuth=0.9)
    with_ball = render_mesh(vertices, mesh, camera, lighting=light, background=BLACK).astype(int)
    without = render_mesh(ball.vertices, ball, camera, lighting=light, background=BLACK).astype(int)
    change = (without - with_ball).max(-1)
    assert change.max() > 60
    assert 0.005 < (change > 40).mean() < 0.2


def test_an_open_surface_is_dark_inside(ball):
    half = ball.faces[ball.vertices[ball.faces].mean(1)[:, 2] < 0.0]
    mesh = TriangleMesh(ball.vertices, half)
    image = picture(mesh, background=np.ones((64, 64, 3), np.float32))
    assert image[28:36, 28:36].max() < 150
    assert image[0, 0].min() > 200


def test_bad_input_is_named(ball):
    with pytest.raises(ShapeError, match="vertices"):
        render_mesh(np.full((ball.n_vertices, 3), np.nan), ball)
    with pytest.raises(ShapeError, match="colors"):
        picture(ball, colors=np.zeros((4, 3)))
    with pytest.raises(ShapeError, match="background"):
        picture(ball, background=np.zeros((2, 2, 3), np.float32))
    with pytest.raises(OptionError, match="quality"):
        picture(ball, quality="best")
    with pytest.raises(OptionError, match="lights"):
        Lighting((), (0.1,) * 3, (0.1,) * 3, STUDIO.catch_light)
