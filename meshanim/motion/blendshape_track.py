"""`BlendshapeTrack`: blendshape weights over time, and the files they travel in."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float32

from meshanim.errors import FileFormatError, OptionError, ShapeError
from meshanim.files import read_npz, written_whole
from meshanim.heads import Head
from meshanim.motion.blendshape_csv import (
    CsvForm,
    read_weight_csv,
    shape_key,
    write_audio2face_csv,
    write_live_link_csv,
)
from meshanim.motion.sequence import MeshSequence

__all__ = ["BlendshapeTrack"]


@dataclass(frozen=True)
class BlendshapeTrack:
    """Weights of named shapes, a row a frame.

    Parameters
    ----------
    names : (E,) str
        Shapes, each once.
    weights : (T, E) float
    fps : float
        Frames a second.
    pose : (T, 3) float32, optional
        Head rotation a frame, as in `MeshSequence`; zeros if not given.
    """

    names: tuple[str, ...]
    weights: Float[np.ndarray, "frames shapes"]
    fps: float
    pose: Float[np.ndarray, "frames 3"] = None  # type: ignore[assignment]  # set below

    def __post_init__(self):
        if self.weights.ndim != 2 or self.weights.shape[1] != len(self.names):
            raise ShapeError(f"{len(self.names)} names need weights (frames, {len(self.names)})")
        if len(set(self.names)) != len(self.names):
            raise OptionError("a track names a shape twice")
        if not np.isfinite(self.weights).all():
            raise ShapeError("the weights hold NaN or infinite numbers")
        if not self.fps > 0:
            raise OptionError(f"fps must be positive, not {self.fps}")
        if self.pose is None:
            object.__setattr__(self, "pose", np.zeros((len(self.weights), 3), np.float32))
        elif self.pose.shape != (len(self.weights), 3):
            raise ShapeError(f"pose must have shape ({len(self.weights)}, 3), not {self.pose.shape}")

    def __len__(self) -> int:
        return len(self.weights)

    def on(self, head: Head) -> Float32[np.ndarray, "frames expression"]:
        """The weights of all of a head's expressions: zero where the track has none of that name.

        Raises
        ------
        OptionError
            If the head lacks one of the shapes and a weight of it is not zero.
        """
        given = {shape_key(name): column for name, column in zip(self.names, self.weights.T)}
        own = {shape_key(name) for name in head.expression_names}
        lost = [
            name
            for name, column in zip(self.names, self.weights.T)
            if shape_key(name) not in own and column.any()
        ]
        if lost:
            raise OptionError(f"the head has no shape named {', '.join(lost)}")
        full = np.zeros((len(self), len(head.expression_names)), np.float32)
        for row, name in enumerate(head.expression_names):
            if shape_key(name) in given:
                full[:, row] = given[shape_key(name)]
        return full

    def animate(self, head: Head, neutral: Float[np.ndarray, "vertices 3"] | None = None) -> MeshSequence:
        """The motion that the weights make of a head's expressions.

        Parameters
        ----------
        head : Head
            Has shapes with the track's names (the first letter's case may differ); its other shapes stay
            at zero.
        neutral : (V, 3), optional
            Whose face moves, metres; the head's template if not given.

        Raises
        ------
        OptionError
            If the head lacks one of the shapes and a weight of it is not zero.
        """
        full = self.on(head)
        mesh = head.mesh if neutral is None else head.mesh.with_vertices(neutral)
        with torch.no_grad():
            directions = head.expression_directions.cpu()
            moved = (torch.from_numpy(full) @ directions).unflatten(1, (-1, 3)).numpy()
        return MeshSequence(moved + mesh.vertices.astype(np.float32), self.fps, mesh, self.pose)

    def save(self, path: str | Path, csv: CsvForm = "audio2face") -> None:
        """Write by the ending: .npz (names, weights, fps, pose), or .csv.

        Parameters
        ----------
        path : str or Path
            `meshanim.export.write_track` writes USD and glTF.
        csv : CsvForm
            Columns of a CSV: "audio2face", `write_audio2face_csv`, without head pose; "livelink",
            `write_live_link_csv`, with it.

        Raises
        ------
        OptionError
            If the path ends otherwise, or Live Link Face has no column for a shape that moves.
        """
        path = Path(path)
        if path.suffix.lower() == ".csv":
            if csv == "livelink":
                write_live_link_csv(path, self.names, self.weights, self.fps, self.pose)
            else:
                write_audio2face_csv(path, self.names, self.weights, self.fps)
        elif path.suffix.lower() == ".npz":
            names = np.array(self.names)
            with written_whole(path) as temporary, open(temporary, "wb") as file:
                np.savez(file, names=names, weights=self.weights, fps=np.float64(self.fps), pose=self.pose)
        else:
            raise OptionError(f"weights are saved as .npz or .csv, not {path}")

    @classmethod
    def load(cls, path: str | Path) -> "BlendshapeTrack":
        """Read what `save` wrote, Audio2Face-3D's own CSV, or a recording of Live Link Face.

        Raises
        ------
        FileFormatError
            If the file is missing, damaged or of another kind (`read_weight_csv`).
        """
        path = Path(path)
        return cls(*read_weight_csv(path)) if path.suffix.lower() == ".csv" else _read_npz(path)


def _read_npz(path: Path) -> BlendshapeTrack:
    arrays = read_npz(path)
    missing = [name for name in ("names", "weights", "fps", "pose") if name not in arrays]
    if missing:
        raise FileFormatError(f"{path} holds no blendshape weights: it lacks {', '.join(missing)}")
    names = tuple(str(name) for name in arrays["names"])
    return BlendshapeTrack(names, arrays["weights"], float(arrays["fps"]), arrays["pose"])
