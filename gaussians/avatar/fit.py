"""Fitting an avatar to the pictures of a capture: the run behind `meshanim avatar fit`."""

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
import tyro
from safetensors.torch import save_file
from torch import Tensor, nn
from tyro.conf import Positional

from meshanim.datasets.capture import Capture, open_capture
from meshanim.errors import OptionError
from meshanim.gaussians.avatar.density import DensityStatistics, refine, reset_opacities
from meshanim.gaussians.avatar.model import Avatar, AvatarConfig
from meshanim.gaussians.avatar.optimizer import carry, forget_opacities, make_optimizer, rate_at
from meshanim.gaussians.avatar.pictures import PictureStore, backdrop, scene_radius
from meshanim.gaussians.avatar.run_record import check_record, fingerprints, write_record
from meshanim.gaussians.avatar.settings import FitSettings, Regularizers, preset
from meshanim.gaussians.avatar.tracking import Tracking, parse_noise, perturbed
from meshanim.gaussians.gaussians import Gaussians
from meshanim.gaussians.losses import image_loss
from meshanim.gaussians.splat import Rendering
from meshanim.heads import load_head
from meshanim.results import Results
from meshanim.training.trainer import TrainConfig, Trainer, last_checkpoint

__all__ = ["AvatarLearner", "AvatarTask", "AvatarTrainer", "FitAvatarOptions", "fit_avatar", "sized_capture"]


@dataclass(frozen=True)
class FitAvatarOptions:
    """Fit a Gaussian avatar to pictures of one head.

    Example: meshanim avatar fit captures/bruno -o bruno --preset small --size 256
    """

    capture: Positional[Path]
    """A capture: plain multi-view folder, VHAP or NeRSemble (meshanim data synthesize --images makes one)."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Gets model/ (the avatar), run.json, fit.json, tensorboard/ and checkpoints/."""
    preset: Literal["small", "paper"] = "small"
    """small: minutes on two cores; paper: GaussianAvatars' 600,000 steps, for a GPU."""
    size: int = 0
    """Largest side of the pictures, pixels, at most the files'; 0 for theirs."""
    iterations: int | None = None
    """Steps instead of the preset's; what happens at a share of the run scales with it."""
    split: str = "train"
    """Which of the capture's splits to fit."""
    head: str = ""
    """The head of the parameters, where the capture does not say: flame+teeth:FILE."""
    background: Literal["auto", "white", "black"] = "auto"
    """Behind the head: the capture's own where it is plain, else by masks."""
    refine_tracking: bool = False
    """Let the head's parameters at every timestep learn too; needed where they come from a tracker."""
    tracking_noise: str = ""
    """Disturb the parameters first, as a test: rotation=0.01,translation=0.001,expression=0.03 are standard
    deviations in radians, metres and weights."""
    half: bool = False
    """Write the avatar with floats of 16 and 8 bits: a third of the size, for an avatar to pass on."""
    resume: bool = False
    """Go on from the newest checkpoint in the output folder, with the same options and capture."""
    save_every: int = 2000
    """Steps between checkpoints."""
    log_every: int = 50
    """Steps between lines of the log."""
    seed: int = 0
    """Of everything random."""
    cpu: bool = False
    """Stay on the CPU."""


