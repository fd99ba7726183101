"""Pose tracks from files, from landmarks and from video."""

import importlib.util

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from meshanim.errors import FileFormatError, OptionError, ShapeError
from meshanim.motion import smooth_rotations
from meshanim.motion.pose_track import (
    PoseTrack,
    bridge_rotations,
    center_rotations,
    load_pose_track,
    pose_statistics,
    resample_rotations,
)
from meshanim.motion.video_pose import landmark_geometry, pose_from_landmarks, pose_from_video


def angle_between(a, b):
    return (Rotation.from_rotvec(a).inv() * Rotation.from_rotvec(b)).magnitude()


def turning(frames, axis=(0.0, 1.0, 0.0), step=0.05):
    return np.outer(np.arange(frames) * step, axis)


def test_the_filter_keeps_constant_and_linear_tracks():
    turn = Rotation.from_rotvec([1.0, 2.0, -0.5])
    still = np.repeat(turn.as_rotvec()[None], 30, 0)
    assert angle_between(smooth_rotations(still), still).max() < 1e-9
    linear = (turn * Rotation.from_rotvec(turning(60))).as_rotvec()
    assert angle_between(smooth_rotations(linear), linear)[7:-7].max() < 1e-9
    assert angle_between(smooth_rotations(linear), linear).max() > 1e-3  # reflected ends bend it


def test_the_filter_calms_a_noisy_track_by_what_the_kernel_says():
    generator = np.random.default_rng(0)
    noise = generator.normal(size=(4000, 3)) * 0.01
    smooth = smooth_rotations(noise)
    # Second differences of white noise: the factor is that of the kernel's own second difference.
    weights = np.exp(-0.5 * np.arange(-7, 8) ** 2)
    kernel = weights / weights.sum()
    expected = np.linalg.norm([1, -2, 1]) / np.linalg.norm(np.convolve(kernel, [1, -2, 1]))
    assert expected > 5

    def jitter(track):
        return np.diff(track, n=2, axis=0).std()

    assert jitter(noise) / jitter(smooth) == pytest.approx(expected, rel=0.05)


def test_bridging_turns_the_short_way():
    track = turning(12, step=0.3) + np.array([0.0, 2.8, 0.0])  # passes pi
    broken = track.copy()
    broken[[0, 4, 5, 11]] = np.nan
    found = bridge_rotations(broken, 2)
    assert angle_between(found[1:11], track[1:11]).max() < 1e-9
    assert angle_between(found[[0, 11]], track[[1, 10]]).max() < 1e-9
    with pytest.raises(OptionError, match="4 to 5"):
        bridge_rotations(broken, 1)
    with pytest.raises(OptionError, match="missing"):
        bridge_rotations(np.full((3, 3), np.nan), 5)


@pytest.mark.parametrize(("old", "new"), [(60.0, 30.0), (25.0, 60.0), (30.0, 30.0)])
def test_resampling_keeps_time(old, new):
    track = turning(int(old), step=3 / old)
    found = resample_rotations(track, old, new, int(new))
    at = (np.arange(int(new)) + 0.5) / new
    expected = np.clip((at * old - 0.5) * 3 / old, 0, (int(old) - 1) * 3 / old)
    assert np.allclose(angle_between(found, np.zeros_like(found)), expected, atol=1e-9)
    longer = resample_rotations(track, old, new, int(2 * new))
    assert angle_between(longer[-1:], track[-1:]).max() < 1e-9
    with pytest.raises(OptionError, match="resample"):
        resample_rotations(track[:0], old, new, 3)


def test_a_centred_track_has_no_mean_turn():
    base = Rotation.from_rotvec([0.0, 2.5, 0.4])
    sway = 0.2 * np.sin(np.linspace(0, 40, 400))[:, None] * [0.3, 1.0, 0.1]
    found = center_rotations((base * Rotation.from_rotvec(sway)).as_rotvec())
    assert Rotation.from_rotvec(found).mean().magnitude() < 1e-8
    assert np.allclose(found - found.mean(0), sway - sway.mean(0), atol=2e-2)


def test_tracked_poses_of_flame_turn_globally_then_at_the_neck(tmp_path):
    generator = np.random.default_rng(1)
    rotation, neck = generator.normal(size=(2, 5, 3)).astype(np.float32) * 0.4
    expected = (Rotation.from_rotvec(rotation) * Rotation.from_rotvec(neck)).as_rotvec()
    np.savez(tmp_path / "tracked.npz", rotation=rotation, neck=neck, fps=24.0, expression=np.zeros((5, 100)))
    track = load_pose_track(tmp_path / "tracked.npz")
    assert track.fps == 24
    assert np.allclose(track.rotation, expected, atol=1e-6)
    folder = tmp_path / "flame_param"
    folder.mkdir()
    for i in range(5):
        np.savez(folder / f"{i:05d}.npz", rotation=rotation[i : i + 1], neck_pose=neck[i : i + 1])
    assert np.allclose(load_pose_track(folder, 25.0).rotation, expected, atol=1e-6)
    np.save(tmp_path / "plain.npy", rotation)
    assert np.array_equal(load_pose_track(tmp_path / "plain.npy", 30.0).rotation, rotation)


