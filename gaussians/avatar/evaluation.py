"""Scoring an avatar on pictures it was not fitted to: the run behind `meshanim avatar evaluate`."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import roma
import torch
from jaxtyping import Bool, Float
from PIL import Image
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor
from tqdm import tqdm
from tyro.conf import Positional

from meshanim.datasets.capture import Capture
from meshanim.errors import FileFormatError, OptionError
from meshanim.files import written_whole
from meshanim.gaussians.avatar.fit import sized_capture
from meshanim.gaussians.avatar.lpips import Lpips
from meshanim.gaussians.avatar.model import Avatar
from meshanim.gaussians.avatar.pictures import PictureStore, backdrop
from meshanim.heads import HeadParameters
from meshanim.results import Results

__all__ = ["EvaluateAvatarOptions", "evaluate_avatar"]

AREAS = {
    "full": (),
    "face": ("skin", "lips", "mouth", "eyes"),
    "mouth": ("lips", "mouth"),
    "eyes": ("eyes",),
}
"""Pixels that are scored apart, by the names of the capture's region maps; full is all of them."""
ERROR_GAIN = 4


@dataclass(frozen=True)
class EvaluateAvatarOptions:
    """Score an avatar on views and expressions it was not fitted to.

    Example: meshanim avatar evaluate bruno captures/bruno --size 256 --pictures sheets
    """

    avatar: Positional[Path]
    """Folder that `meshanim avatar fit` wrote."""
    capture: Positional[Path]
    """The capture it was fitted to."""
    splits: tuple[str, ...] = ()
    """Splits to score; all but train that have pictures, if none is named."""
    size: int = 0
    """Largest side of the pictures, pixels; 0 for the files'."""
    head: str = ""
    """The head of the parameters, where the capture does not say."""
    lpips: Path | None = None
    """AlexNet's weights (torchvision's alexnet-owt-7be5be79.pth) for LPIPS; absent without."""
    pictures: Path | None = None
    """Folder for a sheet a split: truth, rendering and error (four times) beside each other, eyes and mouth
    below."""
    examples: int = 4
    """Pictures a sheet, spread over the split; one of them is the one taken most from the side."""
    json: Path | None = None
    """Also write the rows here."""


def evaluate_avatar(options: EvaluateAvatarOptions, progress: bool = True) -> Results:
    """Measure and return the rows: means over pictures of PSNR (dB), SSIM and LPIPS by split and area.

    PSNR of an area is of its pixels alone, SSIM the mean of torchmetrics' map over them. At timesteps that
    the avatar was fitted to, the head is posed as at the end of the fit; elsewhere as the capture says.

    Raises
    ------
    FileFormatError, OptionError
        If avatar or capture cannot be read, or a split does not exist.
    """
    directory = options.avatar / "model" if (options.avatar / "model").is_dir() else options.avatar
    avatar = Avatar.from_pretrained(directory, options.head)
    capture = sized_capture(options.capture, options.size, options.head)
    splits = options.splits or tuple(n for n, views in capture.splits.items() if n != "train" and views)
    if not splits:
        raise OptionError(f"{capture.directory} has no pictures but train's: name it with --splits train")
    for split in splits:
        if not capture.split(split):
            raise OptionError(f"split {split} of {capture.directory} has no pictures")
    if options.examples < 1:
        raise OptionError(f"examples must be at least 1, not {options.examples}")
    behind, composed = backdrop(capture, avatar.config.background)
    store = PictureStore(capture, behind if composed else None)
    perceptual = None if options.lpips is None else Lpips(options.lpips)
    poses = _Poses(avatar, capture, directory)
    results = Results("avatar evaluate")
    results.add(capture.name, "avatar", "gaussians", len(avatar), "1")
    if options.pictures is not None:
        options.pictures.mkdir(parents=True, exist_ok=True)
    with torch.inference_mode():
        for split in splits:
            views = capture.split(split)
            scores: dict[str, list[float]] = {}
            shown = _examples([poses.sideways(index) for index in views], options.examples)
            rows = []
            for place, index in enumerate(tqdm(views, desc=split, unit="picture", disable=not progress)):
                truth, rendered = store.image(index), poses.render(index, store)
                areas = _areas(capture, index, truth.shape[:2])
                for name, value in _scores(rendered, truth, areas, perceptual).items():
                    scores.setdefault(name, []).append(value)
                if options.pictures is not None and place in shown:
                    rows.append(_compared(truth, rendered, areas))
            for name, values in scores.items():
                results.add(split, "avatar", name, float(np.mean(values)), "dB" if "PSNR" in name else "1")
            if options.pictures is not None:
                _write_sheet(options.pictures / f"{split}.png", rows)
        results.add("playback", "avatar", "speed", poses.speed(capture.split(splits[0]), store), "frames/s")
    if options.json is not None:
        results.save(options.json)
    return results


