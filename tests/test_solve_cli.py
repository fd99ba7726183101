"""`meshanim solve`, `data personalize` and `bench solve` as a user runs them."""

import json

import numpy as np
import pytest
import trimesh

from meshanim.cli import main
from meshanim.geometry import decimate
from meshanim.heads import load_head
from meshanim.motion import MeshSequence
from meshanim.motion.blendshape_track import BlendshapeTrack


def run(*words) -> int:
    return main([str(word) for word in words])


@pytest.fixture(scope="module")
def head():
    return load_head("default")


@pytest.fixture(scope="module")
def talk(head, tmp_path_factory):
    """Twenty frames of a person who says ah, smiles and blinks."""
    track = BlendshapeTrack(
        ("jawOpen", "mouthSmileLeft", "eyeBlinkRight"),
        np.stack([np.linspace(0, 0.6, 20), np.full(20, 0.3), np.linspace(1, 0, 20)], 1),
        25.0,
        np.full((20, 3), 0.1, np.float32),
    )
    path = tmp_path_factory.mktemp("talk") / "talk.npz"
    track.animate(head, head.template(head.person("ana")).numpy()[0]).save(path)
    return path, track


def test_motion_to_weights_and_back(talk, tmp_path, capsys):
    path, truth = talk
    words = ["-o", tmp_path / "w.csv", "--replay", tmp_path / "back.npz", "--json", tmp_path / "r.json"]
    assert run("solve", path, *words) == 0
    printed = capsys.readouterr().out
    assert "residual rms [mm]" in printed
    assert "20 frames, 53 shapes" in printed
    found = BlendshapeTrack.load(tmp_path / "w.csv")
    assert found.fps == 25
    for name, column in zip(truth.names, truth.weights.T):
        np.testing.assert_allclose(found.weights[:, found.names.index(name)], column, atol=0.02)
    motion, replay = MeshSequence.load(path), MeshSequence.load(tmp_path / "back.npz")
    error = 1000 * np.linalg.norm(replay.vertices - motion.vertices, axis=2)
    assert error.max() < 0.1
    np.testing.assert_array_equal(replay.pose, motion.pose)
    rows = json.loads((tmp_path / "r.json").read_text())["rows"]
    whole = [row for row in rows if row["case"].startswith("all")]
    largest = next(row for row in whole if row["metric"] == "residual largest")
    assert largest["value"] == pytest.approx(error.max(), rel=1e-3)
    assert largest["unit"] == "mm"


def test_terms_by_option(talk, tmp_path):
    path, _ = talk
    words = ["--active", "jawOpen", "mouthSmileLeft", "mouthSmileRight", "--symmetry", "10"]
    words += ["--multipliers", "jawOpen", "0.5", "--samples", "400", "--temporal", "0"]
    assert run("solve", path, "-o", tmp_path / "w.npz", *words) == 0
    found = BlendshapeTrack.load(tmp_path / "w.npz")
    used = [name for name, column in zip(found.names, found.weights.T) if column.any()]
    assert set(used) == {"jawOpen", "mouthSmileLeft", "mouthSmileRight"}
    column = {name: found.weights[:, found.names.index(name)] for name in used}
    np.testing.assert_allclose(column["mouthSmileLeft"], column["mouthSmileRight"], atol=0.01)
    assert column["jawOpen"].max() == pytest.approx(0.3, abs=0.05)
    np.testing.assert_array_equal(found.pose, np.full((20, 3), 0.1, np.float32))


def test_config_of_a_rig(talk, head, tmp_path):
    count = len(head.expression_names)
    config = {"numPoses": count, "strengthL2regularization": 0.01, "strengthSymmetry": 0}
    (tmp_path / "config.json").write_text(json.dumps({"blendshape_params": config}))
    assert run("solve", talk[0], "-o", tmp_path / "w.npz", "--config", tmp_path / "config.json") == 0
    weights = BlendshapeTrack.load(tmp_path / "w.npz").weights
    assert weights[:, head.expression_names.index("jawOpen")].max() == pytest.approx(0.6, abs=0.05)


