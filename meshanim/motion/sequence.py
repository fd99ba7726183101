"""`MeshSequence`: an animated mesh with its frame rate, head pose and sound."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from meshanim.audio import Waveform
from meshanim.errors import FileFormatError, OptionError, ShapeError
from meshanim.files import read_npz, written_whole
from meshanim.geometry import TriangleMesh
from meshanim.heads import Head
from meshanim.motion.pose_track import resample_rotations

__all__ = ["MeshSequence"]


@dataclass(frozen=True)
class MeshSequence:
    """Vertices over time, without head pose, and the pose beside them.

    Parameters
    ----------
    vertices : (T, V, 3) float32
        Metres, in the zero pose: the head does not turn in them.
    fps : float
        Frames a second.
    mesh : TriangleMesh
        Topology, texture coordinates, and the template as rest geometry.
    pose : (T, 3) float32, optional
        Head rotation a frame, axis-angle in radians about the neck joint; zeros if not given.
    audio : Waveform, optional
        The speech that goes with it.
    """

    vertices: Float[np.ndarray, "frames vertices 3"]
    fps: float
    mesh: TriangleMesh
    pose: Float[np.ndarray, "frames 3"] = None  # type: ignore[assignment]  # set below
    audio: Waveform | None = None

    def __post_init__(self):
        if self.vertices.ndim != 3 or self.vertices.shape[1:] != (self.mesh.n_vertices, 3):
            raise ShapeError(
                f"vertices must have shape (frames, {self.mesh.n_vertices}, 3), not {self.vertices.shape}"
            )
        if not self.fps > 0:
            raise OptionError(f"fps must be positive, not {self.fps}")
        if self.pose is None:
            object.__setattr__(self, "pose", np.zeros((len(self.vertices), 3), np.float32))
        elif self.pose.shape != (len(self.vertices), 3):
            raise ShapeError(f"pose must have shape ({len(self.vertices)}, 3), not {self.pose.shape}")

    def __len__(self) -> int:
        return len(self.vertices)

    @property
    def duration(self) -> float:
        """Seconds."""
        return len(self.vertices) / self.fps

    def posed(
        self, head: Head, shape: Float[Tensor, "1 shape"] | None = None
    ) -> Float[np.ndarray, "frames vertices 3"]:
        """Vertices with the head turned about the neck joint, metres.

        Parameters
        ----------
        head : Head
            Whose topology this is.
        shape : (1, S), optional
            Identity, which places the neck joint.
        """
        parts = [
            head.pose(torch.from_numpy(self.vertices[at]), torch.from_numpy(self.pose[at]), shape).numpy()
            for start in range(0, len(self), 256)
            for at in [slice(start, start + 256)]
        ]
        return np.concatenate(parts) if parts else self.vertices

    def resampled(self, fps: float) -> "MeshSequence":
        """The same motion at another frame rate: vertices linearly, head rotations along the shortest turns.

        Frame i is at (i + 0.5) / fps seconds, before and after; the ends hold. As many frames as begin before
        the motion ends.

        Raises
        ------
        OptionError
            If `fps` is not positive and finite, or there is no frame.
        """
        if not (np.isfinite(fps) and fps > 0) or len(self) == 0:
            raise OptionError(f"cannot resample {len(self)} frames from {self.fps:g} to {fps:g} fps")
        if fps == self.fps:
            return self
        count = max(1, math.ceil(self.duration * fps - 1e-6))
        position = np.clip((np.arange(count) + 0.5) / fps * self.fps - 0.5, 0, len(self) - 1)
        lower = position.astype(np.int64)
        upper = np.minimum(lower + 1, len(self) - 1)
        weight = (position - lower).astype(np.float32)[:, None, None]
        vertices = self.vertices[lower] * (1 - weight) + self.vertices[upper] * weight
        pose = resample_rotations(self.pose, self.fps, fps, count)
        return MeshSequence(vertices, fps, self.mesh, pose, self.audio)

    def save(self, path: str | Path) -> None:
        """Write an npz with `vertices` (T, V, 3), `faces` (F, 3), `fps`, `pose` (T, 3), `template` (V, 3).

        Other formats, which need a head or a renderer, are written by `meshanim.export`.

        Raises
        ------
        OptionError
            If the path does not end in .npz.
        """
        if Path(path).suffix != ".npz":
            raise OptionError(f"a sequence saves as .npz, not {path}; meshanim.export writes other formats")
        with written_whole(path) as temporary, open(temporary, "wb") as file:
            np.savez(
                file,
                vertices=self.vertices,
                faces=self.mesh.faces.astype(np.int32),
                fps=np.float64(self.fps),
                pose=self.pose,
                template=self.mesh.vertices.astype(np.float32),
            )

    @classmethod
    def load(cls, path: str | Path) -> "MeshSequence":
        """Read what `save` wrote; FileFormatError if a key is missing or the file is damaged."""
        arrays = read_npz(path, ("vertices", "faces", "fps", "pose"))
        if not len(arrays["vertices"]):
            raise FileFormatError(f"{path} holds no frames")
        mesh = TriangleMesh(arrays.get("template", arrays["vertices"][0]), arrays["faces"])
        return cls(arrays["vertices"], float(arrays["fps"]), mesh, arrays["pose"])