class _Poses:
    """The avatar as it was at each picture's timestep."""

    def __init__(self, avatar: Avatar, capture: Capture, directory: Path):
        self.avatar, self.capture = avatar, capture
        self.fitted: dict[str, Tensor] = {}
        path = directory / "tracking.safetensors"
        if path.is_file():
            try:
                self.fitted = load_file(path)
            except (OSError, SafetensorError) as error:
                raise FileFormatError(f"cannot read {path}: {error}") from error
        counts = {len(rows) for rows in self.fitted.values()}
        if counts and counts != {len(capture.timesteps)}:
            raise OptionError(
                f"the avatar was fitted to {counts.pop()} timesteps, {capture.directory} has "
                f"{len(capture.timesteps)}: give the capture that it was fitted to"
            )
        views = capture.splits.get("train", ())
        self.seen = {capture.views[index].timestep for index in views} if self.fitted else set()

    def at(self, timestep: int) -> HeadParameters:
        if timestep in self.seen:
            return HeadParameters(
                **{name: rows[timestep : timestep + 1] for name, rows in self.fitted.items()}
            )
        return replace(self.capture.at(timestep), shape=None)  # the avatar's own

    def sideways(self, index: int) -> float:
        """How far from the side of the head a picture was taken: 0 in front (or behind), 1 in profile."""
        view = self.capture.views[index]
        parameters = self.at(view.timestep)
        turned, moved = torch.eye(3), torch.zeros(3)
        for part in (parameters.rotation, parameters.neck):
            if part is not None:
                turned = turned @ roma.rotvec_to_rotmat(part[0].cpu())
        if parameters.translation is not None:
            moved = parameters.translation[0].cpu()
        pose = view.world_to_camera
        towards = -pose[:3, :3].T @ pose[:3, 3] - moved.numpy()
        return float(abs(turned[:, 0].numpy() @ towards) / np.linalg.norm(towards))

    def render(self, index: int, store: PictureStore) -> Float[Tensor, "height width 3"]:
        parameters = self.at(self.capture.views[index].timestep)
        rendering = self.avatar(parameters, store.cameras(index), depth=None)
        return rendering.rgb[0, 0].clamp(0, 1)

    def speed(self, views: Sequence[int], store: PictureStore) -> float:
        """Pictures a second from parameters on, the median of up to 20."""
        times = []
        for index in views[:20]:
            start = time.perf_counter()
            self.render(index, store)
            times.append(time.perf_counter() - start)
        return 1 / float(np.median(times))


def _examples(sideways: Sequence[float], count: int) -> set[int]:
    """Places spread over a split; the last but one gives way to the picture taken most from the side."""
    places = np.linspace(0, len(sideways) - 1, min(count, len(sideways))).round().astype(int).tolist()
    side = int(np.argmax(sideways))
    if side not in places and len(places) > 1:
        places[-2 if len(places) > 2 else -1] = side
    return set(places)


def _areas(capture: Capture, index: int, size: Sequence[int]) -> dict[str, Bool[np.ndarray, "height width"]]:
    """Pixels by area; only those that the picture has."""
    areas = {"full": np.ones(tuple(size), bool)}
    picture = capture[index]
    if picture.regions is not None and capture.region_names:
        for name, regions in AREAS.items():
            numbers = [capture.region_names.index(one) for one in regions if one in capture.region_names]
            if numbers:
                areas[name] = np.isin(picture.regions, numbers)
    elif picture.mask is not None:
        areas["head"] = picture.mask > 127
    return {name: area for name, area in areas.items() if area.any()}


def _scores(
    rendered: Tensor, truth: Tensor, areas: dict[str, np.ndarray], perceptual: Lpips | None
) -> dict[str, float]:
    square = (rendered - truth).square().mean(-1)
    first, second = (image.movedim(-1, 0)[None] for image in (rendered, truth))
    from torchmetrics.functional.image import structural_similarity_index_measure  # loads transformers

    _, similar = structural_similarity_index_measure(first, second, data_range=1.0, return_full_image=True)
    similar = similar[0].mean(0)
    scores = {}
    for name, area in areas.items():
        pixels = torch.from_numpy(area)
        scores[f"PSNR {name}"] = float(-10 * torch.log10(square[pixels].mean().clamp_min(1e-10)))
        if name in ("full", "face", "head"):
            scores[f"SSIM {name}"] = float(similar[pixels].mean())
    if perceptual is not None:
        scores["LPIPS full"] = float(perceptual(rendered, truth))
    return scores


def _compared(truth: Tensor, rendered: Tensor, areas: dict[str, np.ndarray]) -> np.ndarray:
    """Truth, rendering and error; below them eyes and mouth of the first two, enlarged."""
    error = (ERROR_GAIN * (rendered - truth)).abs().clamp(0, 1)
    panels = [_bytes(image) for image in (truth, rendered, error)]
    row = np.concatenate(panels, 1)
    height, width = panels[0].shape[:2]
    details = []
    for name in ("eyes", "mouth"):
        if name in areas:
            box = _box(areas[name], width / height)
            for panel in panels[:2]:
                crop = Image.fromarray(panel).crop(box)
                details.append(
                    np.asarray(crop.resize((width * 3 // 4, height * 3 // 4), Image.Resampling.BICUBIC))
                )
    if not details:
        return row
    below = np.concatenate(details, 1)
    below = np.pad(below, ((0, 0), (0, row.shape[1] - below.shape[1]), (0, 0)), constant_values=255)
    return np.concatenate([row, below])


def _bytes(image: Tensor) -> np.ndarray:
    return (image.numpy() * 255 + 0.5).astype(np.uint8)


def _box(area: np.ndarray, ratio: float) -> tuple[int, int, int, int]:
    """A frame around an area, of the picture's shape, with room around it."""
    rows, columns = (np.flatnonzero(area.any(axis)) for axis in (1, 0))
    middle = (columns[0] + columns[-1]) / 2, (rows[0] + rows[-1]) / 2
    tall = max(rows[-1] - rows[0], (columns[-1] - columns[0]) / ratio, 8) * 1.3
    left, top = round(middle[0] - tall * ratio / 2), round(middle[1] - tall / 2)
    return left, top, round(left + tall * ratio), round(top + tall)


def _write_sheet(path: Path, rows: list[np.ndarray]) -> None:
    width = max(row.shape[1] for row in rows)
    padded = [np.pad(r, ((0, 0), (0, width - r.shape[1]), (0, 0)), constant_values=255) for r in rows]
    with written_whole(path) as temporary:
        Image.fromarray(np.concatenate(padded)).save(temporary)