def test_bad_tracks_are_named(tmp_path):
    np.save(tmp_path / "wide.npy", np.zeros((4, 6)))
    np.savez(tmp_path / "other.npz", jaw=np.zeros((4, 3)))
    np.savez(tmp_path / "uneven.npz", rotation=np.zeros((4, 3)), neck=np.zeros((5, 3)), fps=30.0)
    np.save(tmp_path / "nan.npy", np.full((4, 3), np.nan))
    np.save(tmp_path / "good.npy", np.zeros((4, 3)))
    (tmp_path / "cut.npy").write_bytes((tmp_path / "good.npy").read_bytes()[:-8])
    np.save(tmp_path / "pickled.npy", np.array([{}], dtype=object), allow_pickle=True)
    for name, match in [
        ("wide.npy", r"expected float \(frames, 3\)"),
        ("other.npz", "none of pose"),
        ("uneven.npz", "5 of neck"),
        ("nan.npy", "finite"),
        ("cut.npy", "cannot be read"),
        ("pickled.npy", "cannot be read"),
        ("missing.npz", "cannot be read"),
    ]:
        with pytest.raises(FileFormatError, match=match):
            load_pose_track(tmp_path / name, 30.0)
    with pytest.raises(FileFormatError, match="frame rate"):
        load_pose_track(tmp_path / "good.npy")
    with pytest.raises(ShapeError):
        PoseTrack(np.full((2, 3), np.inf), 30.0)


def test_statistics_of_a_steady_turn():
    found = pose_statistics([PoseTrack(turning(11, step=0.1), 20.0)], bins=10)
    assert found.largest == pytest.approx(1.0)
    assert found.mean == pytest.approx(0.5)
    assert found.speed == pytest.approx(2.0)
    assert found.counts.sum() == 11
    with pytest.raises(OptionError, match="no poses"):
        pose_statistics([])


def seen(rotations, layout, width=640, height=480, focal=900.0, person=1.0):
    """Landmarks of the default head, turned, before a camera 0.9 m away and a little aside."""
    points, _ = landmark_geometry(layout)
    turned = np.einsum("tij,lj->tli", Rotation.from_rotvec(rotations).as_matrix(), person * points)
    depth = 0.9 - turned[..., 2]
    x = width / 2 + focal * (turned[..., 0] + 0.05) / depth
    y = height / 2 - focal * (turned[..., 1] - 0.02) / depth
    return np.stack([x, y], axis=-1)


@pytest.mark.parametrize("layout", ["mediapipe", "ibug68"])
def test_landmarks_give_back_the_pose(layout):
    rotations = np.array([[0, 0, 0], [0.3, 0, 0], [0, 0.6, 0], [0, -0.4, 0.3], [-0.3, 0.2, -0.5]], float)
    landmarks = seen(rotations, layout)
    found = pose_from_landmarks(landmarks, 640, 480, 900.0)
    assert np.degrees(angle_between(found, rotations)).max() < 0.05
    # A fifth of the landmarks far off, half a pixel of noise on the rest, frames without a face between.
    generator = np.random.default_rng(0)
    noisy = landmarks + generator.normal(size=landmarks.shape) * 0.5
    usable = np.flatnonzero(np.isfinite(noisy[0, :, 0]))
    noisy[:, usable[:: 5 if layout == "mediapipe" else 13]] += 40
    noisy = np.insert(noisy, 2, np.nan, axis=0)
    found = pose_from_landmarks(noisy, 640, 480, 900.0)
    assert np.isnan(found[2]).all()
    limit = 1.0 if layout == "mediapipe" else 6.0
    assert np.degrees(angle_between(np.delete(found, 2, 0), rotations)).max() < limit


def test_unknown_landmarks_are_named():
    with pytest.raises(ShapeError, match="5 landmarks"):
        pose_from_landmarks(np.zeros((1, 5, 2)), 640, 480)
    with pytest.raises(OptionError, match="ibug68"):
        landmark_geometry("dlib")


def test_a_file_that_is_no_video_is_named(tmp_path):
    (tmp_path / "talk.mp4").write_text("not a video")
    with pytest.raises(FileFormatError, match="cannot read"):
        pose_from_video(tmp_path / "talk.mp4")


@pytest.mark.skipif(
    importlib.util.find_spec("mediapipe") is None,
    reason="needs mediapipe: pip install 'meshanim[video-pose]'",
)
def test_a_rendered_head_that_turns_is_tracked(tmp_path):
    from meshanim.export.video import write_video
    from meshanim.heads import load_head
    from meshanim.render.look import PEOPLE, make_appearance
    from meshanim.render.renderer import Renderer, head_camera

    head = load_head("default")
    appearance = make_appearance(head, PEOPLE["lena"])
    renderer = Renderer(head, appearance, quality="draft", camera=head_camera(appearance, 512, 512))
    template = torch.from_numpy(np.asarray(appearance.template, np.float32))[None]
    true = turning(16, (0.0, 1.0, 0.0), 0.05) - [0.0, 0.4, 0.0]
    frames = (
        renderer.frame(head.pose(template, torch.from_numpy(turn[None]).float())[0].numpy()) for turn in true
    )
    write_video(tmp_path / "talk.mp4", frames, 25.0)
    found = pose_from_video(tmp_path / "talk.mp4")
    assert found.fps == 25
    assert len(found) == 16
    turn = center_rotations(found.rotation)
    # Half a radian and more from end to end, about the vertical axis.
    assert turn[-1, 1] - turn[0, 1] == pytest.approx(0.75, rel=0.25)
    assert np.degrees(angle_between(turn, center_rotations(true))).max() < 8
