"""Vertex masks by name: regions of a head, and the published sets that users hold as files.

Published tables differ most by their masks, so a mask carries its name, its count and a fingerprint of its
vertices wherever a number goes. None of the published files ships with the library.
"""

import re
from dataclasses import dataclass
from functools import cached_property
from hashlib import blake2b
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int, Int64
from torch import Tensor

from meshanim.errors import FileFormatError, OptionError, ShapeError
from meshanim.heads import Head
from meshanim.unpickle import load_npy_objects, load_pickle

__all__ = ["PUBLISHED_MASKS", "Mask", "PublishedMask", "load_mask", "region_mask"]

EYE_REGIONS = ("eyelids", "eyes")


@dataclass(frozen=True, eq=False)
class Mask:
    """A named set of vertices.

    Parameters
    ----------
    name : str
        As tables print it.
    indices : (M,) int
        Vertices, each once.

    Raises
    ------
    ShapeError
        If it is empty, or names a vertex twice or below 0.
    """

    name: str
    indices: Int[np.ndarray, " mask"]

    def __post_init__(self):
        indices = np.asarray(self.indices, np.int64)
        if not len(indices):
            raise ShapeError(f"mask {self.name} names no vertices")
        if indices.min() < 0 or len(np.unique(indices)) < len(indices):
            raise ShapeError(f"mask {self.name} names a vertex twice or below 0")
        object.__setattr__(self, "indices", indices)

    def __len__(self) -> int:
        return len(self.indices)

    @cached_property
    def digest(self) -> str:
        """Eight letters that tell two sets of vertices apart, whatever their names and orders."""
        return blake2b(np.sort(self.indices).astype("<i8").tobytes(), digest_size=4).hexdigest()

    def tensor(self, device: torch.device | str = "cpu") -> Int64[Tensor, " mask"]:
        """The indices for the functions of `meshanim.training.metrics`."""
        return torch.from_numpy(self.indices).to(device)

    def fits(self, mesh_vertices: int) -> "Mask":
        """Itself, if a mesh has all its vertices; ShapeError otherwise."""
        if int(self.indices.max()) >= mesh_vertices:
            raise ShapeError(
                f"mask {self.name} names vertex {int(self.indices.max())}, the mesh has {mesh_vertices}:"
                " the mask of another topology?"
            )
        return self


@dataclass(frozen=True)
class PublishedMask:
    """What a published mask file has to hold.

    Parameters
    ----------
    count : int, optional
        Vertices; None where nobody states it.
    mesh_vertices : int
        Of the topology.
    keys : tuple of str
        Entries of FLAME_masks.pkl whose union it is; empty for a file that is the mask.
    threshold : float, optional
        The file has one weight a vertex; those above are the mask.
    source : str
        Whose file it is.
    """

    count: int | None
    mesh_vertices: int
    source: str
    keys: tuple[str, ...] = ()
    threshold: float | None = None


PUBLISHED_MASKS = {
    "biwi_lve": PublishedMask(4996, 23370, "CodeTalker BIWI/regions/lve.txt"),
    "biwi_fdd": PublishedMask(7784, 23370, "CodeTalker BIWI/regions/fdd.txt"),
    "vocaset_lve": PublishedMask(428, 5023, "FaceDiffuser, ProbTalk3D vocaset/regions/lve.txt"),
    "vocaset_fdd": PublishedMask(1501, 5023, "FaceDiffuser, ProbTalk3D vocaset/regions/fdd.txt"),
    "vocaset_neck": PublishedMask(368, 5023, "FaceDiffuser, ProbTalk3D vocaset/regions/neck.txt"),
    "flame_lips": PublishedMask(254, 5023, "SelfTalk, DiffSpeaker FLAME_masks.pkl", ("lips",)),
    "flame_upper_face": PublishedMask(
        827, 5023, "SelfTalk, DiffSpeaker FLAME_masks.pkl", ("forehead", "eye_region")
    ),
    "unitalker_mouth": PublishedMask(None, 5023, "UniTalker 02_flame_mouth_idx.npy"),
    "unitalker_fdd": PublishedMask(None, 5023, "UniTalker vocaset_FDD_wo_eyes.npy"),
    "multiface_lve": PublishedMask(1035, 6172, "FaceDiffuser multiface/regions/lve.txt"),
    "multiface_fdd": PublishedMask(1529, 6172, "FaceDiffuser multiface/regions/fdd.txt"),
    "meshtalk_mouth": PublishedMask(None, 6172, "MeshTalk weighted_mouth_mask.txt", threshold=0.1),
    "meshtalk_forehead": PublishedMask(None, 6172, "MeshTalk forehead_mask.txt", threshold=0.4),
}


