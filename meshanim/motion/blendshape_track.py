"""`BlendshapeTrack`: blendshape weights over time, and the files they travel in."""

import csv
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from meshanim.errors import FileFormatError, OptionError, ShapeError
from meshanim.files import written_whole
from meshanim.heads import Head
from meshanim.motion.sequence import MeshSequence

__all__ = ["BlendshapeTrack"]

TIME, PREFIX = "timeCode", "blendShapes."


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
        rows = {_key(name): row for row, name in enumerate(head.expression_names)}
        lost = [
            name
            for name, column in zip(self.names, self.weights.T)
            if _key(name) not in rows and column.any()
        ]
        if lost:
            raise OptionError(f"the head has no shape named {', '.join(lost)}")
        found = [(rows[_key(name)], at) for at, name in enumerate(self.names) if _key(name) in rows]
        full = np.zeros((len(self), len(head.expression_names)), np.float32)
        for row, at in found:
            full[:, row] = self.weights[:, at]
        mesh = head.mesh if neutral is None else head.mesh.with_vertices(neutral)
        with torch.no_grad():
            directions = head.expression_directions.cpu()
            moved = (torch.from_numpy(full) @ directions).unflatten(1, (-1, 3)).numpy()
        return MeshSequence(moved + mesh.vertices.astype(np.float32), self.fps, mesh, self.pose)

    def save(self, path: str | Path) -> None:
        """Write by the ending: .npz (names, weights, fps, pose), or .csv.

        The columns of the CSV are those of Audio2Face-3D's animation_frames.csv: timeCode in seconds, then
        blendShapes.JawOpen and so on, ARKit's names with a capital. It holds no head pose.

        Raises
        ------
        OptionError
            If the path ends otherwise.
        """
        path = Path(path)
        if path.suffix.lower() not in (".npz", ".csv"):
            raise OptionError(f"weights are saved as .npz or .csv, not {path}")
        with written_whole(path) as temporary:
            if path.suffix.lower() == ".npz":
                with open(temporary, "wb") as file:
                    np.savez(
                        file,
                        names=np.array(self.names),
                        weights=self.weights,
                        fps=np.float64(self.fps),
                        pose=self.pose,
                    )
                return
            with open(temporary, "w", newline="", encoding="utf-8") as text:
                writer = csv.writer(text)
                writer.writerow([TIME, *(f"{PREFIX}{name[:1].upper()}{name[1:]}" for name in self.names)])
                for frame, row in enumerate(self.weights):
                    writer.writerow([f"{frame / self.fps:.9g}", *(f"{weight:.9g}" for weight in row)])

    @classmethod
    def load(cls, path: str | Path) -> "BlendshapeTrack":
        """Read what `save` wrote, or Audio2Face-3D's own CSV.

        Names of a CSV get a small first letter, as ARKit writes them; its frame rate is that of the time
        codes, 30 if there is only one frame.

        Raises
        ------
        FileFormatError
            If the file is missing, damaged or of another kind.
        """
        path = Path(path)
        return _read_csv(path) if path.suffix.lower() == ".csv" else _read_npz(path)


def _key(name: str) -> str:
    return name[:1].lower() + name[1:]


def _read_npz(path: Path) -> BlendshapeTrack:
    try:
        with np.load(path, allow_pickle=False) as archive:
            names = tuple(str(name) for name in archive["names"])
            weights, fps, pose = archive["weights"], float(archive["fps"]), archive["pose"]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise FileFormatError(f"{path} holds no blendshape weights: {error}") from error
    return BlendshapeTrack(names, weights, fps, pose)


def _read_csv(path: Path) -> BlendshapeTrack:
    try:
        with open(path, newline="", encoding="utf-8-sig") as text:
            rows = list(csv.reader(text))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FileFormatError(f"cannot read {path}: {error}") from error
    header = rows[0] if rows else []
    columns = [at for at, name in enumerate(header) if name.startswith(PREFIX)]
    if TIME not in header or not columns or len(rows) < 2:
        raise FileFormatError(f"{path} has no columns {TIME} and {PREFIX}... with rows below")
    try:
        values = np.array([[float(cell) for cell in row] for row in rows[1:]])
        times = values[:, header.index(TIME)]
        weights = values[:, columns]
    except (ValueError, IndexError) as error:
        raise FileFormatError(f"{path} has a cell that is no number, or a row that is cut short") from error
    step = (times[-1] - times[0]) / (len(times) - 1) if len(times) > 1 else 1 / 30
    if not (np.isfinite(values).all() and step > 0):
        raise FileFormatError(f"{path}: times do not rise, or a number is not finite")
    names = tuple(_key(header[at].removeprefix(PREFIX)) for at in columns)
    if len(set(names)) != len(names):
        raise FileFormatError(f"{path} names a shape twice")
    return BlendshapeTrack(names, weights, round(float(1 / step), 6))
