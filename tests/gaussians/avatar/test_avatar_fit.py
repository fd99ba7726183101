"""Fits of a few steps to pictures whose truth is known."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from made_capture import CAMERAS, TIMESTEPS, made_avatar, write_capture
from PIL import Image
from safetensors.torch import load_file

from meshanim.cli import main
from meshanim.datasets.capture import open_capture
from meshanim.errors import FileFormatError, OptionError
from meshanim.gaussians.avatar import Avatar, settings
from meshanim.gaussians.avatar.evaluation import (
    EvaluateAvatarOptions,
    _examples,
    _Poses,
    evaluate_avatar,
)
from meshanim.gaussians.avatar.fit import FitAvatarOptions, fit_avatar, regularization
from meshanim.gaussians.avatar.lpips import LAYERS, Lpips
from meshanim.gaussians.avatar.pictures import PictureStore, backdrop
from meshanim.gaussians.avatar.settings import Regularizers
from meshanim.gaussians.avatar.tracking import parse_noise, perturbed
from meshanim.results import Results


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made") / "ball"
    write_capture(folder)
    return folder


@pytest.fixture
def tiny(monkeypatch):
    """The small preset with few Gaussians; the paper's with steps that a test can take."""
    small = settings.PRESETS["small"]
    rates = small.rates | {"translation": settings.Rate(1e-3, 0.1)}
    small = replace(small, density=replace(small.density, limit=100), rates=rates)
    paper = settings.PRESETS["paper"]
    density = replace(paper.density, start=0.1, every=0.2, threshold=1e-7, reset_every=0.5)
    color = replace(paper.color, sh_every=0.1)
    monkeypatch.setitem(settings.PRESETS, "small", small)
    monkeypatch.setitem(settings.PRESETS, "paper", replace(paper, density=density, color=color))


def fit(capture: Path, output: Path, **changes) -> Results:
    return fit_avatar(FitAvatarOptions(capture, output, **({"iterations": 60} | changes)), progress=False)


def score(output: Path, capture: Path, split: str, **changes) -> float:
    options = EvaluateAvatarOptions(output, capture, (split,), **changes)
    return evaluate_avatar(options, progress=False).value(split, "avatar", "PSNR full")


def test_held_out_pictures_come_out_better_with_more_steps(capture, tiny, tmp_path):
    fit(capture, tmp_path / "short", iterations=10)
    results = fit(capture, tmp_path / "long", iterations=100)
    assert results.value("Ball, 20 pixels, small", "fit", "gaussians") == 100
    for split in ("novel_view", "novel_expression"):
        short, long = (score(tmp_path / name, capture, split) for name in ("short", "long"))
        assert long > short + 1.5
    assert Results.load(tmp_path / "long" / "fit.json").rows == results.rows


@pytest.mark.parametrize("preset", ["small", "paper"])
def test_interrupted_and_resumed_is_uninterrupted(preset, capture, tiny, tmp_path, monkeypatch):
    fit(capture, tmp_path / "whole", preset=preset, iterations=20, refine_tracking=True)
    from meshanim.gaussians.avatar import fit as module

    run = module.AvatarTrainer.run
    for until in (3, 9, None):  # before, between and after refinements
        monkeypatch.setattr(
            module.AvatarTrainer, "run", lambda self, progress, u=until: run(self, u, progress)
        )
        fit(capture, tmp_path / "parts", preset=preset, iterations=20, refine_tracking=True, resume=True)
    for name in ("avatar.safetensors", "tracking.safetensors"):
        whole, parts = (load_file(tmp_path / run / "model" / name) for run in ("whole", "parts"))
        assert whole.keys() == parts.keys()
        assert all(torch.equal(whole[key], parts[key]) for key in whole)
    with pytest.raises(OptionError, match="--resume"):
        fit(capture, tmp_path / "parts")


def shifted(capture: Path, target: Path) -> Path:
    """The same capture, its first camera a millimetre away."""
    shutil.copytree(capture, target)
    content = json.loads((target / "cameras.json").read_text())
    content["cameras"]["c0"]["world_to_camera"][0][3] += 0.001
    (target / "cameras.json").write_text(json.dumps(content))
    return target


def repainted(capture: Path, target: Path) -> Path:
    shutil.copytree(capture, target)
    path = target / "images" / "00000_c0.png"
    Image.fromarray(255 - np.asarray(Image.open(path))).save(path)
    return target


