"""What every capture of a head is: pictures with cameras and masks, and the head's parameters by timestep.

`open_capture` tells the layout of a folder by its files. A reader of a layout is a function in a file of its
own, named in `READERS`.
"""

import importlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float32, Int, UInt8
from PIL import Image
from torch import Tensor
from tqdm import tqdm

from meshanim.audio import load_waveform
from meshanim.errors import FileFormatError, OptionError, ShapeError
from meshanim.geometry import TriangleMesh
from meshanim.heads import Head, HeadParameters, HeadSurface, load_head

__all__ = [
    "READERS",
    "REGIONS",
    "Capture",
    "Picture",
    "View",
    "detect_capture",
    "open_capture",
]

READERS = {
    "folder": ("capture_folder", "cameras.json and images/"),
    "vhap": ("vhap", "transforms_train.json or transforms.json"),
    "nersemble": ("nersemble", "calibration/camera_params.json and sequences/"),
}
"""Kinds of captures in the order in which they are tried: the reader's module, and what its folders hold."""

REGIONS = ("background", "neck", "hair", "skin", "lips", "mouth", "eyes")
"""What the numbers of our region maps mean; `mouth` is what lies behind the lips."""


@dataclass(frozen=True)
class View:
    """One picture that was, or is to be, taken.

    Parameters
    ----------
    name : str
        Of the picture, unique in its capture.
    timestep : int
        Row of the capture's parameters.
    camera : str
        Name of the camera.
    world_to_camera : (4, 4) float64
        Rigid, metres, OpenCV axes (x right, y down, z forward).
    intrinsics : (3, 3) float64
        Pixels, pixel centres at half integers.
    width, height : int
        Pixels.
    """

    name: str
    timestep: int
    camera: str
    world_to_camera: Float[np.ndarray, "4 4"]
    intrinsics: Float[np.ndarray, "3 3"]
    width: int
    height: int

    def scaled(self, scale: float) -> "View":
        """The same view with `scale` times as many pixels a side."""
        width, height = (max(1, round(size * scale)) for size in (self.width, self.height))
        factors = np.diag([width / self.width, height / self.height, 1.0])
        return replace(self, intrinsics=factors @ self.intrinsics, width=width, height=height)


@dataclass(frozen=True)
class Picture:
    """What a camera saw.

    Parameters
    ----------
    image : (H, W, 3) uint8
        sRGB.
    mask : (H, W) uint8, optional
        255 where the head is, 0 where it is not, shares between.
    regions : (H, W) uint8, optional
        Index into the capture's `region_names`.
    """

    image: UInt8[np.ndarray, "height width 3"]
    mask: UInt8[np.ndarray, "height width"] | None = None
    regions: UInt8[np.ndarray, "height width"] | None = None

    def scaled(self, width: int, height: int) -> "Picture":
        """Reduced: colours and mask averaged over each new pixel's area, regions by its centre."""
        size = (width, height)
        if self.image.shape[1::-1] == size:
            return self
        image = np.stack([_averaged(self.image[..., channel], size) for channel in range(3)], axis=2)
        mask = None if self.mask is None else _averaged(self.mask, size)
        regions = None
        if self.regions is not None:
            regions = np.array(Image.fromarray(self.regions).resize(size, Image.Resampling.NEAREST))
        return Picture(image, mask, regions)


def _averaged(plane: UInt8[np.ndarray, "height width"], size: tuple[int, int]) -> np.ndarray:
    """In floating point: 8-bit filters round twice, and up."""
    reduced = Image.fromarray(plane.astype(np.float32)).resize(size, Image.Resampling.BOX)
    return np.rint(np.asarray(reduced)).astype(np.uint8)


