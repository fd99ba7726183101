"""An avatar plays animations of any identity and topology; the command writes videos and sheets."""

import json
import shutil

import av
import numpy as np
import pytest
import soundfile
import torch
from PIL import Image

from meshanim.cli import main
from meshanim.cli.animate import AnimateOptions
from meshanim.cli.demo import side_by_side
from meshanim.errors import ShapeError
from meshanim.gaussians.avatar.model import Avatar, AvatarConfig
from meshanim.gaussians.avatar.playback import avatar_template, on_avatar, play
from meshanim.gaussians.camera_paths import camera_path
from meshanim.geometry import decimate
from meshanim.heads import HeadParameters, load_head
from meshanim.motion import MeshSequence
from meshanim.motion.blendshape_track import BlendshapeTrack
from meshanim.render import head_camera
from meshanim.render.lighting import backdrop, developed
from meshanim.render.look import find_person, make_appearance


@pytest.fixture(scope="module")
def head():
    return load_head("default")


@pytest.fixture(scope="module")
def avatar(head):
    """Of somebody other than the template, a few large blots, grey, but white teeth; no colour network."""
    shape = torch.linspace(-1, 1, len(head.shape_names))[None]
    face = torch.arange(0, head.mesh.n_faces, 20)
    config = AvatarConfig(latent=0, background=(0.0, 0.0, 1.0))
    made = Avatar(config, head, shape=shape, face=face, scale=(2.0, 0.5, 2.0), opacity=0.95)
    teeth = torch.from_numpy(np.isin(head.mesh.faces, head.regions["teeth"]).all(1))[face]
    with torch.no_grad():
        made.sh0[:] = torch.where(teeth[:, None, None], 1.7, -0.3)
        made.sh_rest[:] = 0
    return made.eval()


@pytest.fixture(scope="module")
def folder(avatar, tmp_path_factory):
    path = tmp_path_factory.mktemp("avatar") / "model"
    avatar.save_pretrained(path)
    return path


def yawn(head, frames: int = 3) -> MeshSequence:
    """The template opens its jaw and turns its head."""
    weights = torch.linspace(0, 1, frames)
    vertices = head.deform(None, head.expression({"jawOpen": weights})).numpy()
    pose = np.zeros((frames, 3), np.float32)
    pose[:, 1] = np.linspace(0, 0.4, frames)
    return MeshSequence(vertices, 10.0, head.mesh, pose)


def test_moves_are_those_of_the_sequence_on_the_avatars_face(head, avatar):
    sequence = yawn(head)
    vertices = on_avatar(avatar, sequence)
    template = avatar_template(avatar)
    assert np.abs(template - head.mesh.vertices).max() > 1e-3
    np.testing.assert_allclose(vertices[0], template, atol=1e-6)
    weights = head.expression({"jawOpen": 1.0})
    expected = avatar.head(HeadParameters(shape=avatar.shape, expression=weights))[0].detach().numpy()
    np.testing.assert_allclose(vertices[2], expected, atol=1e-5)


def test_another_topology_opens_the_same_mouth(head, avatar):
    small = decimate(head.mesh, 2500)
    moves = yawn(head).vertices - head.mesh.vertices.astype(np.float32)
    carried = small.operator @ moves[2]
    frames = np.stack([small.mesh.vertices, small.mesh.vertices + carried]).astype(np.float32)
    vertices = on_avatar(avatar, MeshSequence(frames, 10.0, small.mesh))
    lips = np.concatenate([head.regions["lips"], head.regions["jaw"]])
    error = np.linalg.norm((vertices[1] - vertices[0] - moves[2])[lips], axis=1)
    assert np.median(error) < 0.25 * np.median(np.linalg.norm(moves[2][lips], axis=1))


def test_pictures_are_those_of_the_posed_head(head, avatar):
    sequence = yawn(head)
    cameras = camera_path("front", avatar_template(avatar), 3, 10.0, 48, 48)
    frames = list(play(avatar, sequence, cameras, background=(0.0, 1.0, 0.0)))
    painted = np.tile(np.float32([0, 1, 0]), (48, 48, 1))
    for frame, again in zip(frames, play(avatar, sequence, cameras, painted)):
        np.testing.assert_allclose(frame, again, atol=1)
    with pytest.raises(ShapeError, match="a colour or a picture"):
        play(avatar, sequence, cameras, painted[:40])
    assert [frame.shape for frame in frames] == [(48, 48, 3)] * 3
    assert frames[0][0, 0].tolist() == [0, 255, 0]
    parameters = HeadParameters(
        expression=head.expression({"jawOpen": 1.0}), neck=torch.from_numpy(sequence.pose[2:])
    )
    posed = head.pose(torch.from_numpy(on_avatar(avatar, sequence)[2:]), parameters.neck, avatar.shape)
    still = type(cameras)(cameras.world_to_camera[0], cameras.intrinsics[0], 48, 48)
    with torch.no_grad():
        seen = avatar(posed, still, (0.0, 1.0, 0.0)).rgb[0, 0]
    np.testing.assert_allclose(frames[2], 255 * seen.clamp(0, 1).numpy(), atol=0.51)
    assert np.abs(frames[2].astype(int) - frames[0]).max() > 60  # it moved
    with pytest.raises(ShapeError, match="one a frame"):
        play(avatar, sequence, still)


