"""Animated points from other programs: Maya caches (.xml with .mc), .pc2 and .npy.

A Maya cache is an IFF file, big-endian: group FOR4/CACH with the version and the range of times, then a group
FOR4/MYCH a frame with TIME (6000 ticks a second), and for every channel CHNM, SIZE and FVCA (float) or DVCA
(double) vectors. Chunks are padded to four bytes. "One file per frame" caches have a file a frame.
"""

import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
from jaxtyping import Float32

from meshanim.datasets.mesh_files import read_npy
from meshanim.errors import FileFormatError

__all__ = ["TICKS", "find_cache", "read_maya_cache", "read_pc2", "read_points"]

TICKS = 6000
"""Maya's units of time a second."""
PC2_HEADER = struct.Struct("<12siiffi")
Points = Float32[np.ndarray, "frames points 3"]


def find_cache(folder: Path, shot: str) -> Path:
    """The cache of a shot: FOLDER/SHOT/SHOT.xml, .mc, .pc2 or .npy, or one of them in FOLDER itself.

    Raises
    ------
    FileFormatError
        If there is none.
    """
    for place in (folder / shot, folder):
        for suffix in (".mc", ".xml", ".pc2", ".npy"):
            if (place / f"{shot}{suffix}").is_file():
                return place / f"{shot}{suffix}"
    raise FileFormatError(
        f"{folder} has no cache of {shot}; expected {shot}/{shot}.xml and .mc, .pc2 or .npy"
    )


def read_points(path: Path) -> np.ndarray:
    """Points (T, V, 3) of a cache of any of these kinds; .pc2 and .npy memory-mapped.

    Raises
    ------
    FileFormatError
        If it is missing, damaged, cut short or of another kind.
    """
    match path.suffix.lower():
        case ".xml" | ".mc":
            return read_maya_cache(path)
        case ".pc2":
            return read_pc2(path)
        case ".npy":
            array = read_npy(path)
            if array.ndim != 3 or array.shape[2] != 3 or not len(array):
                raise FileFormatError(f"{path} has shape {array.shape}, expected (frames, points, 3)")
            return array
    raise FileFormatError(f"{path} is no point cache; expected .xml, .mc, .pc2 or .npy")


def read_pc2(path: Path) -> np.ndarray:
    """Points (T, V, 3) of a PC2 file: a header of 32 bytes, then little-endian floats.

    Raises
    ------
    FileFormatError
        If it is missing, of another kind or cut short.
    """
    try:
        with open(path, "rb") as file:
            header = file.read(PC2_HEADER.size)
        if len(header) < PC2_HEADER.size:
            raise FileFormatError(f"{path} is cut short in its header")
        magic, version, points, _, _, frames = PC2_HEADER.unpack(header)
        if magic != b"POINTCACHE2\0" or version != 1 or points < 1 or frames < 1:
            raise FileFormatError(
                f"{path} is no PC2 file of version 1 with points: it begins with {magic!r}, version "
                f"{version}, {points} points, {frames} frames"
            )
        expected = PC2_HEADER.size + 12 * points * frames
        if path.stat().st_size < expected:
            raise FileFormatError(f"{path} has {path.stat().st_size} bytes, its header says {expected}")
        return np.memmap(path, "<f4", "r", PC2_HEADER.size, (frames, points, 3))
    except OSError as error:
        raise FileFormatError(f"cannot read {path}: {error.strerror}") from error


def read_maya_cache(path: Path, channel: str | None = None) -> Points:
    """Points (T, V, 3) of a Maya cache, in the order of their times.

    Parameters
    ----------
    path : Path
        The .xml beside it or the .mc file; of a cache with a file a frame the .xml.
    channel : str, optional
        Which channel of several; the first with vectors if not given.

    Raises
    ------
    FileFormatError
        If a file is missing, damaged, cut short, a 64-bit cache (.mcx), or without the channel.
    """
    single = path.with_suffix(".mc")
    if single.is_file():
        files = [single]
    else:
        numbered = {}
        for file in path.parent.glob(f"{path.stem}Frame*.mc"):
            digits = re.fullmatch(rf"{re.escape(path.stem)}Frame(\d+)(?:Tick(\d+))?", file.stem)
            if digits:
                numbered[int(digits[1]), int(digits[2] or 0)] = file
        files = [numbered[key] for key in sorted(numbered)]
    if not files:
        raise FileFormatError(f"{path} has no {single.name} beside it, nor {path.stem}Frame1.mc and so on")
    frames: list[tuple[int, int, np.ndarray]] = []
    for number, file in enumerate(files):
        try:
            with open(file, "rb") as stream:
                for time, name, values in _samples(stream, file):
                    if channel is None or name == channel:
                        channel = name
                        frames.append((number, time, values))
        except OSError as error:
            raise FileFormatError(f"cannot read {file}: {error.strerror}") from error
    if not frames:
        raise FileFormatError(f"{path} has no vectors of {channel or 'any channel'}")
    frames.sort(key=lambda frame: frame[:2])
    counts = {len(values) for *_, values in frames}
    if len(counts) > 1:
        raise FileFormatError(f"{path} has frames of {min(counts)} and of {max(counts)} points")
    return np.stack([values for *_, values in frames])


def _samples(stream: BinaryIO, path: Path) -> Iterator[tuple[int, str, Float32[np.ndarray, "points 3"]]]:
    """Time in ticks, channel and vectors of each sample of a file."""
    size = path.stat().st_size
    tag, length = _header(stream, path)
    if tag == b"FOR8":
        raise FileFormatError(f"{path} is a 64-bit cache (.mcx): export it as mcc")
    if tag != b"FOR4" or stream.read(4) != b"CACH":
        raise FileFormatError(f"{path} is no Maya cache: it does not begin with FOR4 CACH")
    stream.seek(_padded(8 + length))
    while stream.tell() < size:
        tag, length = _header(stream, path)
        end = stream.tell() + length
        if tag != b"FOR4" or end > size or stream.read(4) != b"MYCH":
            raise FileFormatError(f"{path} is damaged or cut short at byte {stream.tell()}")
        time, name, count = 0, "", 0
        while stream.tell() < end:
            tag, length = _header(stream, path)
            content = stream.read(length)
            if len(content) < length:
                raise FileFormatError(f"{path} is cut short in chunk {tag!r}")
            stream.seek(_padded(length) - length, 1)
            if tag == b"TIME":
                time = struct.unpack(">i", content)[0]
            elif tag == b"CHNM":
                name = content.rstrip(b"\0").decode("latin-1")
            elif tag == b"SIZE":
                count = struct.unpack(">i", content)[0]
            elif tag in (b"FVCA", b"DVCA"):
                values = np.frombuffer(content, ">f4" if tag == b"FVCA" else ">f8")
                if len(values) != 3 * count or count < 1:
                    raise FileFormatError(f"{path}: {name} has {len(values)} numbers, expected 3 x {count}")
                yield time, name, values.reshape(count, 3).astype(np.float32)
        stream.seek(_padded(end))


def _header(stream: BinaryIO, path: Path) -> tuple[bytes, int]:
    header = stream.read(8)
    if len(header) < 8:
        raise FileFormatError(f"{path} is cut short at byte {stream.tell()}")
    return header[:4], struct.unpack(">I", header[4:])[0]


def _padded(length: int) -> int:
    return -(-length // 4) * 4
