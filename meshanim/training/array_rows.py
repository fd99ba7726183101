"""Rows of arrays on disk, read when asked for: no memory and no open file between two reads."""

import mmap
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from meshanim.errors import FileFormatError

__all__ = ["ArrayRows", "rows_on_disk"]


@dataclass(frozen=True)
class ArrayRows:
    """The rows of an array in a file; a slice of it is an array.

    Thousands of memory maps would need as many open files. What is read again comes from the system's cache.

    Parameters
    ----------
    path : Path
        The file.
    dtype : np.dtype
        Of the numbers.
    shape : tuple of int
        Rows first; the array is contiguous, its last axis fastest.
    offset : int
        Bytes before the first row.
    """

    path: Path
    dtype: np.dtype
    shape: tuple[int, ...]
    offset: int

    @classmethod
    def open(cls, path: Path) -> "ArrayRows":
        """The array of a .npy file.

        Raises
        ------
        FileFormatError
            If it is missing, damaged or shorter than it says.
        """
        try:
            mapped = np.load(path, mmap_mode="r", allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise FileFormatError(f"{path} is damaged ({error}): delete it") from error
        if not isinstance(mapped, np.memmap) or not mapped.flags.c_contiguous:
            raise FileFormatError(f"{path} is damaged (no array in row order): delete it")
        return cls(path, mapped.dtype, mapped.shape, mapped.offset)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, rows: slice) -> np.ndarray:
        """The rows of a slice with a positive step, as a new array.

        Raises
        ------
        FileFormatError
            If the file is gone or has become shorter.
        """
        first, last, step = rows.indices(len(self))
        count = max(0, last - first)
        width = int(np.prod(self.shape[1:]))
        try:
            with open(self.path, "rb", buffering=0) as file:
                file.seek(self.offset + first * width * self.dtype.itemsize)
                values = np.fromfile(file, self.dtype, count * width)
        except OSError as error:
            raise FileFormatError(f"cannot read {self.path}: {error.strerror}") from error
        if len(values) != count * width:
            raise FileFormatError(f"{self.path} is cut short: expected {self.shape[0]} rows")
        return values.reshape(count, *self.shape[1:])[::step]


def rows_on_disk(array: np.ndarray) -> np.ndarray | ArrayRows:
    """The rows of a whole memory-mapped array without its open file; any other array as it is."""
    if not (isinstance(array, np.memmap) and isinstance(array.base, mmap.mmap)):
        return array
    if array.filename is None or not array.flags.c_contiguous:
        return array
    return ArrayRows(Path(array.filename), array.dtype, array.shape, array.offset)