@dataclass(frozen=True)
class Capture:
    """Pictures of one head from known cameras, read when they are asked for.

    Parameters
    ----------
    name, kind : str
        Of the folder; its layout, a key of `READERS`.
    directory : Path
        Where it is.
    views : tuple of View
        In the order of timestep and camera.
    splits : mapping of str to tuple of int
        Positions in `views` by split, under their published names.
    read : callable
        The picture of a view, by its name, as large as its file; FileFormatError where there is none.
    parameters : HeadParameters, optional
        A row a timestep (or one row for all); None where nobody tracked the head.
    timesteps : tuple of str
        Names of the rows.
    head_name : str
        What `meshanim.heads.load_head` understands, or "".
    static_offset : (V, 3) float32, optional
        Metres, added to the head's template: what identity coefficients do not hold (VHAP).
    surface : HeadSurface, optional
        The triangles that the pictures show, where they are not the head's own.
    region_names : tuple of str
        What the numbers of the region maps mean; empty where there are none.
    background : (3,) float, optional
        Colour around the head, sRGB in [0, 1], where it is plain.
    scale : float
        Pixels a side, as a share of the files'.
    fps : float, optional
        Timesteps a second, where they follow each other as in a video.
    rest : mapping of str to float
        Weights of the head's expressions with which the face rests, where zero is not its rest.
    speech : mapping of int to Path
        Sound files by the timestep that they begin with; timestep t of one that begins with s lasts from
        (t - s) / fps to (t - s + 1) / fps seconds.
    """

    name: str
    kind: str
    directory: Path
    views: tuple[View, ...]
    splits: Mapping[str, tuple[int, ...]]
    read: Callable[[str], Picture] = field(repr=False)
    parameters: HeadParameters | None = field(default=None, repr=False)
    timesteps: tuple[str, ...] = field(default=(), repr=False)
    head_name: str = ""
    static_offset: Float32[np.ndarray, "vertices 3"] | None = field(default=None, repr=False)
    surface: HeadSurface | None = field(default=None, repr=False)
    region_names: tuple[str, ...] = ()
    background: tuple[float, float, float] | None = None
    scale: float = 1.0
    fps: float | None = None
    rest: Mapping[str, float] = field(default_factory=dict, repr=False)
    speech: Mapping[int, Path] = field(default_factory=dict, repr=False)

    def __len__(self) -> int:
        return len(self.views)

    def __getitem__(self, index: int) -> Picture:
        """The picture of `views[index]`.

        Raises
        ------
        FileFormatError
            If its file is missing, damaged, or of another size than its camera.
        """
        view = self.views[index]
        return self.read(view.name).scaled(view.width, view.height)

    def __iter__(self) -> Iterator[Picture]:
        return (self[index] for index in range(len(self)))

    def split(self, name: str) -> tuple[int, ...]:
        """Positions in `views` of a split.

        Raises
        ------
        OptionError
            If there is no such split; the message lists those there are.
        """
        if name not in self.splits:
            raise OptionError(f"{self.directory} has no split {name!r}; there are {', '.join(self.splits)}")
        return self.splits[name]

    def cameras(
        self, indices: Iterable[int] | None = None
    ) -> tuple[Float[np.ndarray, "views 4 4"], Float[np.ndarray, "views 3 3"], int, int]:
        """`world_to_camera`, `intrinsics`, width and height of some views (all of them if not given).

        Raises
        ------
        ShapeError
            If their pictures differ in size.
        """
        views = self.views if indices is None else [self.views[index] for index in indices]
        sizes = sorted({(view.width, view.height) for view in views})
        if len(sizes) != 1:
            raise ShapeError(f"the pictures of {self.directory} have {len(sizes)} sizes: {sizes}")
        poses, intrinsics = ([getattr(v, key) for v in views] for key in ("world_to_camera", "intrinsics"))
        return np.stack(poses), np.stack(intrinsics), *sizes[0]

    @cached_property
    def head(self) -> Head:
        """The head that the parameters are of, with the person's own offsets.

        Raises
        ------
        OptionError
            If the layout does not say which; open it with `head=`.
        """
        if not self.head_name:
            raise OptionError(
                f"{self.directory} does not say which head its parameters are of: give one, such as "
                "flame+teeth:flame2023.pkl"
            )
        head = load_head(self.head_name)
        if self.static_offset is None:
            return head
        try:
            return head.with_offset(torch.from_numpy(self.static_offset))
        except ShapeError as error:
            raise ShapeError(
                f"{self.directory} has offsets of {len(self.static_offset)} vertices, head {self.head_name} "
                f"has {head.n_vertices}"
            ) from error

    def at(self, timesteps: int | Sequence[int] | Int[np.ndarray, " timesteps"]) -> HeadParameters:
        """Head parameters of some timesteps.

        Raises
        ------
        OptionError
            If nobody tracked the head.
        """
        if self.parameters is None:
            raise OptionError(f"{self.directory} holds no parameters of a head")
        rows = torch.as_tensor(np.atleast_1d(np.asarray(timesteps, np.int64)))
        chosen = {}
        for entry in fields(self.parameters):
            value = getattr(self.parameters, entry.name)
            chosen[entry.name] = (
                value if value is None or len(value) == 1 < len(self.timesteps) else value[rows]
            )
        return HeadParameters(**chosen)

    @cached_property
    def carried(self) -> HeadSurface:
        """The triangles to bind to: `surface`, or else the head's own."""
        return self.surface if self.surface is not None else HeadSurface.of_mesh(self.head.mesh)

    @cached_property
    def mesh(self) -> TriangleMesh:
        """The triangles to bind to, with the person's face at rest."""
        identity = HeadParameters(shape=self.at(0).shape)
        with torch.no_grad():
            return TriangleMesh(self.carried(self.head(identity))[0].double().numpy(), self.carried.faces)

    def vertices(
        self, timesteps: int | Sequence[int] | Int[np.ndarray, " timesteps"]
    ) -> Float[Tensor, "*batch vertices 3"]:
        """Where `mesh` was at a timestep, (V, 3), or at several, (T, V, 3): metres."""
        with torch.no_grad():
            posed = self.carried(self.head(self.at(timesteps)))
        return posed[0] if np.ndim(timesteps) == 0 else posed

    def check(self, progress: bool = False) -> list[str]:
        """Read every picture and sound; every defect as one line, empty if all is well."""
        defects = []
        for path in self.speech.values():
            try:
                load_waveform(path, rate=None)
            except FileFormatError as error:
                defects.append(f"{path.name}: {error}")
        for index in tqdm(range(len(self)), "pictures", disable=not progress):
            try:
                self[index]
            except FileFormatError as error:
                defects.append(f"{self.views[index].name}: {error}")
        return defects


