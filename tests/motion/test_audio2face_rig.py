"""Rigs and solver options of Audio2Face-3D, on a made file of the same layout."""

import json

import numpy as np
import pytest

from meshanim.errors import FileFormatError, OptionError
from meshanim.motion.audio2face_rig import audio2face_solver, read_solver_config
from meshanim.motion.blendshape_solver import SolverOptions

POSES = ("jawOpen", "eyeBlinkLeft", "eyeBlinkRight", "cheekPuff", "mouthFunnel", "tongueOut")
CONFIG = {
    "numPoses": 6,
    "bsSolveActivePoses": [1, 1, 1, 1, 1, 0],
    "bsSolveCancelPoses": [-1, -1, -1, 3, 3, -1],
    "bsSolveSymmetryPoses": [-1, 0, 0, -1, -1, -1],
    "bsWeightMultipliers": [1.2, 1, 1, 1, 1, 1],
    "bsWeightOffsets": [0, 0, 0, 0, 0, 0.5],
    "templateBBSize": 54.7,
    "strengthL1regularization": 1.0,
    "strengthL2regularization": 3.5,
    "strengthTemporalSmoothing": 0.2,
    "strengthSymmetry": 100.0,
}


@pytest.fixture
def files(tmp_path):
    rng = np.random.default_rng(0)
    neutral = rng.normal(0, 9, (300, 3)).astype(np.float32)  # centimetres
    deltas = rng.normal(0, 15, (6, 300, 3)).astype(np.float32)
    mask = np.sort(rng.permutation(300)[:120]).astype(np.int32)
    arrays = {"poseNames": np.array(["neutral", *POSES]), "neutral": neutral, "frontalMask": mask}
    np.savez(tmp_path / "bs_skin.npz", rig_version=np.array("1"), **arrays, **dict(zip(POSES, deltas)))
    (tmp_path / "bs_skin_config.json").write_text(json.dumps({"blendshape_params": CONFIG}))
    return tmp_path, arrays, deltas


def test_options_are_read(files):
    folder, *_ = files
    options = read_solver_config(folder / "bs_skin_config.json", POSES, 120, nvidia_parity=True)
    assert options == SolverOptions(
        l2=35 / 120,
        l1=0.25 / 120,
        temporal=20 / 120,
        symmetry=1000 / 120,
        active=POSES[:5],
        cancelling=(("cheekPuff", "mouthFunnel"),),
        symmetric=(("eyeBlinkLeft", "eyeBlinkRight"),),
        multipliers={"jawOpen": 1.2},
        offsets={"tongueOut": 0.5},
        template_size=54.7,
        nvidia_parity=True,
    )


def test_rig_solves_in_metres(files):
    folder, arrays, deltas = files
    solver = audio2face_solver(folder / "bs_skin.npz", folder / "bs_skin_config.json")
    assert solver.names == POSES
    np.testing.assert_array_equal(solver.sampling.vertices, arrays["frontalMask"])
    weights = np.array([[0.5, 0.3, 0.3, 0.4, 0.0, 0.0]])
    frames = (arrays["neutral"] + np.tensordot(weights, deltas, 1)) / 100
    found = solver(frames)
    assert found[0, 5] == 0.5  # inactive: the offset alone
    assert found[0, 0] == pytest.approx(0.6, abs=0.02)  # times 1.2
    assert found[0, 1] == pytest.approx(found[0, 2], abs=0.02)
    assert found[0, 4] == 0
    ours = audio2face_solver(folder / "bs_skin.npz")
    np.testing.assert_allclose(ours(frames), weights, atol=1e-3)
    rows = np.isin(np.arange(300), arrays["frontalMask"]).astype(np.int32)
    np.savez(folder / "mask.npz", **{**arrays, "frontalMask": rows}, **dict(zip(POSES, deltas)))
    np.testing.assert_allclose(audio2face_solver(folder / "mask.npz")(frames), ours(frames), atol=1e-12)


def test_bad_files_are_named(files):
    folder, arrays, deltas = files
    rig, config = folder / "bs_skin.npz", folder / "bs_skin_config.json"
    (folder / "cut.npz").write_bytes(rig.read_bytes()[:500])
    np.savez(folder / "lacks.npz", **arrays)
    far = {**arrays, "frontalMask": np.array([5, 300], np.int32)}
    np.savez(folder / "far.npz", **far, **dict(zip(POSES, deltas)))
    for name in ("none", "cut", "lacks", "far"):
        with pytest.raises(FileFormatError, match=name):
            audio2face_solver(folder / f"{name}.npz")
    with pytest.raises(OptionError, match="JSON"):
        audio2face_solver(rig, nvidia_parity=True)
    for change, message in (
        ({"numPoses": 7}, "7 poses"),
        ({"bsSolveActivePoses": [1, 0]}, "2 entries"),
        ({"bsSolveCancelPoses": [1, 1, 1, -1, -1, -1]}, "shared by 3"),
        ({"strengthSymmetry": "much"}, "wrong kind"),
    ):
        config.write_text(json.dumps(CONFIG | change))
        with pytest.raises(FileFormatError, match=message):
            audio2face_solver(rig, config)
    for text in ("{", "[]", '{"a": 1}'):
        config.write_text(text)
        with pytest.raises(FileFormatError, match="config"):
            audio2face_solver(rig, config)
