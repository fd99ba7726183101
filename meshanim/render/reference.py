"""The rasteriser in NumPy: slow, readable, the oracle of the tests and the fallback without the extension."""

import numpy as np

from meshanim.render.camera import Camera

__all__ = ["rasterize_reference"]

SUBPIXEL = 1024
GUARD = float(1 << 18)


def rasterize_reference(
    vertices: np.ndarray, faces: np.ndarray, camera: Camera, cull_backfaces: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Face (H, W) int32, barycentric (H, W, 3) and depth (H, W) float32 by `rasterize`'s rules."""
    face = np.full((camera.height, camera.width), -1, np.int32)
    barycentric = np.zeros((camera.height, camera.width, 3), np.float32)
    key = np.full((camera.height, camera.width), -np.inf)
    points = camera.to_camera(vertices.astype(np.float64))
    for index, corners in enumerate(faces):
        triangle = points[corners]
        if not np.isfinite(triangle).all():
            continue
        polygon, weights = _clip(triangle, camera)
        for k in range(1, len(polygon) - 1):
            fan = [0, k, k + 1]
            _fill(polygon[fan], weights[fan], index, camera, cull_backfaces, face, barycentric, key)
    depth = -key if camera.orthographic else 1 / np.where(face >= 0, key, 1)
    return face, barycentric, np.where(face >= 0, depth, np.inf).astype(np.float32)


def _planes(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Signed distances (n, 5) to the near plane and the guard band; inside is not negative."""
    homogeneous = points.copy()
    if camera.orthographic:
        homogeneous[:, 2] = 1.0
    x, y, w = (homogeneous @ camera.intrinsics.T).T
    return np.stack(
        [points[:, 2] - camera.near, GUARD * w - x, GUARD * w + x, GUARD * w - y, GUARD * w + y], 1
    )


def _clip(points: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Sutherland and Hodgman's polygon clipping; each point keeps its barycentric coordinates."""
    weights = np.eye(3)
    for plane in range(5):
        if len(points) == 0:
            break
        distance = _planes(points, camera)[:, plane]
        if (distance >= 0).all():
            continue
        new_points, new_weights = [], []
        for s in range(len(points)):
            t = (s + 1) % len(points)
            if distance[s] >= 0:
                new_points.append(points[s])
                new_weights.append(weights[s])
            if (distance[s] >= 0) != (distance[t] >= 0):
                i, o = (s, t) if distance[s] >= 0 else (t, s)
                u = distance[i] / (distance[i] - distance[o])
                new_points.append(points[i] + u * (points[o] - points[i]))
                new_weights.append(weights[i] + u * (weights[o] - weights[i]))
        points, weights = np.reshape(new_points, (-1, 3)), np.reshape(new_weights, (-1, 3))
    return points, weights


def _fill(points, weights, index, camera, cull, face, barycentric, key) -> None:
    homogeneous = points.copy()
    if camera.orthographic:
        homogeneous[:, 2] = 1.0
    image = homogeneous @ camera.intrinsics.T
    x, y = np.rint(image[:, :2] / image[:, 2:] * SUBPIXEL).astype(np.int64).T
    keys = -points[:, 2] if camera.orthographic else 1 / points[:, 2]
    area = (x[1] - x[0]) * (y[2] - y[0]) - (y[1] - y[0]) * (x[2] - x[0])
    if area == 0 or (cull and area > 0):
        return
    if area < 0:
        x, y, keys, weights = x[[0, 2, 1]], y[[0, 2, 1]], keys[[0, 2, 1]], weights[[0, 2, 1]]
    columns = np.arange(max(0, x.min() // SUBPIXEL), min(camera.width - 1, x.max() // SUBPIXEL) + 1)
    rows = np.arange(max(0, y.min() // SUBPIXEL), min(camera.height - 1, y.max() // SUBPIXEL) + 1)
    if not len(columns) or not len(rows):
        return
    px = (columns * SUBPIXEL + SUBPIXEL // 2)[None]
    py = (rows * SUBPIXEL + SUBPIXEL // 2)[:, None]
    edges, inside = [], np.ones((len(rows), len(columns)), bool)
    for s, t in ((1, 2), (2, 0), (0, 1)):
        dx, dy = x[t] - x[s], y[t] - y[s]
        value = dx * (py - y[s]) - dy * (px - x[s])
        top_left = dy < 0 or (dy == 0 and dx > 0)
        inside &= value >= (0 if top_left else 1)
        edges.append(value.astype(np.float64))
    edge = np.stack(edges, -1)
    nearer = edge @ keys / abs(area)
    window = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
    visible = inside & (nearer > key[window])
    share = edge if camera.orthographic else edge * keys
    share = share / share.sum(-1, keepdims=True)
    key[window] = np.where(visible, nearer, key[window])
    face[window] = np.where(visible, index, face[window])
    barycentric[window] = np.where(visible[..., None], share @ weights, barycentric[window])