def read_image(path: Path, size: tuple[int, int]) -> UInt8[np.ndarray, "height width channels"]:
    """An image file as (H, W, 3) or, with its own opacity, (H, W, 4).

    Raises
    ------
    FileFormatError
        If it is missing, damaged, or not `size` (width, height).
    """
    image = _opened(path, size)
    transparent = image.mode in ("RGBA", "LA", "PA") or "transparency" in image.info
    return _decoded(path, image, "RGBA" if transparent else "RGB")


def read_plane(path: Path, size: tuple[int, int]) -> UInt8[np.ndarray, "height width"]:
    """A mask or region map; the first channel where there are several.

    Raises
    ------
    FileFormatError
        If it is missing, damaged, or not `size` (width, height).
    """
    image = _opened(path, size)
    if image.mode in ("L", "P"):  # a palette's colours are for looking at: its indices count
        return _decoded(path, image, image.mode)
    array = _decoded(path, image, "RGB")
    return np.ascontiguousarray(array[..., 0])


def _opened(path: Path, size: tuple[int, int]) -> Image.Image:
    try:
        image = Image.open(path)
    except (OSError, SyntaxError) as error:
        raise FileFormatError(f"cannot read {path}: {error}") from error
    if image.size != size:
        raise FileFormatError(
            f"{path} has {image.width} x {image.height} pixels, its camera {size[0]} x {size[1]}"
        )
    return image


def _decoded(path: Path, image: Image.Image, mode: str) -> np.ndarray:
    try:
        return np.array(image.convert(mode) if image.mode != mode else image)
    except (OSError, SyntaxError, ValueError) as error:
        raise FileFormatError(f"cannot read {path}: {error}") from error


def check_camera(where: str, world_to_camera: np.ndarray, intrinsics: np.ndarray) -> None:
    """FileFormatError, which starts with `where`, if the matrices are none of a camera."""
    if world_to_camera.shape != (4, 4) or intrinsics.shape != (3, 3):
        raise FileFormatError(
            f"{where} has matrices {world_to_camera.shape} and {intrinsics.shape}, expected (4, 4), (3, 3)"
        )
    if not (np.isfinite(world_to_camera).all() and np.isfinite(intrinsics).all()):
        raise FileFormatError(f"{where} has numbers that are not finite")
    rotation = world_to_camera[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
        raise FileFormatError(f"{where}: its pose is no rotation and translation")
    if not (intrinsics[0, 0] > 0 and intrinsics[1, 1] > 0 and np.allclose(intrinsics[2], (0, 0, 1))):
        raise FileFormatError(f"{where} has no intrinsics: {intrinsics.tolist()}")


def detect_capture(directory: str | Path) -> str | None:
    """The kind of capture that a folder holds, by its files; None where it is none."""
    directory = Path(directory)
    for kind, (module, _) in READERS.items():
        if importlib.import_module(f"meshanim.datasets.{module}").detect(directory):
            return kind
    return None


def open_capture(directory: str | Path, kind: str = "auto", *, head: str = "", scale: float = 1.0) -> Capture:
    """Open a capture of any known layout; pictures are read later.

    Parameters
    ----------
    directory : path
        The folder of one person.
    kind : str
        A key of `READERS`; auto tells the layout by the files that are there.
    head : str
        What `meshanim.heads.load_head` understands, where the layout does not say which head its parameters
        are of ("flame+teeth:flame2023.pkl"), or to use another than it says.
    scale : float
        Share of the files' pixels a side, in (0, 1]: 0.5 averages four pixels into one.

    Raises
    ------
    FileFormatError
        If no layout fits (the message lists what was looked for), or a file is missing or damaged.
    OptionError
        If there is no such kind, or the scale is out of range.
    """
    directory = Path(directory)
    if not 0 < scale <= 1:
        raise OptionError(f"scale is {scale}; expected more than 0 and at most 1")
    found = detect_capture(directory) if kind == "auto" else kind
    if found is None:
        raise FileFormatError(_unknown(directory))
    if found not in READERS:
        raise OptionError(f"no kind of capture {found!r}; there are {', '.join(READERS)}")
    module = importlib.import_module(f"meshanim.datasets.{READERS[found][0]}")
    capture: Capture = module.read_capture(directory)
    views = tuple(view.scaled(scale) for view in capture.views) if scale != 1 else capture.views
    return replace(capture, views=views, scale=scale, head_name=head or capture.head_name)


def _unknown(directory: Path) -> str:
    inside = sorted(path.parent.name for path in directory.glob("*/cameras.json"))
    if inside:
        return f"{directory} holds {len(inside)} captures: choose one, {directory / inside[0]}"
    if not directory.is_dir():
        return f"{directory} is no folder; expected a capture"
    sought = "; ".join(f"{kind}: {files}" for kind, (_, files) in READERS.items())
    return f"{directory} is no capture of a known layout; looked for {sought}"
