"""A small tree in the layout of Audio2Face-3D's example data, and writers of its caches, byte by byte."""

import json
import struct

import numpy as np
from made_files import write_sound


def chunk(tag, content):
    return tag + struct.pack(">I", len(content)) + content + b"\0" * (-len(content) % 4)


def group(kind, *chunks):
    return chunk(b"FOR4", kind + b"".join(chunks))


def maya_file(path, frames, start=0, channel=b"skinShape", double=False, times=True, more=()):
    """One .mc file with points (T, V, 3), 200 ticks a frame."""
    ticks = [200 * (start + k) for k in range(len(frames))]
    out = group(
        b"CACH",
        chunk(b"VRSN", b"0.1\0"),
        chunk(b"STIM", struct.pack(">i", ticks[0])),
        chunk(b"ETIM", struct.pack(">i", ticks[-1])),
    )
    for tick, points in zip(ticks, frames):
        parts = [chunk(b"TIME", struct.pack(">i", tick))] if times else []
        for name, values in [*more, (channel, points)]:
            parts += [
                chunk(b"CHNM", name + b"\0"),
                chunk(b"SIZE", struct.pack(">i", len(values))),
                chunk(b"DVCA" if double else b"FVCA", values.astype(">f8" if double else ">f4").tobytes()),
            ]
        out += group(b"MYCH", *parts)
    path.write_bytes(out)


def pc2_file(path, frames):
    header = struct.pack("<12siiffi", b"POINTCACHE2\0", 1, frames.shape[1], 0.0, 1.0, len(frames))
    path.write_bytes(header + frames.astype("<f4").tobytes())


SKIN, TONGUE = 40, 9


def write_tree(folder, frames=24):
    """Three shots in centimetres at 30 frames a second: skin as .mc, .pc2 and .npy; returns their points."""
    generator = np.random.default_rng(0)
    for name in ("audio", "geom/skin", "geom/tongue", "xform"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    skin = generator.uniform(-8, 8, (SKIN, 3)).astype(np.float32)
    tongue = generator.uniform(-1, 1, (TONGUE, 3)).astype(np.float32)
    jaw = np.array([[3, -4, 0], [-3, -4, 0], [1, -4, 5], [-1, -4, 5], [0, -4, 6]], np.float32)
    np.save(folder / "geom/skin/neutral_pose.npy", skin)
    np.save(folder / "geom/skin/eye_close_pose_delta.npy", 0.1 * np.ones_like(skin))
    np.save(folder / "geom/tongue/neutral_pose.npy", tongue)
    np.save(folder / "xform/jaw_keypoints_neutral.npy", jaw)
    lips = {"upper": [0, 1, 2, 3, 4], "lower": [5, 6, 7, 8, 9]}
    (folder / "geom/skin/lip_dist_vertex_list.json").write_text(json.dumps(lips))
    sizes = {
        "upper_lip": {"top": [10, 11, 12, 13, 14], "bottom": [0, 1, 2, 3, 4]},
        "lower_lip": {"top": [5, 6, 7, 8, 9], "bottom": [15, 16, 17, 18, 19]},
    }
    (folder / "geom/skin/lip_size_vertex_list.json").write_text(json.dumps(sizes))
    eyes = {"right": {"upper": [20], "lower": [21]}, "left": {"upper": [22], "lower": [23]}}
    (folder / "geom/skin/eye_dist_vertex_list.json").write_text(json.dumps(eyes))
    np.save(folder / "xform/eye_saccade_rotations.npy", generator.normal(size=(50, 2)))
    np.save(folder / "xform/eye_blink_keys.npy", generator.uniform(size=30))
    truth, jaws, turned = {}, {}, {}
    for k, shot in enumerate(("cp1", "eg1", "eg2")):
        moved = skin + generator.normal(0, 0.2, (frames, SKIN, 3)).astype(np.float32)
        licked = tongue + generator.normal(0, 0.2, (frames, TONGUE, 3)).astype(np.float32)
        for part, points in (("skin", moved), ("tongue", licked)):
            place = folder / "cache" / part / shot
            place.mkdir(parents=True, exist_ok=True)
            if k == 0:
                (place / f"{shot}.xml").write_text("<Autodesk_Cache_File/>")
                maya_file(place / f"{shot}.mc", points)
            elif k == 1:
                pc2_file(place / f"{shot}.pc2", points)
            else:
                np.save(place / f"{shot}.npy", points)
        jaws[shot] = generator.normal(0, 0.1, (frames, 5, 3)).astype(np.float32)
        turned[shot] = generator.normal(0, 5, (frames, 2, 2)).astype(np.float32)
        truth[shot] = np.concatenate([moved, licked, jaw + jaws[shot]], axis=1) / 100
        write_sound(folder / f"audio/{shot}.wav", frames / 30, seed=k)
    np.savez(folder / "xform/jaw_keypoints_cache_all.npz", **jaws)
    np.savez(folder / "xform/eye_rotations_all.npz", **turned)
    return truth, {shot: np.radians(angles) for shot, angles in turned.items()}
