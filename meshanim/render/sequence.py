"""`render_sequence`: the pictures of an animation, several frames at a time."""

from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
import torch
from jaxtyping import Float, UInt8

from meshanim.errors import OptionError, ShapeError
from meshanim.heads import DefaultHead
from meshanim.motion import MeshSequence
from meshanim.motion.blendshape_solver import BlendshapeSolver
from meshanim.render.camera import Camera
from meshanim.render.lighting import Quality
from meshanim.render.look import Appearance
from meshanim.render.renderer import Renderer

__all__ = ["render_sequence"]

BATCH = 32


def render_sequence(
    sequence: MeshSequence,
    head: DefaultHead,
    appearance: Appearance,
    width: int = 512,
    height: int = 512,
    quality: str | Quality = "full",
    *,
    camera: Camera | None = None,
    expression: Float[np.ndarray, "frames expressions"] | None = None,
    wrinkles: bool = True,
    workers: int = 2,
) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """Draw an animation frame by frame, in order, head pose included.

    Parameters
    ----------
    sequence : MeshSequence
        On the topology of `head`, in the zero pose, with its head rotations.
    head : DefaultHead
    appearance : Appearance
        Of the person whose template the sequence animates.
    width, height : int
        Pixels; ignored where a camera is given.
    quality : str or Quality
        "draft" or "full".
    camera : Camera, optional
        Frames the resting head, if not given; it stands still.
    expression : (T, E) float, optional
        Weights that drive the wrinkles; found from the vertices if not given.
    wrinkles : bool
        False draws resting wrinkles only.
    workers : int
        Frames drawn at the same time, one thread each. Memory does not grow with the sequence.

    Yields
    ------
    (H, W, 3) uint8, sRGB.

    Raises
    ------
    ShapeError
        If the sequence or the weights do not fit the head.
    """
    if sequence.mesh.n_vertices != head.mesh.n_vertices:
        raise ShapeError(
            f"the sequence has {sequence.mesh.n_vertices} vertices, the head {head.mesh.n_vertices}"
        )
    if expression is not None and expression.shape != (len(sequence), len(head.expression_names)):
        raise ShapeError(
            f"expression must be ({len(sequence)}, {len(head.expression_names)}), not {expression.shape}"
        )
    if workers < 1:
        raise OptionError(f"workers must be at least 1, not {workers}")
    first = Renderer(head, appearance, width, height, quality, camera=camera, threads=1)
    return _draw(sequence, head, first, expression if wrinkles else None, wrinkles, workers)


def _draw(sequence, head, first: Renderer, expression, wrinkles: bool, workers: int) -> Iterator[np.ndarray]:
    renderers = [first, *(first.worker() for _ in range(workers - 1))]
    appearance = first.scene.appearance
    solve = None
    if wrinkles and expression is None:
        solve = BlendshapeSolver.from_head(head, neutral=appearance.template)
    shape = torch.from_numpy(appearance.shape)[None]
    waiting: deque[Future] = deque()
    with ThreadPoolExecutor(workers) as pool:
        try:
            for start in range(0, len(sequence), BATCH):
                vertices = np.ascontiguousarray(sequence.vertices[start : start + BATCH], np.float32)
                weights = None
                if expression is not None:
                    weights = np.ascontiguousarray(expression[start : start + BATCH], np.float32)
                elif solve is not None:
                    weights = solve(vertices).astype(np.float32)
                posed = _posed(head, vertices, sequence.pose[start : start + BATCH], shape)
                for index in range(len(vertices)):
                    # A renderer is free once the frame that it drew `workers` frames ago has been taken.
                    if len(waiting) == workers:
                        yield waiting.popleft().result()
                    renderer = renderers[(start + index) % workers]
                    weight = None if weights is None else weights[index]
                    waiting.append(pool.submit(renderer.frame, posed[index], weight))
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


def _posed(head: DefaultHead, vertices: np.ndarray, pose: np.ndarray, shape: torch.Tensor) -> np.ndarray:
    with torch.no_grad():
        rotation = torch.from_numpy(np.ascontiguousarray(pose, np.float32))
        return head.pose(torch.from_numpy(vertices), rotation, shape).numpy()