def test_a_resumed_run_must_be_the_one_that_was_begun(capture, tiny, tmp_path, capsys, monkeypatch):
    begun = tmp_path / "run"
    words = ["avatar", "fit", str(capture), "-o", str(begun), "--iterations", "8", "--save-every", "4"]
    assert main(words) == 0
    before = (begun / "checkpoints" / "0000008" / "trainer.safetensors").read_bytes()
    for changed, error in (
        (["--preset", "paper"], "preset 'small', not 'paper'"),
        (["--size", "10"], "size 20, not 10"),
        (["--iterations", "9"], "iterations 8, not 9"),
        (["--refine-tracking"], "refine-tracking False, not True"),
        (["--tracking-noise", "translation=0.01"], "tracking-noise '', not 'translation=0.01'"),
        (["--split", "novel_view"], "split 'train', not 'novel_view'; another pictures' names"),
        (["--background", "white"], "background [1.0, 0.8, 0.6], not [1.0, 1.0, 1.0]"),
        (["--seed", "1"], "seed 0, not 1"),
        ([str(shifted(capture, tmp_path / "shifted"))], "begun with another cameras:"),
        ([str(repainted(capture, tmp_path / "repainted"))], "begun with another pictures:"),
    ):
        if changed[0].startswith("--"):
            assert main([*words, *changed, "--resume"]) == 2
        else:
            assert main([*words[:2], *changed, *words[3:], "--resume"]) == 2
        printed = capsys.readouterr().err.strip()
        assert error in printed, printed
        assert "\n" not in printed
    with monkeypatch.context() as other:  # a library whose preset has other numbers
        small = replace(settings.PRESETS["small"], opacity=0.5)
        other.setitem(settings.PRESETS, "small", small)
        assert main([*words, "--resume"]) == 2
        assert "another settings" in capsys.readouterr().err
    moved = shutil.copytree(capture, tmp_path / "elsewhere")
    same = [*words[:2], str(moved), *words[3:], "--resume", "--half", "--log-every", "1"]
    assert main(same) == 0
    assert (begun / "checkpoints" / "0000008" / "trainer.safetensors").read_bytes() == before
    capsys.readouterr()
    (begun / "run.json").unlink()
    assert main([*words, "--resume"]) == 2
    assert "run.json" in capsys.readouterr().err


def test_refined_tracking_comes_closer_to_the_truth(capture, tiny, tmp_path):
    truth = open_capture(capture)
    noise = "translation=0.006"
    exact = truth.vertices(range(3))
    errors = {}
    for name, refined in (("kept", False), ("refined", True)):
        fit(capture, tmp_path / name, iterations=80, tracking_noise=noise, refine_tracking=refined)
        rows = load_file(tmp_path / name / "model" / "tracking.safetensors")
        avatar = Avatar.from_pretrained(tmp_path / name / "model")
        from meshanim.heads import HeadParameters

        posed = avatar.vertices(HeadParameters(**{k: v[:3] for k, v in rows.items()}))
        # What all timesteps have in common the Gaussians take over.
        moved = (posed - exact).mean(1)
        errors[name] = float((moved - moved.mean(0)).norm(dim=1).mean())
    assert errors["refined"] < 0.6 * errors["kept"]
    assert score(tmp_path / "refined", capture, "novel_view") > score(
        tmp_path / "kept", capture, "novel_view"
    )


def test_noise_is_reproducible_and_of_the_stated_size(capture):
    parameters = open_capture(capture).parameters
    noise = parse_noise("rotation=0.02,expression=0.1")
    one, two = (perturbed(parameters, 4, noise, seed=5) for _ in range(2))
    assert torch.equal(one.rotation, two.rotation)
    assert not torch.equal(one.rotation, perturbed(parameters, 4, noise, seed=6).rotation)
    many = perturbed(parameters, 4, parse_noise("translation=0.003"), seed=0)
    assert many.expression is parameters.expression
    assert many.translation.shape == (4, 3)
    for text in ("rotation", "rotation=x", "hair=1", "jaw=-1"):
        with pytest.raises(OptionError):
            parse_noise(text)


def test_regularizers_by_hand(capture):
    avatar = made_avatar(f"rig:{capture / 'rig.npz'}")
    with torch.no_grad():
        avatar.means[0] = torch.tensor([0.0, 3.0, 4.0])
        avatar.scales[:] = torch.tensor([0.5, 0.5, 0.5]).log()
        avatar.scales[1] = torch.tensor([3.6, 0.1, 4.6]).log()
    weights = Regularizers(0.01, 1.0, 1.0, 0.6)
    wanted = 0.01 * 4 / 80 + 5 / 80
    assert regularization(avatar, weights).item() == pytest.approx(wanted, rel=1e-5)
    visible = torch.zeros(80, dtype=torch.bool)
    visible[1:3] = True
    assert regularization(avatar, weights, visible).item() == pytest.approx(5 / 2, rel=1e-5)
    regularization(avatar, weights).backward()
    assert torch.isfinite(avatar.means.grad).all()