def fit_avatar(options: FitAvatarOptions, progress: bool = True) -> Results:
    """Fit, and write the avatar into `options.output / "model"`.

    Returns
    -------
    Results
        Gaussians, seconds, steps a second; also in fit.json.

    Raises
    ------
    FileFormatError, OptionError
        If the capture cannot be read or has no parameters of a head, or the output holds another run.
    """
    if last_checkpoint(options.output) is not None and not options.resume:
        raise OptionError(f"{options.output} holds a run already: --resume it, or choose another folder")
    capture = sized_capture(options.capture, options.size, options.head)
    views = capture.split(options.split)
    if not views:
        raise OptionError(f"split {options.split} of {capture.directory} has no pictures")
    if capture.parameters is None:
        raise OptionError(f"{capture.directory} holds no parameters of a head to pose an avatar by")
    size = max(max(capture.views[index].width, capture.views[index].height) for index in views)
    settings = preset(options.preset, size, options.iterations)
    behind, composed = backdrop(capture, options.background)
    torch.manual_seed(options.seed)
    config = AvatarConfig(
        head=capture.head_name,
        name=capture.name,
        sh_degree=settings.color.sh_degree,
        latent=settings.color.latent,
        hidden=settings.color.hidden,
        background=behind,
        rest=capture.rest,
    )
    offset = None if capture.static_offset is None else torch.from_numpy(capture.static_offset)
    avatar = Avatar(
        config,
        load_head(capture.head_name),
        capture.carried,
        capture.at(capture.views[views[0]].timestep).shape,
        offset,
        scale=settings.scale,
        opacity=settings.opacity,
    )
    parameters = perturbed(
        capture.parameters, len(capture.timesteps), parse_noise(options.tracking_noise), options.seed
    )
    learner = AvatarLearner(avatar, Tracking(parameters, len(capture.timesteps)), options.refine_tracking)
    store = PictureStore(capture, behind if composed else None)
    task = AvatarTask(store, views, settings, options.seed, options.half)
    train = TrainConfig(
        steps=settings.iterations,
        seed=options.seed,
        log_every=options.log_every,
        save_every=options.save_every,
        keep=1,
    )
    trainer = AvatarTrainer(
        learner, task, train, options.output, settings, scene_radius(capture), options.cpu
    )
    record = {
        "preset": options.preset,
        "iterations": settings.iterations,
        "size": size,
        "split": options.split,
        "head": capture.head_name,
        "background": behind,
        "refine-tracking": options.refine_tracking,
        "tracking-noise": options.tracking_noise,
        "seed": options.seed,
        "name": capture.name,
        "capture": fingerprints(capture, store, views),
    }
    if options.resume and last_checkpoint(options.output) is not None:
        check_record(options.output, record, settings)
        trainer.resume()
    elif trainer.accelerator.is_main_process:
        write_record(options.output, record, settings)
    begun, first = time.perf_counter(), trainer.step
    trainer.run(progress=progress)
    seconds = time.perf_counter() - begun
    results = Results("avatar fit")
    case = f"{capture.name}, {size} pixels, {options.preset}"
    results.add(case, "fit", "gaussians", len(avatar), "1")
    results.add(case, "fit", "steps", settings.iterations, "1")
    results.add(case, "fit", "time", seconds, "s")
    results.add(case, "fit", "speed", (trainer.step - first) / seconds, "1/s")
    if trainer.accelerator.is_main_process:
        results.save(options.output / "fit.json")
    return results


def sized_capture(directory: Path, size: int, head: str = "") -> Capture:
    """A capture whose largest picture has `size` pixels on its longer side (0: as it is)."""
    capture = open_capture(directory, head=head)
    largest = max(max(view.width, view.height) for view in capture.views)
    if size < 0 or size > largest:
        raise OptionError(f"size is {size}; the pictures of {directory} have {largest} pixels")
    return open_capture(directory, head=head, scale=size / largest) if size else capture


class AvatarLearner(nn.Module):
    """An avatar, how its head was posed, and what is known of its Gaussians since they were last refined.

    Parameters
    ----------
    avatar : Avatar
        What is fitted.
    tracking : Tracking
        A row of parameters a timestep.
    refine_tracking : bool
        Whether those learn too.
    """

    def __init__(self, avatar: Avatar, tracking: Tracking, refine_tracking: bool):
        super().__init__()
        self.avatar, self.tracking = avatar, tracking.requires_grad_(refine_tracking)
        self.statistics = DensityStatistics(len(avatar))
        self.refine_tracking = refine_tracking
        self._posed: dict[int, Tensor] = {}

    def pose(self, timestep: int) -> tuple[Tensor, Any]:
        """Vertices (V, 3) and parameters at a timestep; kept where they do not learn."""
        parameters = self.tracking.at(torch.tensor([timestep], device=self.avatar.face.device))
        if self.refine_tracking:
            return self.avatar.vertices(parameters)[0], parameters
        if timestep not in self._posed:
            with torch.no_grad():
                self._posed[timestep] = self.avatar.vertices(parameters)[0]
        return self._posed[timestep], parameters


