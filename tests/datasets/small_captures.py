"""Captures of a few small pictures in every layout, with exact file names and types."""

import json

import numpy as np
from PIL import Image

from meshanim.render import look_at

WIDTH, HEIGHT = 12, 8
TIMESTEPS = 3


def pose(camera: int) -> np.ndarray:
    """World to camera, OpenCV."""
    return look_at([0.3 * camera - 0.3, 0.1 * camera, 1.0], [0.0, 0.02, 0.0])


INTRINSICS = np.array([[20.0, 0.0, 6.5], [0.0, 21.0, 3.75], [0.0, 0.0, 1.0]])


def image(timestep: int, camera: int) -> np.ndarray:
    generator = np.random.default_rng([timestep, camera])
    return generator.integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)


def mask(timestep: int, camera: int) -> np.ndarray:
    return image(timestep, camera + 100)[..., 0].copy()


def write_png(path, array) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(array).save(path)


def parameters(shape: int = 4, expression: int = 5) -> dict[str, np.ndarray]:
    generator = np.random.default_rng(9)
    columns = {
        "expression": expression, "rotation": 3, "neck": 3, "jaw": 3, "eyes": 6, "translation": 3,
    }  # fmt: skip
    arrays = {
        name: generator.normal(size=(TIMESTEPS, size)).astype(np.float32) * 0.1
        for name, size in columns.items()
    }
    return {**arrays, "shape": generator.normal(size=(1, shape)).astype(np.float32)}


def plain_folder(directory, cameras=("a", "b"), regions=True, masks=True, splits=True) -> None:
    """The plain multi-view folder."""
    for timestep in range(TIMESTEPS):
        for number, camera in enumerate(cameras):
            name = f"{timestep:05d}_{camera}.png"
            write_png(directory / "images" / name, image(timestep, number))
            if masks:
                write_png(directory / "masks" / name, mask(timestep, number))
            if regions:
                write_png(directory / "regions" / name, mask(timestep, number) % 3)
    listed = {
        camera: {
            "world_to_camera": pose(number).tolist(),
            "intrinsics": INTRINSICS.tolist(),
            "width": WIDTH,
            "height": HEIGHT,
        }
        for number, camera in enumerate(cameras)
    }
    (directory / "cameras.json").write_text(json.dumps({"cameras": listed}))
    np.savez(directory / "head.npz", **parameters())
    if splits:
        record = {
            "head": "default",
            "background": [0.5, 0.5, 0.5],
            "regions": ["background", "skin", "eyes"] if regions else [],
            "splits": {"train": ["00000_a", "00001_a"], "novel_view": ["00000_b"]},
        }
        (directory / "capture.json").write_text(json.dumps(record))


def vhap_export(directory, timesteps=TIMESTEPS, cameras=3, first=0, vertices=5) -> dict:
    """What vhap/export_as_nerf_dataset.py writes; also returns the content of transforms.json."""
    frames = []
    for timestep in range(timesteps):
        for camera in range(cameras):
            name = f"{timestep:05d}_{camera:02d}.png"
            write_png(directory / "images" / name, image(first + timestep, camera))
            plane = mask(first + timestep, camera)
            write_png(directory / "fg_masks" / name, np.repeat(plane[..., None], 3, axis=2))
            camera_to_world = np.linalg.inv(pose(camera)) @ np.diag([1.0, -1.0, -1.0, 1.0])
            frames.append(
                {
                    "timestep_index": timestep,
                    "timestep_index_original": 3 * timestep,
                    "timestep_id": f"frame_{3 * timestep:05d}",
                    "camera_index": camera,
                    "camera_id": str(222200036 + camera),
                    **intrinsics_of_vhap(),
                    "transform_matrix": camera_to_world.tolist(),
                    "file_path": f"images/{name}",
                    "fg_mask_path": f"fg_masks/{name}",
                    "flame_param_path": f"flame_param/{timestep:05d}.npz",
                }
            )
    values = parameters(300, 100)
    offset = np.random.default_rng(5).normal(size=(1, vertices, 3)).astype(np.float32)
    (directory / "flame_param").mkdir(parents=True)
    for timestep in range(timesteps):
        row = slice(timestep, timestep + 1)
        arrays = {
            "translation": values["translation"][row] + first,
            "rotation": values["rotation"][row],
            "neck_pose": values["neck"][row],
            "jaw_pose": values["jaw"][row],
            "eyes_pose": values["eyes"][row],
            "shape": values["shape"][0],
            "expr": values["expression"][row],
            "static_offset": offset,
        }
        np.savez(directory / "flame_param" / f"{timestep:05d}.npz", **arrays)
    np.savez(directory / "canonical_flame_param.npz", **arrays)
    content = {
        "frames": frames,
        **intrinsics_of_vhap(),
        "timestep_indices": list(range(timesteps)),
        "camera_indices": list(range(cameras)),
    }
    for name in ("transforms.json", "transforms_backup.json", "transforms_backup_flame.json"):
        (directory / name).write_text(json.dumps(content, indent=4))
    return content


def intrinsics_of_vhap() -> dict[str, float]:
    return {
        "cx": INTRINSICS[0, 2],
        "cy": INTRINSICS[1, 2],
        "fl_x": INTRINSICS[0, 0],
        "fl_y": INTRINSICS[1, 1],
        "h": HEIGHT,
        "w": WIDTH,
        "camera_angle_x": 2 * np.arctan(WIDTH / (2 * INTRINSICS[0, 0])),
        "camera_angle_y": 2 * np.arctan(HEIGHT / (2 * INTRINSICS[1, 1])),
    }


def combined_vhap(root) -> None:
    """Two sequences for training and one for testing, as combine_nerf_datasets.py joins them."""
    target = root / "UNION"
    target.mkdir(parents=True)
    start = 0
    tables: dict[str, dict] = {}
    for sequence, split in (("074_EMO-1", "train"), ("074_EXP-2", "train"), ("074_FREE", "test")):
        content = vhap_export(root / sequence, first=start)
        for frame in content["frames"]:
            del frame["timestep_index_original"], frame["timestep_id"]
            frame["timestep_index"] += start
            for key in ("file_path", "flame_param_path", "fg_mask_path"):
                frame[key] = f"../{sequence}/{frame[key]}"
        indices = [start + timestep for timestep in content["timestep_indices"]]
        start += TIMESTEPS
        kept = tables.setdefault(split, {**content, "frames": [], "timestep_indices": []})
        kept["frames"] += content["frames"]
        kept["timestep_indices"] += indices
    train = tables["train"]
    tables["val"] = {**train, "frames": [f for f in train["frames"] if f["camera_index"] == 2]}
    train["frames"] = [f for f in train["frames"] if f["camera_index"] != 2]
    for split, content in tables.items():
        (target / f"transforms_{split}.json").write_text(json.dumps(content, indent=4))