def test_a_character_of_another_topology(talk, head, tmp_path, capsys):
    """Shapes for a mesh from a file; its motion is solved for with them, and with the default head's."""
    coarse = decimate(head.mesh, 4000)
    trimesh.Trimesh(100 * coarse.mesh.vertices, coarse.mesh.faces, process=False).export(
        tmp_path / "character.obj", digits=9
    )
    out = tmp_path / "character.npz"
    assert run("data", "personalize", tmp_path / "character.obj", "-o", out, "--scale", "0.01") == 0
    assert "53 shapes on" in capsys.readouterr().out
    rig = load_head(f"rig:{out}")
    np.testing.assert_allclose(rig.mesh.vertices, coarse.mesh.vertices, atol=1e-7)
    motion = MeshSequence.load(talk[0])
    moved = motion.vertices - motion.mesh.vertices.astype(np.float32)
    frames = (coarse.mesh.vertices + np.stack([coarse.operator @ move for move in moved[::4]])).astype(
        np.float32
    )
    MeshSequence(frames, 25.0, rig.mesh).save(tmp_path / "other.npz")
    for name in (f"rig:{out}", "default"):
        assert run("solve", tmp_path / "other.npz", "-o", tmp_path / "w.npz", "--head", name) == 0
        found = BlendshapeTrack.load(tmp_path / "w.npz")
        jaw = found.weights[:, found.names.index("jawOpen")]
        np.testing.assert_allclose(jaw, np.linspace(0, 0.6, 20)[::4], atol=0.1)
    words = ("--replay", tmp_path / "back.npz", "--replay-head", f"rig:{out}")
    assert run("solve", talk[0], "-o", tmp_path / "w.npz", *words) == 0
    track, replay = BlendshapeTrack.load(tmp_path / "w.npz"), MeshSequence.load(tmp_path / "back.npz")
    np.testing.assert_allclose(replay.vertices, track.animate(rig).vertices, atol=1e-6)
    np.testing.assert_array_equal(replay.pose, motion.pose)


def test_bad_input_is_one_line_and_exit_2(talk, tmp_path, capsys):
    path, _ = talk
    (tmp_path / "broken.npz").write_bytes(path.read_bytes()[:1000])
    (tmp_path / "marks.json").write_text("[[1, 2], [3]]")
    (tmp_path / "face.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    personalize = ("data", "personalize", tmp_path / "face.obj", "--landmarks")
    for words, message in (
        (("solve", tmp_path / "broken.npz"), "broken"),
        (("solve", path, "-o", tmp_path / "a.json"), ".csv or .npz"),
        (("solve", path, "--replay", tmp_path / "a.csv"), ".npz"),
        (("solve", path, "-o", tmp_path / "none" / "a.csv"), "cannot write"),
        (("solve", path, "--replay-head", "default"), "--replay"),
        (("solve", path, "-o", tmp_path / "a.csv", "--active", "grin"), "no shape named grin"),
        (("solve", path, "-o", tmp_path / "a.csv", "--l2", "-1"), "l2 must be"),
        (("solve", path, "-o", tmp_path / "a.csv", "--samples", "0"), "positive"),
        ((*personalize, tmp_path / "marks.json"), "pairs"),
        ((*personalize, tmp_path / "none.json"), "cannot read"),
    ):
        assert run(*words) == 2, words
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert message in error


def test_benchmark_reports_every_way(tmp_path):
    words = ["--samples", "300", "--frames", "5", "--repeats", "1", "--scipy-frames", "1"]
    assert run("bench", "solve", *words, "--json", tmp_path / "b.json") == 0
    rows = json.loads((tmp_path / "b.json").read_text())["rows"]
    ways = {row["implementation"] for row in rows if row["metric"] == "a frame, median"}
    assert ways == {"batch", "one frame at a time", "scipy on the Gram matrix", "scipy on all vertices"}
    differences = [row["value"] for row in rows if row["implementation"] == "float64 - scipy"]
    assert len(differences) == 3
    assert max(differences) < 1e-6
    assert all(row["value"] > 0 for row in rows if row["unit"] in ("ms", "x"))
