"""Output files are written whole: to a temporary file beside the target, then renamed."""

import json
import os
import tempfile
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from meshanim.errors import FileFormatError

__all__ = ["check_writable", "read_json", "read_npz", "written_whole"]


@contextmanager
def written_whole(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; rename it onto `path` at the end, delete it on an exception.

    Parameters
    ----------
    path : str or Path
        The file to be written. The temporary file keeps its suffix, so that writers which choose a format
        by the ending still do.

    Raises
    ------
    FileFormatError
        If the folder does not exist or cannot be written to.
    """
    path = Path(path)
    temporary = _temporary_beside(path)
    try:
        yield temporary
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o666 & ~mask)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def check_writable(path: str | Path) -> None:
    """Find out before long work whether `path` can be written.

    Raises
    ------
    FileFormatError
        If the folder does not exist or cannot be written to, or `path` is a folder.
    """
    _temporary_beside(Path(path)).unlink()


def read_json(path: str | Path) -> Any:
    """What a JSON file holds.

    Raises
    ------
    FileFormatError
        If the file is missing, cut short or no JSON.
    """
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise FileFormatError(f"cannot read {path}: {error.strerror or error}") from error
    except ValueError as error:
        raise FileFormatError(f"cannot read {path}: {error}") from error


def read_npz(path: str | Path, needed: Sequence[str] = ()) -> dict[str, np.ndarray]:
    """The arrays of an .npz by name; nothing is unpickled.

    Parameters
    ----------
    path : str or Path
    needed : sequence of str
        Names that must be there.

    Raises
    ------
    FileFormatError
        If the file is missing, cut short, no .npz, holds objects, or lacks what is needed.
    """
    if not Path(path).exists():
        raise FileFormatError(f"cannot read {path}: there is no such file")
    if not zipfile.is_zipfile(path):
        raise FileFormatError(f"cannot read {path}: it is no .npz, or cut short")
    arrays = _arrays(path)
    missing = [name for name in needed if name not in arrays]
    if missing:
        held = ", ".join(sorted(arrays)[:8]) or "nothing"
        raise FileFormatError(f"{path} lacks {', '.join(missing)}; it holds {held}")
    return arrays


def _arrays(path: str | Path) -> dict[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (
        OSError,
        ValueError,
        EOFError,
        AttributeError,
        TypeError,
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        raise FileFormatError(f"cannot read {path}: {error}") from error


def _temporary_beside(path: Path) -> Path:
    if path.is_dir():
        raise FileFormatError(f"cannot write {path}: it is a folder")
    try:
        handle, name = tempfile.mkstemp(prefix=f".{path.stem}-", suffix=path.suffix, dir=path.parent)
    except OSError as error:
        raise FileFormatError(f"cannot write {path}: {error.strerror}") from error
    os.close(handle)
    return Path(name)
