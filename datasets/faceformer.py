"""The folder layout of FaceFormer, CodeTalker and their successors.

    DIR/wav/SUBJECT_sentence01.wav
    DIR/vertices_npy/SUBJECT_sentence01.npy     (T, V * 3)
    DIR/templates.pkl                           {SUBJECT: (V, 3)}

The subject is the name up to the last underscore, the sentence the last two digits. FaceFormer's own loader
for VOCASET takes every second frame of files at 60 frames a second.
"""

import pickle
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from meshanim.audio import load_waveform, save_waveform
from meshanim.datasets.meshanim_format import MotionSequence, SequenceInfo, Subject
from meshanim.errors import FileFormatError, OptionError
from meshanim.files import written_whole
from meshanim.unpickle import load_pickle

__all__ = ["FaceFormerDataset", "write_faceformer_sequence", "write_faceformer_templates"]


def write_faceformer_sequence(directory: str | Path, sequence: MotionSequence) -> None:
    """Write the sound, then the vertices of one sequence; the layout has no pose and no curves."""
    directory = Path(directory)
    for folder in ("wav", "vertices_npy"):
        (directory / folder).mkdir(parents=True, exist_ok=True)
    name = sequence.info.name
    save_waveform(sequence.audio, directory / "wav" / f"{name}.wav")
    with (
        written_whole(directory / "vertices_npy" / f"{name}.npy") as temporary,
        open(temporary, "wb") as file,
    ):
        flat = np.ascontiguousarray(sequence.vertices, np.float32).reshape(len(sequence), -1)
        np.save(file, flat)


def write_faceformer_templates(directory: str | Path, subjects: Sequence[Subject]) -> None:
    """Write templates.pkl: a pickled dictionary of arrays, as the public loaders expect."""
    written = pickle.dumps({subject.name: subject.template for subject in subjects}, protocol=2)
    # The environments of the public loaders have NumPy 1, which knows its core by the old name only.
    written = written.replace(b"cnumpy._core.", b"cnumpy.core.")
    with written_whole(Path(directory) / "templates.pkl") as temporary:
        temporary.write_bytes(written)


class FaceFormerDataset:
    """Reads the layout above.

    Parameters
    ----------
    directory : path
        With wav/, vertices_npy/ and templates.pkl.
    fps : float
        Frames a second of the files.
    stride : int
        Take every `stride`-th frame, as FaceFormer does with VOCASET (60 frames a second, stride 2).
    scale : float
        Metres for one unit of the files.

    Attributes
    ----------
    templates : dict of (V, 3) arrays
        By subject, metres.
    sequences : tuple of str
        Names.

    Raises
    ------
    FileFormatError
        If a part is missing or damaged.
    """

    def __init__(self, directory: str | Path, fps: float = 30.0, stride: int = 1, scale: float = 1.0):
        if not fps > 0 or stride < 1 or not scale > 0:
            given = f"{fps}, {stride} and {scale}"
            raise OptionError(f"fps and scale must be positive and stride at least 1, not {given}")
        self.directory = Path(directory)
        self.fps = fps / stride
        self.stride = stride
        self.scale = scale
        self.templates = self._read_templates()
        folder = self.directory / "vertices_npy"
        self.sequences: tuple[str, ...] = tuple(
            sorted(path.stem for path in folder.glob("*.npy") if not path.name.startswith("."))
        )
        if not self.sequences:
            raise FileFormatError(f"{folder} holds no .npy files: not FaceFormer's layout")

    def _read_templates(self) -> dict[str, Float32[np.ndarray, "vertices 3"]]:
        path = self.directory / "templates.pkl"
        templates = load_pickle(path)
        if not isinstance(templates, dict) or not all(
            isinstance(value, np.ndarray) and value.ndim == 2 and value.shape[1] == 3
            for value in templates.values()
        ):
            raise FileFormatError(f"{path} holds no dictionary of (vertices, 3) arrays")
        return {name: np.asarray(value * self.scale, np.float32) for name, value in templates.items()}

    def __len__(self) -> int:
        return len(self.sequences)

    def __iter__(self) -> Iterator[MotionSequence]:
        return (self[name] for name in self.sequences)

    def __getitem__(self, key: int | str) -> MotionSequence:
        """One sequence; pose is zero and curves are empty, the layout has neither.

        Raises
        ------
        FileFormatError
            If a file is missing, cut short, of another width than the template, or not finite.
        """
        name = self.sequences[key] if isinstance(key, int) else key
        path = self.directory / "vertices_npy" / f"{name}.npy"
        try:
            flat = np.load(path, mmap_mode="r", allow_pickle=False)
        except OSError as error:
            raise FileFormatError(f"cannot read {path}: {error.strerror or error}") from error
        except (ValueError, EOFError) as error:
            raise FileFormatError(f"{path} is damaged or cut short: {error}") from error
        subject, _, sentence = name.rpartition("_")
        if subject not in self.templates:
            raise FileFormatError(f"{path}: templates.pkl has no subject {subject!r}")
        template = self.templates[subject]
        if flat.ndim != 2 or flat.shape[1] != template.size:
            raise FileFormatError(f"{path} has shape {flat.shape}, expected (frames, {template.size})")
        vertices = np.asarray(flat[:: self.stride], np.float32) * np.float32(self.scale)
        if not np.isfinite(vertices).all():
            raise FileFormatError(f"{path} holds values that are not finite")
        frames = len(vertices)
        digits = sentence[-2:]
        return MotionSequence(
            SequenceInfo(subject, int(digits) if digits.isdigit() else 0, "", self.fps, frames),
            vertices.reshape(frames, -1, 3),
            np.zeros((frames, 3), np.float32),
            np.zeros((frames, 0), np.float32),
            load_waveform(self.directory / "wav" / f"{name}.wav"),
        )