def watch_colors(avatar, asked: list):
    """Note what the colour network is driven by."""
    harmonics = avatar.colors.harmonics

    def watched(latents, drive, *more):
        asked.append(drive)
        return harmonics(latents, drive, *more)

    avatar.colors.harmonics = watched


def test_colours_get_the_weights_that_made_the_vertices(head, avatar):
    """With a colour network that shows jawOpen, the picture of an open jaw differs by it."""
    torch.manual_seed(0)
    colored = Avatar(AvatarConfig(latent=2), head, face=torch.arange(0, head.mesh.n_faces, 100))
    sequence = yawn(head)
    asked = []
    watch_colors(colored, asked)
    cameras = camera_path("front", avatar_template(colored), 3, 10.0, 16, 16)
    list(play(colored, sequence, cameras))
    drive = torch.cat(asked)[:, head.expression_names.index("jawOpen")]
    torch.testing.assert_close(drive, torch.tensor([0.0, 0.5, 1.0]), atol=0.06, rtol=0)


def test_a_face_that_rests_in_an_expression_keeps_it(head, tmp_path):
    """Moves are added to the resting face, and colours get its weights."""
    rest = {"mouthSmileLeft": 0.4, "jawOpen": 0.1}
    torch.manual_seed(0)
    made = Avatar(AvatarConfig(latent=2, rest=rest), head, face=torch.arange(0, head.mesh.n_faces, 100))
    made.save_pretrained(tmp_path / "model")
    resting = Avatar.from_pretrained(tmp_path / "model")
    assert resting.config == made.config
    with torch.no_grad():
        expected = head(HeadParameters(expression=head.expression(rest)))[0].numpy()
    np.testing.assert_array_equal(avatar_template(resting), expected)
    sequence = yawn(head)
    np.testing.assert_allclose(on_avatar(resting, sequence)[0], expected, atol=1e-6)
    asked = []
    watch_colors(resting, asked)
    list(play(resting, sequence, camera_path("front", expected, 3, 10.0, 16, 16)))
    drive = torch.cat(asked)[:, [head.expression_names.index(name) for name in rest]]
    torch.testing.assert_close(drive[:2, 0], torch.full((2,), 0.4), atol=0.08, rtol=0)
    torch.testing.assert_close(drive[:2, 1], torch.tensor([0.1, 0.6]), atol=0.06, rtol=0)


def test_the_packaged_avatar_rests_as_its_person_does(head):
    packaged = Avatar.from_pretrained("default")
    person = make_appearance(head, find_person(packaged.config.name))
    np.testing.assert_allclose(avatar_template(packaged), person.template, atol=1e-6)


def run(*words) -> int:
    return main([str(word) for word in words])


def test_the_command_plays_motion_with_sound(head, folder, tmp_path):
    yawn(head, 5).save(tmp_path / "yawn.npz")
    soundfile.write(tmp_path / "a.wav", np.zeros(8000), 16000)
    words = ("avatar", "render", folder, "--motion", tmp_path / "yawn.npz", "--size", 32)
    out = tmp_path / "yawn.mp4"
    assert run(*words, "--audio", tmp_path / "a.wav", "--camera", "orbit", "-o", out) == 0
    with av.open(str(out)) as file:
        pictures = [frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]
        assert len(file.streams.audio) == 1
    assert np.shape(pictures) == (5, 32, 32, 3)
    assert pictures[0][0, 0].tolist() == pytest.approx([0, 0, 255], abs=12)
    track = BlendshapeTrack(("jawOpen",), np.linspace(0, 1, 3, dtype=np.float32)[:, None], 30.0)
    track.save(tmp_path / "yawn.csv")
    recorded = (*words[:4], tmp_path / "yawn.csv", *words[5:], "--audio", tmp_path / "a.wav")
    assert run(*recorded, "-o", tmp_path / "weights.mp4") == 0
    with av.open(str(tmp_path / "weights.mp4")) as file:
        assert len(file.streams.audio) == 1
    out = tmp_path / "yawn.png"
    assert run(*words, "--background", 1, 0, 0, "-o", out) == 0
    sheet = Image.open(out)
    assert sheet.size == (6 * 32, 32)
    assert sheet.getpixel((1, 30)) == (255, 0, 0)


