"""A ball that opens its mouth, and pictures of it: a capture whose truth is known."""

from pathlib import Path

import numpy as np
import torch
import trimesh

from meshanim.datasets.capture import Picture
from meshanim.datasets.capture_folder import write_cameras, write_parameters, write_picture, write_record
from meshanim.gaussians.avatar import Avatar, AvatarConfig
from meshanim.gaussians.cameras import Cameras
from meshanim.heads import HeadParameters, load_head

SIZE, TIMESTEPS, CAMERAS = 20, 4, 3
BACKGROUND = (1.0, 0.8, 0.6)


def write_rig(path: Path) -> str:
    """A head of 42 vertices and 80 triangles with two expressions; gives its name."""
    ball = trimesh.creation.icosphere(1, 0.1)
    below, front = ball.vertices[:, 1] < -0.03, ball.vertices[:, 2] > 0.05
    deltas = np.zeros((2, len(ball.vertices), 3), np.float32)
    deltas[0, below, 1] = -0.04
    deltas[1, front, 2] = 0.03
    np.savez(
        path,
        neutral=ball.vertices.astype(np.float32),
        faces=ball.faces,
        names=np.array(["jawOpen", "mouthPucker"]),
        deltas=deltas,
    )
    return f"rig:{path}"


def made_avatar(head: str, **changes) -> Avatar:
    """One coloured Gaussian a triangle."""
    torch.manual_seed(3)
    config = AvatarConfig(**({"head": head, "latent": 0, "background": BACKGROUND} | changes))
    avatar = Avatar(config, load_head(head), scale=(0.7, 0.2, 0.7), opacity=0.9)
    with torch.no_grad():
        avatar.sh0[:] = torch.rand(avatar.sh0.shape) * 2 - 1
    return avatar.eval()


def made_cameras(count: int = CAMERAS, size: int = SIZE, focal: float = 1.7) -> Cameras:
    poses = []
    for angle in np.linspace(-0.8, 0.8, count):
        pose = np.eye(4)
        pose[:3, :3] = np.diag([1.0, -1, -1]) @ [
            [np.cos(angle), 0, -np.sin(angle)],
            [0, 1, 0],
            [np.sin(angle), 0, np.cos(angle)],
        ]
        pose[2, 3] = 0.5
        poses.append(pose)
    intrinsics = np.array([[focal * size, 0, size / 2], [0, focal * size, size / 2], [0, 0, 1]])
    stacked = torch.tensor(np.stack(poses)).float()
    return Cameras(stacked, torch.tensor(intrinsics).float().expand(count, 3, 3), size, size)


def made_parameters(count: int = TIMESTEPS) -> HeadParameters:
    steps = torch.linspace(0, 1, count)[:, None]
    return HeadParameters(expression=torch.cat([steps, steps.flip(0) ** 2], 1))


def write_capture(directory: Path, background: bool = True, focal: float = 1.7) -> Avatar:
    """Pictures of `made_avatar`; the last camera is a novel view, the last timestep a novel expression.

    With a focal length of 1.7 sizes the ball fills them."""
    directory.mkdir()
    avatar, cameras, parameters = (
        made_avatar(write_rig(directory / "rig.npz")),
        made_cameras(focal=focal),
        made_parameters(),
    )
    with torch.no_grad():
        rendering = avatar(parameters, cameras)
    splits: dict[str, list[str]] = {"train": [], "novel_view": [], "novel_expression": []}
    for step in range(TIMESTEPS):
        for camera in range(CAMERAS):
            name = f"{step:05d}_c{camera}"
            image = (rendering.rgb[step, camera].clamp(0, 1).numpy() * 255).round().astype(np.uint8)
            alpha = rendering.alpha[step, camera].numpy()
            regions = (alpha > 0.5).astype(np.uint8)
            write_picture(directory, name, Picture(image, (alpha * 255).astype(np.uint8), regions))
            kind = "novel_expression" if step == TIMESTEPS - 1 else "novel_view" if camera == 1 else "train"
            splits[kind].append(name)
    matrices = cameras.world_to_camera.double().numpy(), cameras.intrinsics.double().numpy()
    write_cameras(directory, {f"c{i}": (m, k, SIZE, SIZE) for i, (m, k) in enumerate(zip(*matrices))})
    write_parameters(directory, parameters, range(TIMESTEPS))
    record = {"name": "Ball", "head": avatar.config.head, "regions": ["background", "skin"], "splits": splits}
    record["rest"] = {"jawOpen": 0.25}
    write_record(directory, record | ({"background": list(BACKGROUND)} if background else {}))
    return avatar
