import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from meshanim.errors import MeshError, OptionError, ShapeError
from meshanim.render import Camera, look_at, orthographic_camera, portrait_camera, rasterize
from meshanim.render.rasterizer import native_available

BACKENDS = ["reference", "native"] if native_available() else ["reference"]


def camera(width=32, height=24, focal=30.0, near=0.1):
    intrinsics = np.array([[focal, 0.3, width / 2], [0.0, focal * 1.1, height / 2], [0.0, 0.0, 1.0]])
    return Camera(look_at((0.2, 0.1, 3.0), (0.0, 0.0, 0.0)), intrinsics, width, height, near)


def flat_camera(width=16, height=16):
    """World x, y are pixels (y down), z is depth."""
    return Camera(np.eye(4), np.eye(3), width, height, near=-1e9, orthographic=True)


def triangles(seed, n, spread=1.0, size=0.5):
    rng = np.random.default_rng(seed)
    centres = rng.normal(size=(n, 1, 3)) * spread
    vertices = (centres + rng.normal(size=(n, 3, 3)) * size).reshape(-1, 3)
    return vertices.astype(np.float32), np.arange(3 * n, dtype=np.int32).reshape(-1, 3)


def seen_by_rays(vertices, faces, camera):
    """Second implementation: intersect the ray of each pixel centre with each plane in float64."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(camera.intrinsics).T
    corners = camera.to_camera(vertices.astype(np.float64))[faces]
    depth = np.full(x.shape, np.inf)
    face = np.full(x.shape, -1)
    margin = np.full(x.shape, np.inf)
    bary = np.zeros((*x.shape, 3))
    for index, (a, b, c) in enumerate(corners):
        volumes = np.stack([rays @ np.cross(b, c), rays @ np.cross(c, a), rays @ np.cross(a, b)], -1)
        with np.errstate(all="ignore"):
            weights = volumes / volumes.sum(-1, keepdims=True)
            z = weights @ np.array([a[2], b[2], c[2]])
        inside = (weights >= 0).all(-1) & (z > camera.near) & (z < depth)
        margin = np.minimum(margin, np.nan_to_num(np.abs(weights).min(-1), nan=0.0))
        margin = np.minimum(margin, np.abs(z - camera.near))
        depth, face = np.where(inside, z, depth), np.where(inside, index, face)
        bary = np.where(inside[..., None], weights, bary)
    return face, bary, depth, margin > 0.02


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("size", [0.1, 1.0, 4.0])
@pytest.mark.parametrize("seed", range(6))
def test_agrees_with_rays(backend, seed, size):
    vertices, faces = triangles(seed, 8, size=size)
    face, bary, depth, safe = seen_by_rays(vertices, faces, camera())
    buffers = rasterize(vertices, faces, camera(), backend=backend)
    # A pixel near some edge may go either way; the others must agree.
    assert (buffers.face == face)[safe].all()
    same = safe & (face >= 0)
    np.testing.assert_allclose(buffers.depth[same], depth[same], rtol=0.02)
    np.testing.assert_allclose(buffers.barycentric[same], bary[same], atol=0.05)


@pytest.mark.skipif(not native_available(), reason="the extension is not built")
@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    size=st.sampled_from([0.02, 0.5, 5.0, 1e4]),
    cull=st.booleans(),
    orthographic=st.booleans(),
)
def test_native_equals_reference(seed, size, cull, orthographic):
    vertices, faces = triangles(seed, 20, size=size)
    some = np.clip(vertices[:9], -2, 2)
    view = orthographic_camera(some, [0.3, 0.2, 1.0], 0.1) if orthographic else camera()
    one = rasterize(vertices, faces, view, backend="reference", cull_backfaces=cull)
    two = rasterize(vertices, faces, view, backend="native", cull_backfaces=cull)
    assert np.array_equal(one.mask, two.mask)
    assert (one.face != two.face).mean() < 0.002  # equally near within float32
    same = one.mask & (one.face == two.face)
    np.testing.assert_allclose(one.barycentric[same], two.barycentric[same], atol=2e-4)
    np.testing.assert_allclose(one.depth[same], two.depth[same], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("backend", BACKENDS)
@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6), inner=st.integers(0, 30))
def test_triangulation_covers_each_pixel_once(backend, seed, inner):
    """Triangles of a planar triangulation, one at a time: each pixel centre of the square belongs to one."""
    from scipy.spatial import Delaunay

    rng = np.random.default_rng(seed)
    # Points on pixel centres and on halves of them make edges run exactly through centres.
    points = rng.integers(0, 33, (inner, 2)) / 2
    points = np.unique(np.concatenate([points, [[0, 0], [16, 0], [0, 16], [16, 16]]]), axis=0)
    mesh = Delaunay(points)
    vertices = np.c_[points, np.ones(len(points))].astype(np.float32)
    count = np.zeros((16, 16), int)
    for triangle in mesh.simplices:
        count += rasterize(vertices, triangle[None].astype(np.int32), flat_camera(), backend=backend).mask
    assert (count == 1).all()


@pytest.mark.parametrize("backend", BACKENDS)
def test_clipped_neighbours_leave_no_gap(backend):
    """A large floor through the near plane, as two triangles: seen as one."""
    view = Camera(look_at((0, 1, 0), (0, 0.9, -1)), camera(64, 48).intrinsics, 64, 48, near=0.1)
    vertices = np.array([[-50, 0, -50], [50, 0, -50], [50, 0, 50], [-50, 0, 50]], np.float32)
    count = np.zeros((48, 64), int)
    for triangle in ([0, 1, 2], [0, 2, 3]):
        count += rasterize(vertices, np.array([triangle]), view, backend=backend).mask
    assert count.max() == 1
    assert count[-1].all()
    assert not count[0].any()


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    "vertices",
    [
        [[0, 0, 5], [1, 0, 5], [0, 1, 5]],  # behind the camera
        [[0, 0, 0], [0, 0, 0], [0, 0, 0]],  # a point
        [[0, 0, 0], [1, 1, 0], [2, 2, 0]],  # a line
        [[50, 0, 0], [51, 0, 0], [50, 1, 0]],  # beside the picture
        [[1e-4, 0, 0], [2e-4, 0, 0], [1e-4, 1e-4, 0]],  # between pixel centres
        [[np.nan, 0, 0], [1, 0, 0], [0, 1, 0]],
        [[np.inf, 0, 0], [1, 0, 0], [0, 1, 0]],
    ],
)
def test_unseen_triangles_leave_nothing(backend, vertices):
    buffers = rasterize(np.array(vertices, float), np.array([[0, 1, 2]]), camera(), backend=backend)
    assert (buffers.face == -1).all()
    assert (buffers.barycentric == 0).all()
    assert np.isinf(buffers.depth).all()


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("size", [10.0, 1e5, 1e9])
def test_a_huge_triangle_fills_the_picture(backend, size):
    vertices = np.array([[-size, -size, 0], [size * 2, -size, 0], [0, size, 0]])
    buffers = rasterize(vertices, np.array([[0, 1, 2]]), camera(), backend=backend)
    assert (buffers.face == 0).all()
    np.testing.assert_allclose(buffers.barycentric.sum(-1), 1, atol=1e-5)
    position = buffers.interpolate(vertices, np.array([[0, 1, 2]]))
    np.testing.assert_allclose(position[..., 2], 0, atol=1e-5 * size)


@pytest.mark.parametrize("backend", BACKENDS)
def test_one_pixel(backend):
    vertices = np.array([[3.2, 5.2, 1], [3.9, 5.2, 1], [3.5, 5.9, 1]])
    buffers = rasterize(vertices, np.array([[0, 1, 2]]), flat_camera(), backend=backend)
    assert np.argwhere(buffers.mask).tolist() == [[5, 3]]
    assert buffers.depth[5, 3] == 1


@pytest.mark.parametrize("backend", BACKENDS)
def test_culling_keeps_the_front(backend):
    vertices = np.array([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0]])  # counter-clockwise seen from +z
    front, back = np.array([[0, 1, 2]]), np.array([[0, 2, 1]])
    assert rasterize(vertices, front, camera(), cull_backfaces=True, backend=backend).mask.any()
    assert not rasterize(vertices, back, camera(), cull_backfaces=True, backend=backend).mask.any()
    assert rasterize(vertices, back, camera(), backend=backend).mask.any()


def test_perspective_correct_and_projection_agree():
    view = camera(200, 160, 180)
    vertices, faces = triangles(3, 30)
    buffers = rasterize(vertices, faces, view)
    seen = view.project(buffers.interpolate(vertices, faces)[buffers.mask])
    y, x = np.nonzero(buffers.mask)
    # Rounding to 1/1024 pixel may turn slivers; the median shows the rule.
    error = np.abs(seen[:, :2] - np.stack([x, y], 1) - 0.5).max(1)
    assert np.median(error) < 2e-3
    assert np.quantile(error, 0.99) < 0.02
    np.testing.assert_allclose(seen[:, 2], buffers.depth[buffers.mask], rtol=1e-3)


@pytest.mark.skipif(not native_available(), reason="the extension is not built")
def test_threads_and_instruction_sets_do_not_change_the_result():
    from meshanim import _native

    vertices, faces = triangles(5, 3000, size=0.2)
    view = camera(300, 200, 300)
    best = _native.instruction_set()
    results = [rasterize(vertices, faces, view, threads=threads) for threads in (1, 2, 5)]
    for other in results[1:]:
        assert np.array_equal(results[0].face, other.face)
        assert np.array_equal(results[0].barycentric, other.barycentric)
        assert np.array_equal(results[0].depth, other.depth)
    try:
        _native.set_instruction_set("generic")
        assert np.array_equal(rasterize(vertices, faces, view).mask, results[0].mask)
    finally:
        _native.set_instruction_set(best)


def test_empty_mesh_and_bad_input():
    nothing = rasterize(np.zeros((0, 3)), np.zeros((0, 3), int), camera())
    assert not nothing.mask.any()
    with pytest.raises(MeshError, match="7"):
        rasterize(np.zeros((3, 3)), np.array([[0, 1, 7]]), camera())
    with pytest.raises(OptionError, match="threads"):
        rasterize(np.zeros((3, 3)), np.array([[0, 1, 2]]), camera(), threads=0)
    with pytest.raises(OptionError, match="backend"):
        rasterize(np.zeros((3, 3)), np.array([[0, 1, 2]]), camera(), backend="gpu")
    with pytest.raises(OptionError, match="size"):
        Camera(np.eye(4), np.eye(3), 0, 4)
    with pytest.raises(ShapeError, match="world_to_camera"):
        Camera(np.full((4, 4), np.nan), np.eye(3), 4, 4)
    with pytest.raises(OptionError, match="look"):
        look_at((0, 1, 0), (0, 0, 0))


@settings(max_examples=20, deadline=None)
@given(azimuth=st.floats(-3, 3), elevation=st.floats(-1, 1), fov=st.floats(0.1, 1.5))
def test_portrait_camera_frames_all_vertices(azimuth, elevation, fov):
    vertices = np.random.default_rng(0).normal(size=(50, 3)) * [0.1, 0.15, 0.12]
    view = portrait_camera(vertices, 300, 200, azimuth, elevation, fov)
    x, y, z = view.project(vertices).T
    assert x.min() >= 0
    assert x.max() <= 300
    assert y.min() >= 0
    assert y.max() <= 200
    assert z.min() > view.near
    slack = min(x.min() / 300, 1 - x.max() / 300, y.min() / 200, 1 - y.max() / 200)
    assert slack == pytest.approx(0.04, abs=1e-6)