def test_the_command_resamples_motion_and_looks_through_the_cameras_of_a_file(head, avatar, folder, tmp_path):
    yawn(head, 5).save(tmp_path / "yawn.npz")
    cameras = camera_path("orbit", avatar_template(avatar), 10, 20.0, 64, 32)
    entries = {
        f"{index:05d}": {
            "world_to_camera": cameras.world_to_camera[index, 0].tolist(),
            "intrinsics": cameras.intrinsics[index, 0].tolist(),
            "width": 64,
            "height": 32,
        }
        for index in range(10)
    }
    file = tmp_path / "cameras.json"
    file.write_text(json.dumps({"cameras": entries}))
    words = ("avatar", "render", folder, "--motion", tmp_path / "yawn.npz", "--fps", 20, "--size", 64)
    assert run(*words, "--camera", file, "-o", tmp_path / "a.mp4") == 0
    with av.open(str(tmp_path / "a.mp4")) as video:
        assert video.streams.video[0].average_rate == 20
        pictures = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    assert np.shape(pictures) == (10, 32, 64, 3)
    sequence = MeshSequence.load(tmp_path / "yawn.npz").resampled(20.0)
    for picture, exact in zip(pictures, play(avatar, sequence, cameras)):
        assert np.abs(picture.astype(int) - exact).mean() < 6  # what compression leaves
    assert run(*words, "--camera", f"{file}:00009", "-o", tmp_path / "b.png") == 0
    assert Image.open(tmp_path / "b.png").size == (6 * 64, 2 * 32)


def test_the_command_says_speech(folder, tmp_path):
    time = np.arange(3200) / 16000
    soundfile.write(tmp_path / "a.wav", 0.1 * np.sin(2 * np.pi * 120 * time), 16000)
    assert run("animate", tmp_path / "a.wav", "--avatar", folder, "--size", 32, "-o", tmp_path / "a.mp4") == 0
    with av.open(str(tmp_path / "a.mp4")) as file:
        assert len(list(file.decode(video=0))) == 6