class AvatarTask:
    """Pictures one at a time, in a new order every round, and the loss of one.

    Parameters
    ----------
    store : PictureStore
        The pictures.
    views : sequence of int
        Positions of those to fit.
    settings : FitSettings
        Weights of the loss, coarse stage.
    seed : int
        Of the order.
    half : bool
        Whether the avatar is written with 16 bits a number.
    """

    def __init__(
        self,
        store: PictureStore,
        views: tuple[int, ...],
        settings: FitSettings,
        seed: int,
        half: bool = False,
    ):
        self.store, self.views, self.settings, self.seed, self.half = store, views, settings, seed, half
        self.seen: tuple[Gaussians, Rendering, Tensor] | None = None
        self._order: tuple[int, np.ndarray] | None = None

    def batch(self, number: int, share: int = 0, shares: int = 1) -> Mapping[str, Any]:
        """The picture of a step."""
        lap, place = divmod(number * shares + share, len(self.views))
        if self._order is None or self._order[0] != lap:
            self._order = lap, np.random.default_rng([self.seed, lap]).permutation(len(self.views))
        index = self.views[self._order[1][place]]
        half = number < self.settings.coarse * self.settings.iterations
        view = self.store.capture.views[index]
        return {
            "image": self.store.image(index, half),
            "cameras": self.store.cameras(index, half),
            "timestep": view.timestep,
        }

    def loss(self, model: nn.Module, batch: Mapping[str, Any]) -> tuple[Tensor, dict[str, Tensor]]:
        """L1 + D-SSIM and what keeps Gaussians on their triangles; `seen` keeps what was drawn."""
        assert isinstance(model, AvatarLearner)
        avatar, screen = model.avatar, self.settings.density.rule == "screen"
        vertices, parameters = model.pose(batch["timestep"])
        world = avatar.gaussians(vertices, parameters)
        cameras = batch["cameras"].to(vertices.device)
        rendering = avatar.draw(world, cameras, depth=None, screen_gradients=screen)
        if not screen and world.means.requires_grad:
            world.means.retain_grad()
        self.seen = world, rendering, batch["image"]
        loss = image_loss(rendering.rgb[0], batch["image"], self.settings.ssim_weight)
        visible = rendering.radii[0].amax(-1) > 0 if screen else None
        kept = regularization(avatar, self.settings.regularizers, visible)
        return loss + kept, {"image": loss, "regularizers": kept}

    def save(self, model: nn.Module, directory: Path) -> None:
        """The avatar's files, and tracking.safetensors: how the head was posed."""
        assert isinstance(model, AvatarLearner)
        model.avatar.write(directory, self.half)
        rows = {name: rows.detach().cpu().contiguous() for name, rows in model.tracking.named_parameters()}
        save_file(rows, directory / "tracking.safetensors")


def regularization(avatar: Avatar, weights: Regularizers, visible: Tensor | None = None) -> Tensor:
    """GaussianAvatars, Eqs. 5, 6: mean relu(|mu| - a) and mean |relu(s - b)| over the visible Gaussians."""
    means: Tensor = avatar.means
    scales: Tensor = avatar.scales
    if visible is not None:
        means, scales = means[visible], scales[visible]
    # |mu| of a Gaussian at the origin has no direction to go.
    away = (means.square().sum(1) + 1e-12).sqrt()
    far = torch.relu(away - weights.position_threshold).mean()
    excess = torch.relu(scales.exp() - weights.scale_threshold)
    large = (excess.square().sum(1) + 1e-24).sqrt().mean()
    return weights.position_weight * far + weights.scale_weight * large