def test_the_true_avatar_scores_as_well_as_8_bits_allow(tmp_path):
    truth = write_capture(tmp_path / "ball")
    truth.save_pretrained(tmp_path / "avatar")
    options = EvaluateAvatarOptions(
        tmp_path / "avatar", tmp_path / "ball", pictures=tmp_path / "sheets", json=tmp_path / "scores.json"
    )
    results = evaluate_avatar(options, progress=False)
    for split in ("novel_view", "novel_expression"):
        assert results.value(split, "avatar", "PSNR full") > 50
        assert results.value(split, "avatar", "PSNR face") > 50
        assert results.value(split, "avatar", "SSIM full") > 0.999
        with Image.open(tmp_path / "sheets" / f"{split}.png") as sheet:
            truth_panel, rendered, error = (np.asarray(sheet)[:20, k * 20 : k * 20 + 20] for k in range(3))
        assert np.abs(truth_panel.astype(int) - rendered).max() <= 1
        assert error.max() <= 4
    assert Results.load(tmp_path / "scores.json").rows == results.rows
    with pytest.raises(OptionError, match="no split"):
        evaluate_avatar(replace(options, splits=("else",)), progress=False)
    with pytest.raises(OptionError, match="examples must be"):
        evaluate_avatar(replace(options, examples=0), progress=False)


def test_sheets_have_a_picture_from_the_side_and_details(tmp_path):
    """Cameras c0 and c2 stand 46 degrees aside, c1 in front; then the head turns."""
    truth = write_capture(tmp_path / "ball")
    truth.save_pretrained(tmp_path / "avatar")
    capture = open_capture(tmp_path / "ball")
    poses = _Poses(truth, capture, tmp_path / "avatar")
    seen = {view.camera: poses.sideways(index) for index, view in enumerate(capture.views)}
    assert seen == pytest.approx({"c0": np.sin(0.8), "c1": 0.0, "c2": np.sin(0.8)}, abs=1e-6)
    turned = replace(capture.parameters, rotation=torch.tensor([[0.0, 0.3, 0.0]]).expand(TIMESTEPS, 3))
    poses = _Poses(truth, replace(capture, parameters=turned), tmp_path / "avatar")
    seen = sorted(poses.sideways(index) for index in range(CAMERAS))
    assert seen == pytest.approx(sorted(np.sin([0.5, 0.3, 1.1])), abs=1e-6)
    assert _examples([0.0, 0.1, 0.9, 0.2, 0.0, 0.3, 0.1], 4) == {0, 2, 4, 6}
    assert _examples([0.0, 0.9, 0.2, 0.1, 0.0, 0.3, 0.1], 3) == {0, 1, 6}
    assert _examples([0.0, 0.9, 0.1], 2) == {0, 1}
    assert _examples([0.0, 0.9, 0.1], 1) == {0}
    assert _examples([0.5], 4) == {0}
    # A region that is the mouth is shown enlarged below, truth beside rendering.
    record = json.loads((tmp_path / "ball" / "capture.json").read_text())
    record["regions"] = ["background", "mouth"]
    (tmp_path / "ball" / "capture.json").write_text(json.dumps(record))
    options = EvaluateAvatarOptions(
        tmp_path / "avatar", tmp_path / "ball", ("novel_view",), pictures=tmp_path / "sheets", examples=2
    )
    evaluate_avatar(options, progress=False)
    with Image.open(tmp_path / "sheets" / "novel_view.png") as sheet:
        assert sheet.size == (60, 2 * 35)
        details = np.asarray(sheet).astype(int)[20:35, :30]
    assert np.abs(details[:, :15] - details[:, 15:]).max() <= 2
    assert np.ptp(details[:, :15], axis=(0, 1)).max() > 50


def test_a_split_without_pictures_is_left_out_or_named(tmp_path):
    truth = write_capture(tmp_path / "ball")
    truth.save_pretrained(tmp_path / "avatar")
    record = json.loads((tmp_path / "ball" / "capture.json").read_text())
    record["splits"]["novel_view"] = []
    (tmp_path / "ball" / "capture.json").write_text(json.dumps(record))
    options = EvaluateAvatarOptions(tmp_path / "avatar", tmp_path / "ball")
    cases = {row.case for row in evaluate_avatar(options, progress=False).rows}
    assert cases == {"Ball", "novel_expression", "playback"}
    with pytest.raises(OptionError, match=r"novel_view .* has no pictures"):
        evaluate_avatar(replace(options, splits=("novel_view",)), progress=False)
    with pytest.raises(OptionError, match=r"novel_view .* has no pictures"):
        fit(tmp_path / "ball", tmp_path / "run", split="novel_view")


