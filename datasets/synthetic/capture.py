"""A capture of our own: people of the corpus drawn from many cameras, with everything known exactly."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Float32, Int, UInt8
from scipy.ndimage import gaussian_filter
from tqdm import tqdm

from meshanim.datasets.capture import REGIONS, Picture
from meshanim.datasets.capture_folder import (
    remove_half_written,
    write_cameras,
    write_parameters,
    write_picture,
    write_record,
    write_speech,
)
from meshanim.datasets.synthetic.camera_rig import (
    front_of_rig,
    orbit_camera,
    random_direction,
    rig_directions,
)
from meshanim.datasets.synthetic.claim import claim_folder
from meshanim.datasets.synthetic.corpus import SynthesizeOptions
from meshanim.datasets.synthetic.moments import choose_moments
from meshanim.errors import OptionError
from meshanim.heads import DefaultHead, HeadParameters, load_head
from meshanim.jobs import run_jobs
from meshanim.render import Camera, Renderer
from meshanim.render.drawn_surface import drawn_surface
from meshanim.render.lighting import plain_background
from meshanim.render.look import (
    PEOPLE,
    Appearance,
    LookAssets,
    PersonParameters,
    find_person,
    look_assets,
    make_appearance,
)
from meshanim.render.renderer import head_points

__all__ = ["CaptureOptions", "synthesize_capture"]

DISTANCE = 0.72
"""Metres from the cameras to the middle of the head; more where hair needs it."""
MARGIN = 0.03
HAIR_ON_SCALP = 0.12
"""Share of the scalp around a pixel that strands must cover for it to be hair."""
_KINDS = {
    "neck": "neck",
    "lips": "lips",
    "left_eye": "eyes",
    "right_eye": "eyes",
    **dict.fromkeys(("mouth_lining", "tongue", "upper_teeth", "lower_teeth"), "mouth"),
}
RANDOM_VIEWS = 4
NOVEL_VIEWS = {"h0": (0.0, 0.0, 3), "h1": (24.0, 6.0, 6)}
NOVEL_EXPRESSION_VIEWS = {"h0": (0.0, 0.0), "h2": (-15.0, 0.0), "h3": (30.0, 15.0)}
"""Held-out cameras beside random ones, degrees; of the former, who takes every n-th training frame."""


@dataclass(frozen=True)
class CaptureOptions:
    """How --images are taken: people of the corpus drawn in full quality, cameras and head known exactly."""

    views: int = 0
    """Cameras of the rig, or random cameras a frame; 0: 16 and 4."""
    cameras: Literal["rig", "random"] = "rig"
    """rig: the same cameras for all frames, over 90 by 30 degrees, some held out. random: a new camera for
    every picture, and four held out."""
    size: int = 512
    """Pixels a side."""
    people: int = 1
    """Folders to write: the twelve of docs/look.md first, then drawn ones."""
    names: tuple[str, ...] = ()
    """People by name (ana, bruno, ...) instead."""
    frames: int = 40
    """Training frames of each person; a quarter as many more are held out."""
    moments: Literal["spread", "video"] = "spread"
    """spread: half hand-made faces, half moments of speech that differ most. video: speech, frame
    after frame, with its sound in speech/."""
    head_motion: float = 0.0
    """Share of the speaker's head rotation that is kept, 0 to 1; the light stands still."""
    background: tuple[float, float, float] = (0.7, 0.7, 0.7)
    """Plain sRGB colour around the head, 0 to 1."""

    def __post_init__(self):
        for name, low, high in (
            ("views", 0, 256),
            ("size", 32, 4096),
            ("people", 1, 10_000),
            ("frames", 1, 100_000),
            ("head_motion", 0, 1),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise OptionError(f"--{name.replace('_', '-')} is {value}; expected {low} to {high}")
        if not all(0 <= channel <= 1 for channel in self.background):
            raise OptionError(f"--background is {self.background}; expected three numbers in [0, 1]")
        for name in self.names:
            find_person(name)

    @property
    def view_count(self) -> int:
        """Cameras of the rig, or pictures a training frame."""
        return self.views or (16 if self.cameras == "rig" else RANDOM_VIEWS)

    @property
    def held_out_frames(self) -> int:
        return max(1, round(self.frames / 4))


@dataclass(frozen=True)
class _Plan:
    """One person's capture before it is drawn."""

    folder: Path
    person: PersonParameters
    parameters: HeadParameters
    drive: Float32[np.ndarray, "frames expressions"]
    cameras: dict[str, Camera]
    pictures: tuple[tuple[str, int, str], ...]
    options: CaptureOptions


@dataclass(frozen=True)
class _Job:
    """The pictures of one frame."""

    folder: Path
    person: PersonParameters
    options: CaptureOptions
    parameters: HeadParameters
    drive: Float32[np.ndarray, " expressions"]
    pictures: tuple[tuple[str, Camera], ...]


def synthesize_capture(
    corpus: SynthesizeOptions, options: CaptureOptions, progress: bool = True
) -> list[Path]:
    """Draw people of the corpus; pictures that are already there are kept.

    Parameters
    ----------
    corpus : SynthesizeOptions
        The folder to write, the seed, how people speak, who works.
    options : CaptureOptions
        Cameras, people, frames.
    progress : bool
        Show a bar.

    Returns
    -------
    list of Path
        A folder a person, which `meshanim.datasets.open_capture` reads.

    Raises
    ------
    DependencyError
        Without a synthetic voice or pocketsphinx: the extra is `speech`.
    OptionError
        If the folder holds something else, the head is not the default one, or there are fewer than two
        sentences.
    """
    if corpus.head != "default":
        raise OptionError(f"--images need the default head: only it has a look, not {corpus.head}")
    if corpus.format != "meshanim":
        raise OptionError("--images have no --format faceformer")
    corpus = replace(corpus, directory=corpus.directory.absolute())
    people = cast_people(options, corpus.seed)
    shared = ("seed", "fps", "emotional", "sentences", "texts", "version")
    recorded = {"images": True, **{key: corpus.recorded[key] for key in shared}, **asdict(options)}
    # As JSON has it: it knows no tuples.
    claim_folder(corpus.directory, json.loads(json.dumps(recorded)), "capture")
    plan = partial(_plan, corpus, options)
    plans: list[_Plan] = []
    with tqdm(total=len(people), disable=not progress, desc="people") as bar:
        for made in run_jobs(plan, list(enumerate(people)), corpus.workers, corpus.dask):
            plans.append(made)
            bar.update()
    plans.sort(key=lambda made: made.folder)
    for made in plans:
        remove_half_written(made.folder)
    jobs = [job for made in plans for job in _jobs(made)]
    total, left = sum(len(made.pictures) for made in plans), sum(len(job.pictures) for job in jobs)
    with tqdm(total=total, initial=total - left, disable=not progress, desc="pictures") as bar:
        for count in run_jobs(_draw, jobs, corpus.workers, corpus.dask):
            bar.update(count)
    for made in plans:  # by workers that were killed
        remove_half_written(made.folder)
    return [made.folder for made in plans]


def cast_people(options: CaptureOptions, seed: int) -> list[PersonParameters]:
    """Whom to draw: by name, or the twelve, then mixtures with random faces and the looks of the twelve."""
    if options.names:
        return [find_person(name) for name in options.names]
    known = list(PEOPLE.values())
    people = known[: options.people]
    for index in range(len(people), options.people):
        generator = np.random.default_rng([seed, index, 0x9E0B])
        look = known[int(generator.integers(len(known)))]
        shape = np.clip(generator.normal(size=40) * 0.8, -2, 2)
        people.append(
            replace(
                look,
                name=f"P{index + 1:03d}",
                seed=int(generator.integers(1 << 20)),
                identity="",
                shape=tuple(round(float(value), 4) for value in shape),
                tone=float(np.clip(look.tone + generator.normal() * 0.08, 0.05, 1)),
            )
        )
    return people


def _plan(corpus: SynthesizeOptions, options: CaptureOptions, job: tuple[int, PersonParameters]) -> _Plan:
    """Decide frames and cameras of one person, and write everything but the pictures."""
    index, person = job
    head, appearance = _look()[0], _appearance(_Whom(person))
    chosen = choose_moments(corpus, index, options.frames, options.held_out_frames, options.moments)
    training, moments = chosen.training, [*chosen.training, *chosen.held_out]
    columns = np.stack([moment.weights(head.expression_names) for moment in moments])
    rest = head.expression(person.rest_expression).numpy()
    turns = np.stack([moment.turn for moment in moments]) * np.float32(options.head_motion)
    parameters = HeadParameters(
        shape=torch.from_numpy(appearance.shape)[None],
        expression=torch.from_numpy(rest + columns),
        neck=torch.from_numpy(turns) if options.head_motion else None,
    )
    target, distance = _standpoint(appearance)
    take = partial(orbit_camera, target, distance, size=options.size)
    lay_out = _rig if options.cameras == "rig" else partial(_random_cameras, [corpus.seed, index])
    cameras, splits = lay_out(options, len(training), len(chosen.held_out), take)
    folder = corpus.directory / person.name.lower()
    folder.mkdir(exist_ok=True)
    write_cameras(
        folder,
        {name: (c.world_to_camera, c.intrinsics, c.width, c.height) for name, c in cameras.items()},
    )
    write_parameters(folder, parameters, range(len(moments)))
    drawn_surface(head, appearance).save(folder / "surface.npz")
    if chosen.speech:
        starts = (0, len(training))
        write_speech(folder, dict(zip(starts, chosen.speech)))
    record: dict[str, Any] = {
        "name": person.name,
        "head": "default",
        "background": _stored(options.background),
        "regions": list(REGIONS),
        "fps": float(corpus.fps) if chosen.speech else None,
        "rest": dict(person.rest_expression),
        "frames": [moment.name for moment in moments],
        "splits": splits,
    }
    write_record(folder, {key: value for key, value in record.items() if value is not None})
    names = sorted({name for split in splits.values() for name in split})
    pictures = tuple((name, int(name[:5]), name if name in cameras else name[6:]) for name in names)
    return _Plan(folder, person, parameters, columns, cameras, pictures, options)


def _stored(color: tuple[float, float, float]) -> tuple[float, float, float]:
    """The colour that 8 bits hold."""
    red, green, blue = (round(channel * 255) / 255 for channel in color)
    return red, green, blue


def _standpoint(appearance: Appearance) -> tuple[np.ndarray, float]:
    """The middle of the head, and the distance at which it fits into every picture."""
    points = head_points(appearance).astype(np.float64)
    target = (points.min(0) + points.max(0)) / 2
    room = np.tan(np.radians(13.0)) * (1 - 2 * MARGIN)
    away = 0.0
    for azimuth, elevation in rig_directions(16):
        view = orbit_camera(target, 1.0, azimuth, elevation, 2)
        turned = (points - target) @ view.world_to_camera[:3, :3].T
        away = max(away, float((np.abs(turned[:, :2]) / room - turned[:, 2:]).max()))
    return target, max(DISTANCE, away)


def _rig(options: CaptureOptions, training: int, held_out: int, take):
    """Cameras that stand still, and which picture is for what."""
    directions = rig_directions(options.view_count)
    cameras = {f"{index:02d}": take(*direction) for index, direction in enumerate(directions)}
    novel = []
    if len(cameras) >= 4:
        novel.append(f"{front_of_rig(len(cameras)):02d}")
    if len(cameras) >= 8:
        upper = [name for name, (azimuth, elevation) in zip(cameras, directions) if elevation > 0 < azimuth]
        novel.append(upper[0])
    known = [name for name in cameras if name not in novel]
    before, after = range(training), range(training, training + held_out)

    def names(frames, chosen):
        return [f"{frame:05d}_{camera}" for frame in frames for camera in chosen]

    splits = {"train": names(before, known)}
    if novel:
        splits["novel_view"] = names(before, novel)
        splits["novel_expression"] = names(after, novel)
        splits["novel_expression_known_view"] = names(after, known)
    else:
        splits["novel_expression"] = names(after, known)
    return cameras, splits


def _random_cameras(seed: Sequence[int], options: CaptureOptions, training: int, held_out: int, take):
    """A camera of its own for every training picture; four others that stand still."""
    cameras, train = {}, []
    for frame in range(training):
        for view in range(options.view_count):
            generator = np.random.default_rng([*seed, frame, view, 0xCA3E])
            name = f"{frame:05d}_r{view}"
            cameras[name] = take(*random_direction(generator))
            train.append(name)
    splits: dict[str, list[str]] = {"train": train, "novel_view": [], "novel_expression": []}
    for name, (azimuth, elevation, step) in NOVEL_VIEWS.items():
        cameras[name] = take(*np.radians([azimuth, elevation]))
        splits["novel_view"] += [f"{frame:05d}_{name}" for frame in range(0, training, step)]
    for name, degrees in NOVEL_EXPRESSION_VIEWS.items():
        cameras[name] = take(*np.radians(degrees))
        splits["novel_expression"] += [f"{training + frame:05d}_{name}" for frame in range(held_out)]
    return cameras, splits


def _jobs(plan: _Plan) -> list[_Job]:
    """The missing pictures, those of one frame together."""
    frames: dict[int, list[tuple[str, Camera]]] = {}
    for name, frame, camera in plan.pictures:
        if not _drawn(plan.folder, name):
            frames.setdefault(frame, []).append((name, plan.cameras[camera]))
    p = plan.parameters
    return [
        _Job(
            plan.folder,
            plan.person,
            plan.options,
            replace(
                p,
                expression=None if p.expression is None else p.expression[frame : frame + 1],
                neck=None if p.neck is None else p.neck[frame : frame + 1],
            ),
            plan.drive[frame],
            tuple(pictures),
        )
        for frame, pictures in frames.items()
    ]


@dataclass(frozen=True)
class _Whom:
    """A person as a key."""

    person: PersonParameters

    def __hash__(self) -> int:
        return hash(repr(self.person))


@lru_cache(maxsize=1)
def _look() -> tuple[DefaultHead, LookAssets]:
    head = load_head("default")
    return head, look_assets(head)


@lru_cache(maxsize=1)
def _appearance(whom: _Whom) -> Appearance:
    head, assets = _look()
    return make_appearance(head, whom.person, assets=assets)


@lru_cache(maxsize=1)
def _renderer(whom: _Whom, size: int, background: tuple[float, float, float], distance: float) -> Renderer:
    camera = orbit_camera(_standpoint(_appearance(whom))[0], distance, 0.0, 0.0, size)
    return Renderer(
        _look()[0],
        _appearance(whom),
        camera=camera,
        background=plain_background(size, size, _stored(background)),
        threads=1,
    )


def _draw(job: _Job) -> int:
    """Draw and write the pictures of one frame that are not there; how many."""
    whom, options = _Whom(job.person), job.options
    distance = _standpoint(_appearance(whom))[1]
    renderer = _renderer(whom, options.size, options.background, distance)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # sums must not depend on the machine
    try:
        with torch.inference_mode():
            vertices = renderer.head(job.parameters)[0].numpy()
    finally:
        torch.set_num_threads(threads)
    for name, camera in job.pictures:
        if not _drawn(job.folder, name):
            write_picture(job.folder, name, take_picture(renderer.seen_from(camera), vertices, job.drive))
    return len(job.pictures)


def _drawn(folder: Path, name: str) -> bool:
    return (folder / "images" / f"{name}.png").exists()  # the image is written last


def take_picture(
    renderer: Renderer,
    vertices: Float32[np.ndarray, "vertices 3"],
    drive: Float32[np.ndarray, " expressions"],
) -> Picture:
    """Image, mask and region map of a posed head; `drive` are the weights that fold the skin."""
    image = renderer.frame(vertices, drive)
    mask = np.round(255 * renderer.opacity).astype(np.uint8)
    shown, names = renderer.frame_regions()
    hair = renderer.strand_cover("hair")
    return Picture(image, mask, _region_map(shown, names, hair))


def _region_map(
    shown: Int[np.ndarray, "height width"], names: Sequence[str], hair: Float[np.ndarray, "height width"]
) -> UInt8[np.ndarray, "height width"]:
    kinds = [REGIONS.index(_KINDS.get(name, "skin")) for name in names]
    regions = np.array([*kinds, 0], np.uint8)[shown]
    # Short hair leaves gaps: it is hair where enough of the neighbourhood is covered.
    scalp = (shown == names.index("scalp")) & (gaussian_filter(hair, len(hair) / 170) >= HAIR_ON_SCALP)
    regions[scalp | (hair >= 0.5)] = REGIONS.index("hair")
    return regions