class AvatarTrainer(Trainer):
    """The trainer with a rate a group, and Gaussians that come and go.

    Every process draws other pictures; gradients are averaged over all, so that the avatars stay the same.

    Parameters
    ----------
    settings : FitSettings
        Rates, density.
    extent : float
        Radius of the scene, metres.
    """

    def __init__(
        self,
        model: AvatarLearner,
        task: AvatarTask,
        config: TrainConfig,
        directory: str | Path,
        settings: FitSettings,
        extent: float,
        cpu: bool = False,
    ):
        self.settings, self.extent, self.avatar_task = settings, extent, task
        super().__init__(model, task, config, directory, cpu)
        steps = settings.iterations
        first, last = round(settings.density.start * steps), round(settings.density.stop * steps)
        self.refinements = range(max(first, 1), last, max(1, round(settings.density.every * steps)))
        self.reset_every = round(settings.density.reset_every * steps)

    def _prepare(self, model: nn.Module) -> tuple[Any, Any]:
        assert isinstance(model, AvatarLearner)
        model.to(self.accelerator.device)
        tracked = model.tracking if model.refine_tracking else None
        # Accelerate's wrapper, like its `backward`, searches the disk for a package at every step.
        return model, make_optimizer(model.avatar, tracked, self.settings, self.extent)

    def _optimizer_step(self, batches: Iterator[Mapping[str, Any]], clock: Any) -> dict[str, Tensor]:
        settings, model = self.settings, self.model
        for group in self.optimizer.param_groups:
            rate = rate_at(settings.rates[group["name"]], self.step, settings.iterations)
            group["lr"] = group["factor"] * rate
        model.avatar.sh_degree = self._sh_degree()
        with clock.waiting():
            batch = self._to_device(next(batches))
        loss, terms = self.avatar_task.loss(model, batch)
        loss.backward()
        if self.accelerator.num_processes > 1:
            self._average_gradients()
        done = self.step + 1
        if self.refinements and done <= self.refinements[-1]:
            self._observe()
        self.optimizer.step()
        self.optimizer.zero_grad()
        if done in self.refinements:
            self._refine(done)
        if self.reset_every and done % self.reset_every == 0 and done < self.config.steps:
            reset_opacities(model.avatar)
            forget_opacities(self.optimizer, model.avatar)
        return {"loss": loss, "gaussians": torch.tensor(float(len(model.avatar))), **terms}

    def _sh_degree(self) -> int:
        color = self.settings.color
        if not color.sh_every:
            return color.sh_degree
        return min(color.sh_degree, int(self.step / max(1.0, color.sh_every * self.settings.iterations)))

    def _average_gradients(self) -> None:
        for group in self.optimizer.param_groups:
            for parameter in group["params"]:
                if parameter.grad is None:
                    parameter.grad = torch.zeros_like(parameter)
                parameter.grad.copy_(self.accelerator.reduce(parameter.grad, reduction="mean"))

    @torch.no_grad()
    def _observe(self) -> None:
        assert self.avatar_task.seen is not None
        world, rendering, _ = self.avatar_task.seen
        if rendering.screen_offsets is None:
            assert world.means.grad is not None
            length = world.means.grad.norm(dim=-1)
            self.model.statistics.add(length, length > 0)
        else:
            assert rendering.screen_offsets.grad is not None
            height, width = rendering.rgb.shape[-3:-1]
            halves = rendering.screen_offsets.new_tensor([width / 2, height / 2])
            length = (rendering.screen_offsets.grad[0] * halves).norm(dim=-1)
            radius = rendering.radii[0].amax(-1)
            self.model.statistics.add(length, radius > 0, radius)

    def _refine(self, done: int) -> None:
        statistics = self.model.statistics
        if self.accelerator.num_processes > 1:
            for name in ("gradient", "seen"):
                summed = self.accelerator.reduce(getattr(statistics, name), reduction="sum")
                setattr(statistics, name, summed)
            gathered = self.accelerator.gather(statistics.radius[None])
            statistics.radius = gathered.amax(0)
        refined = refine(
            self.model.avatar,
            statistics,
            self.settings.density,
            left=sum(step >= done for step in self.refinements),
            extent=self.extent,
            was_reset=bool(self.reset_every) and done > self.reset_every,
            seed=self.config.seed * 1_000_003 + done,
        )
        carry(self.optimizer, self.model.avatar, refined)

    def _logged(self, logs: Mapping[str, Tensor]) -> dict[str, float]:
        assert self.avatar_task.seen is not None
        _, rendering, image = self.avatar_task.seen
        mse = (rendering.rgb[0].detach() - image).square().mean()
        return super()._logged({**logs, "psnr": -10 * torch.log10(mse)})

    def _report(self, writer: Any, values: Mapping[str, float]) -> None:
        super()._report(writer, values)
        if self.avatar_task.seen is not None and self.step % (20 * self.config.log_every) == 0:
            _, rendering, _ = self.avatar_task.seen
            shown = rendering.rgb[0].detach().clamp(0, 1).cpu()
            writer.add_image("rendered", shown.numpy(), self.step, dataformats="HWC")

    def resume(self) -> bool:
        found = super().resume()
        self.model._posed.clear()
        return found