def region_mask(head: Head, region: str) -> Mask | None:
    """A region of a head as a mask, None where the head has no such part.

    Parameters
    ----------
    head : Head
        Whose topology the meshes have.
    region : str
        One of the head's regions, or "eye_region": eyelids and eyes, which E_ve is measured on.

    Raises
    ------
    OptionError
        If there is no such region.
    """
    parts = EYE_REGIONS if region == "eye_region" else (region,)
    unknown = set(parts) - set(head.regions)
    if unknown:
        raise OptionError(f"no region {region!r}; there are eye_region, {', '.join(head.regions)}")
    indices = np.unique(np.concatenate([head.regions[part] for part in parts]))
    return Mask(region, indices) if len(indices) else None


def load_mask(specification: str, mesh_vertices: int | None = None) -> Mask:
    """Read a mask from a file, published ones checked against what is published.

    Parameters
    ----------
    specification : str
        NAME:PATH with a NAME of `PUBLISHED_MASKS`, or the PATH of any mask, which is then called by its stem.
        Files are text (integers divided by commas or white space; one weight a line where the published mask
        has a threshold), .npy of integers or booleans, or FLAME_masks.pkl.
    mesh_vertices : int, optional
        Of the mesh it is for.

    Raises
    ------
    OptionError
        If NAME is no published mask.
    FileFormatError
        If the file cannot be read, or its count is not the published one.
    ShapeError
        If the mask is empty or of another topology.
    """
    name, colon, rest = specification.partition(":")
    if not colon or Path(specification).exists():
        mask = Mask(Path(specification).stem, _indices(_content(Path(specification)), Path(specification)))
        return mask if mesh_vertices is None else mask.fits(mesh_vertices)
    if name not in PUBLISHED_MASKS:
        raise OptionError(f"no published mask {name!r}; there are {', '.join(PUBLISHED_MASKS)}")
    published, path = PUBLISHED_MASKS[name], Path(rest)
    content = _content(path)
    if published.keys:
        indices = _named(content, published.keys, path)
    elif published.threshold is not None:
        indices = _heavy(content, published, path)
    else:
        indices = _indices(content, path)
    if published.count is not None and len(indices) != published.count:
        raise FileFormatError(
            f"{path} names {len(indices)} vertices; {name} ({published.source}) has {published.count}"
        )
    if mesh_vertices is not None and mesh_vertices != published.mesh_vertices:
        raise ShapeError(
            f"mask {name} is of meshes of {published.mesh_vertices} vertices, these have {mesh_vertices}"
        )
    return Mask(name, indices).fits(published.mesh_vertices)


def _content(path: Path) -> object:
    """Numbers of a text file, the array of a .npy file, or the dictionary of a pickle."""
    if path.suffix in (".pkl", ".pickle"):
        return load_pickle(path)
    if path.suffix == ".npy":
        return load_npy_objects(path)
    try:
        words = re.split(r"[\s,\[\]]+", path.read_text(encoding="utf-8"))
        return np.array([float(word) for word in words if word])
    except (OSError, UnicodeError) as error:
        raise FileFormatError(f"cannot read mask {path}: {error}") from error
    except ValueError as error:
        raise FileFormatError(f"{path} is no list of vertices: {error}") from error


def _indices(content: object, path: Path) -> Int64[np.ndarray, " _"]:
    if not isinstance(content, np.ndarray) or content.ndim != 1 or content.dtype.kind not in "biuf":
        kind = f"shape {content.shape}" if isinstance(content, np.ndarray) else type(content).__name__
        raise FileFormatError(f"{path} holds {kind}; expected a list of vertices (NAME:PATH for others)")
    if content.dtype.kind == "b":
        return np.flatnonzero(content)
    if not np.isfinite(content).all() or (content != np.floor(content)).any():
        raise FileFormatError(
            f"{path} holds {content[content != np.floor(content)][0]}, which is no vertex: weights?"
            " give it as NAME:PATH of a published mask with a threshold"
        )
    return np.unique(content.astype(np.int64))


def _named(content: object, keys: tuple[str, ...], path: Path) -> Int64[np.ndarray, " _"]:
    if not isinstance(content, dict) or not set(keys) <= set(content):
        raise FileFormatError(f"{path} lacks {', '.join(keys)}: not FLAME_masks.pkl")
    return np.unique(np.concatenate([np.asarray(content[key], np.int64) for key in keys]))


def _heavy(content: object, published: PublishedMask, path: Path) -> Int64[np.ndarray, " _"]:
    if not isinstance(content, np.ndarray) or content.shape != (published.mesh_vertices,):
        shape = content.shape if isinstance(content, np.ndarray) else type(content).__name__
        raise FileFormatError(f"{path} holds {shape}, expected {published.mesh_vertices} weights")
    return np.flatnonzero(content > published.threshold)