def noisy_background(folder: Path) -> None:
    """Put noise wherever a mask of the capture is empty."""
    generator = np.random.default_rng(0)
    for path in sorted((folder / "images").iterdir()):
        image, mask = np.array(Image.open(path)), np.asarray(Image.open(folder / "masks" / path.name))
        image[mask == 0] = generator.integers(0, 256, image.shape)[mask == 0]
        Image.fromarray(image).save(path)


def test_pictures_without_a_plain_background_are_put_on_white(tmp_path):
    write_capture(tmp_path / "ball", background=False, focal=0.9)
    noisy_background(tmp_path / "ball")
    capture = open_capture(tmp_path / "ball")
    assert backdrop(capture, "auto") == ((1.0, 1.0, 1.0), True)
    assert backdrop(capture, "black")[0] == (0.0, 0.0, 0.0)
    with pytest.raises(OptionError, match="no background 'pink'"):
        backdrop(capture, "pink")
    image = PictureStore(capture, (1.0, 1.0, 1.0)).image(0)
    assert image[0, 0].tolist() == [1.0, 1.0, 1.0]
    half = PictureStore(capture, (1.0, 1.0, 1.0))
    assert half.image(0, True).shape == (10, 10, 3)
    assert half.cameras(0, True).intrinsics[0, 0, 0] == half.cameras(0).intrinsics[0, 0, 0] / 2
    for folder in ("masks", "regions"):
        for path in (tmp_path / "ball" / folder).iterdir():
            path.unlink()
    with pytest.raises(OptionError, match="no masks"):
        backdrop(open_capture(tmp_path / "ball"), "auto")


def test_a_plain_background_is_seen_where_nothing_states_it(tmp_path):
    """VHAP and NeRSemble put pictures on white and do not say so."""
    write_capture(tmp_path / "ball", background=False, focal=0.9)
    capture = open_capture(tmp_path / "ball")
    color, composed = backdrop(capture, "auto")
    assert color == pytest.approx((1.0, 0.8, 0.6), abs=1e-9)
    assert not composed
    assert backdrop(capture, "white") == ((1.0, 1.0, 1.0), True)
    assert backdrop(capture, (1.0, 0.8, 0.6)) == (color, False)


def test_an_avatar_is_scored_on_the_background_that_it_was_fitted_on(tmp_path):
    truth = write_capture(tmp_path / "ball", background=False, focal=0.9)
    noisy_background(tmp_path / "ball")
    truth.config = replace(truth.config, background=(0.0, 0.0, 0.0))
    truth.save_pretrained(tmp_path / "avatar")
    # Edges are put on black twice, which thins them; on white the score would be below 10.
    assert score(tmp_path / "avatar", tmp_path / "ball", "novel_view") > 15


def test_lpips_by_a_file_of_weights(tmp_path):
    torch.manual_seed(0)
    state = {}
    for number, before, after, kernel, _, _ in LAYERS:
        state[f"features.{number}.weight"] = (
            torch.randn(after, before, kernel, kernel) * (2 / before) ** 0.5 / kernel
        )
        state[f"features.{number}.bias"] = torch.zeros(after)
    torch.save(state, tmp_path / "alexnet.pth")
    distance = Lpips(tmp_path / "alexnet.pth")
    image = torch.rand(64, 70, 3)
    assert distance(image, image) == 0
    near, far = (distance(image, (image + s * torch.randn(image.shape)).clamp(0, 1)) for s in (0.02, 0.3))
    assert 0 < near < far
    torch.save({"weight": torch.ones(1)}, tmp_path / "other.pth")
    for name in ("other.pth", "missing.pth"):
        with pytest.raises(FileFormatError, match=name):
            Lpips(tmp_path / name)


def test_commands(capture, tiny, tmp_path, capsys):
    words = [
        "avatar",
        "fit",
        str(capture),
        "-o",
        str(tmp_path / "run"),
        "--iterations",
        "12",
        "--size",
        "16",
        "--half",
    ]
    assert main(words) == 0
    assert "gaussians" in capsys.readouterr().out
    assert load_file(tmp_path / "run" / "model" / "avatar.safetensors")["means"].dtype == torch.float16
    assert Avatar.from_pretrained(tmp_path / "run" / "model").config.rest == {"jawOpen": 0.25}
    scores = tmp_path / "scores.json"
    words = ["avatar", "evaluate", str(tmp_path / "run"), str(capture), "--size", "16", "--json", str(scores)]
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert "PSNR face [dB]" in printed
    assert "LPIPS: not measured" in printed
    assert main([*words[:4], "--size", "4000"]) == 2
    assert "have 20 pixels" in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    output = str(tmp_path / "file" / "run")
    assert main(["avatar", "fit", str(capture), "-o", output, "--iterations", "2"]) == 2
    printed = capsys.readouterr().err.strip()
    assert "cannot write" in printed
    assert "\n" not in printed