def extent(picture: np.ndarray, background: np.ndarray) -> np.ndarray:
    """First row, first and last column of the head, at the height of the ears."""
    away = np.abs(picture.astype(int) - background).max(-1) > 24
    columns = np.flatnonzero(away[: len(away) // 2].any(0))
    return np.array([np.flatnonzero(away.any(1))[0], columns[0], columns[-1]])


def test_mesh_and_avatar_of_one_person_are_framed_alike(tmp_path):
    soundfile.write(tmp_path / "a.wav", np.zeros(1600), 16000)
    options = AnimateOptions(tmp_path / "a.wav", person="", size=256, quality="draft")
    sequence, frames = side_by_side(options, Avatar.from_pretrained("default"))
    background = np.round(255 * developed(backdrop(256, 256)))
    pictures = list(frames)
    assert np.shape(pictures) == (len(sequence), 256, 512, 3) == (3, 256, 512, 3)
    for picture in pictures:
        halves = picture[:, :256], picture[:, 256:]
        for half in halves:
            np.testing.assert_allclose(half[:128, :16], background[:128, :16], atol=1)
        mesh, avatar = (extent(half, background) for half in halves)
        assert np.abs(mesh - avatar).max() <= 2, (mesh, avatar)
        assert np.abs(halves[0].astype(int) - halves[1]).mean() < 4


def test_somebody_elses_avatar_has_its_eyes_where_the_mesh_has_them(head, tmp_path):
    soundfile.write(tmp_path / "a.wav", np.zeros(800), 16000)
    shape = torch.linspace(-1, 1, len(head.shape_names))[None]
    offset = torch.tensor([0.05, -0.05, 0.1]).expand(head.n_vertices, 3)
    eyes = torch.from_numpy(np.flatnonzero(np.isin(head.mesh.faces, head.regions["eyes"]).all(1)))
    config = AvatarConfig(latent=0, background=(0.0, 0.0, 1.0))
    avatar = Avatar(config, head, shape=shape, static_offset=offset, face=eyes, opacity=0.95)
    with torch.no_grad():
        avatar.sh0[:] = torch.tensor([1.7, -1.7, -1.7])
        avatar.sh_rest[:] = 0
    options = AnimateOptions(tmp_path / "a.wav", person="mei", size=96, quality="draft")
    sequence, frames = side_by_side(options, avatar)
    picture = next(frames)[:, 96:].astype(int)
    red = np.argwhere((picture[..., 0] > 150) & (picture[..., 1] < 100)).mean(0)
    person = make_appearance(head, find_person("mei"))
    posed = sequence.posed(head, torch.from_numpy(person.shape)[None])[0, head.regions["eyes"]]
    seen = head_camera(person, 96, 96).project(posed.mean(0))
    np.testing.assert_allclose(red + 0.5, seen[[1, 0]], atol=1.0)


def test_the_demo_knows_the_mesh_alone_and_what_it_cannot_write(tmp_path, capsys, monkeypatch):
    soundfile.write(tmp_path / "a.wav", np.zeros(1600), 16000)
    monkeypatch.setattr("meshanim.cli.demo.CLIP", str(tmp_path / "a.wav"))
    assert run("demo", "--avatar", "none", "-o", tmp_path / "a.npz") == 0
    assert len(MeshSequence.load(tmp_path / "a.npz")) == 3
    assert run("demo", "-o", tmp_path / "a.png", "--size", 32) == 0
    assert Image.open(tmp_path / "a.png").size == (6 * 64, 32)
    capsys.readouterr()
    for words, error in (
        (("-o", tmp_path / "a.npz"), "must be one of .mp4, .png"),
        (("-o", tmp_path / "a.mp4", "--size", 15), "even"),
        (("-o", tmp_path / "missing" / "a.mp4"), "cannot write"),
        (("-o", tmp_path / "a.mp4", "--avatar", tmp_path / "nobody"), "nobody"),
        (("-o", tmp_path / "a.mp4", "--person", "zoe"), "no person named zoe"),
    ):
        assert run("demo", *words) == 2
        printed = capsys.readouterr().err.strip()
        assert error in printed
        assert "\n" not in printed
    assert not (tmp_path / "a.mp4").exists()


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (("-o", "a.mp4"), "give --motion"),
        (("--audio", "a.wav", "-o", "a.gif"), "must be one of .mp4, .png"),
        (("--audio", "a.wav", "--size", 33), "even"),
        (("--audio", "a.wav", "--background", 2, 0, 0), "within 0 to 1"),
        (("--audio", "missing.wav",), "missing.wav"),
        (("--motion", "yawn.npz", "--camera", "behind"), "front, orbit"),
        (("--motion", "yawn.npz", "--camera", "missing.json"), "missing.json"),
        (("--motion", "yawn.npz", "--camera", "two.json"), "2 cameras for 3 frames"),
        (("--motion", "yawn.npz", "--camera", "two.json:left"), "no 'left'"),
        (("--motion", "yawn.npz", "--fps", 0), "fps"),
        (("--motion", "yawn.npz", "--emotion", "joy", "--sway", 0), "--emotion, --sway: how speech is"),
        (("--motion", "yawn.npz", "--model", "a2f"), "--model: how speech is"),
        (("--motion", "cut.npz"), "cut.npz"),
        (("--motion", "yawn.npz", "-o", "missing/a.mp4"), "cannot write missing/a.mp4"),
        (("--motion", "yawn.npz", "-o", "folder.mp4"), "it is a folder"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line(head, folder, tmp_path, monkeypatch, capsys, words, error):
    monkeypatch.chdir(tmp_path)
    yawn(head).save("yawn.npz")
    (tmp_path / "cut.npz").write_bytes((tmp_path / "yawn.npz").read_bytes()[:5000])
    (tmp_path / "folder.mp4").mkdir()
    eye = {"world_to_camera": np.eye(4).tolist(), "intrinsics": np.eye(3).tolist(), "width": 8, "height": 8}
    (tmp_path / "two.json").write_text(json.dumps({"cameras": {"a": eye, "b": eye}}))
    assert run("avatar", "render", folder, *words) == 2
    printed = capsys.readouterr().err.strip()
    assert error in printed
    assert "\n" not in printed
    assert not list(tmp_path.glob("a.mp4")) + list(tmp_path.glob("avatar.mp4")) + list(tmp_path.glob(".*"))


@pytest.mark.parametrize("damage", ["config.json", "avatar.safetensors", "surface.npz", ""])
def test_an_avatar_that_is_not_whole_is_one_line(head, folder, tmp_path, capsys, damage):
    yawn(head).save(tmp_path / "yawn.npz")
    if damage:
        shutil.copytree(folder, tmp_path / "model")
        path = tmp_path / "model" / damage
        path.write_bytes(path.read_bytes()[:-40])
    words = ("avatar", "render", tmp_path / "model", "--motion", tmp_path / "yawn.npz")
    assert run(*words, "-o", tmp_path / "a.mp4") == 2
    printed = capsys.readouterr().err.strip()
    assert str(tmp_path / "model") in printed
    assert "\n" not in printed
    assert not (tmp_path / "a.mp4").exists()
