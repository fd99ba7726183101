import json
import pickle
import re
from dataclasses import replace

import numpy as np
import pytest
from corpus_small import write_small_corpus

from meshanim.cli import main
from meshanim.datasets.meshanim_format import MeshanimDataset
from meshanim.errors import FileFormatError, OptionError, ShapeError
from meshanim.results import Results
from meshanim.training.folder_evaluation import (
    EvaluateMotionOptions,
    evaluate_motion,
    group_predictions,
    read_motion,
)

V, T, FPS = 6, 20, 25.0


@pytest.fixture
def folders(tmp_path):
    """Two recordings; predictions off by 1 mm in x at every vertex, one of them two frames shorter."""
    generator = np.random.default_rng(0)
    for name in ("true", "predicted"):
        (tmp_path / name).mkdir()
    templates = {}
    for subject in ("F2", "M3"):
        template = generator.normal(size=(V, 3)) * 0.1
        templates[subject] = template
        true = template + generator.normal(size=(T, V, 3)) * 0.01
        np.save(tmp_path / "true" / f"{subject}_e37.npy", true.reshape(T, -1).astype(np.float32))
        moved = (true + np.array([0.001, 0, 0]))[: T - 2 * (subject == "M3")]
        np.save(tmp_path / "predicted" / f"{subject}_e37.npy", moved.astype(np.float32))
    (tmp_path / "templates.pkl").write_bytes(pickle.dumps(templates, protocol=2))
    (tmp_path / "lips.txt").write_text("0, 2, 3")
    (tmp_path / "upper.txt").write_text("1 4\n5")
    (tmp_path / "pairs.json").write_text(json.dumps({"upper": [0, 2], "lower": [3, 1]}))
    return tmp_path


def options(folders, **changes):
    given = EvaluateMotionOptions(folders / "predicted", folders / "true", fps=FPS)
    masks = {
        "lips_mask": str(folders / "lips.txt"),
        "upper_face_mask": str(folders / "upper.txt"),
        "templates": folders / "templates.pkl",
        "lip_pairs": folders / "pairs.json",
    }
    return replace(given, **(masks | changes))


def numbers(scores):
    return {row.metric: row.value for row in scores.results.rows}


def test_a_known_error_is_found(folders):
    scores = evaluate_motion(options(folders), False)
    found = numbers(scores)
    assert found["lip vertex error"] == pytest.approx(1, abs=1e-4)
    assert found["lip vertex error squared"] == pytest.approx(1e-6, rel=1e-3)
    assert found["mean vertex error"] == pytest.approx(1, abs=1e-4)
    assert found["velocity error"] == pytest.approx(0, abs=1e-3)
    assert found["AFDD"] == pytest.approx(0, abs=1e-4)
    assert found["mouth opening error"] == pytest.approx(0, abs=1e-4)
    assert found["jitter"] == pytest.approx(found["jitter of truth"], abs=1e-5)
    # Three landmarks' displacements are off by 1 mm in x; the steps are as they were.
    assert found["Frechet distance"] == pytest.approx(3, abs=1e-3)
    row = next(row for row in scores.results.rows if row.metric == "lip vertex error")
    assert (row.case, row.implementation, row.measured.mask) == ("recordings", "predicted", "lips")
    assert (row.measured.frames, row.measured.sequences) == (38, 2)
    assert scores.notes == [
        "not measured, there is no mask: eye error",
        "1 of 2 sequences cut to the shorter of prediction and truth: 2 frames dropped, at most 2 (M3_e37)",
    ]


def test_units_of_files(folders):
    for path in [*folders.glob("true/*"), *folders.glob("predicted/*")]:
        np.save(path, np.load(path) * 1000)
    templates = {k: v * 1000 for k, v in pickle.loads((folders / "templates.pkl").read_bytes()).items()}
    (folders / "templates.pkl").write_bytes(pickle.dumps(templates, protocol=2))
    metres = evaluate_motion(options(folders, unit="mm"), False)
    assert numbers(metres)["lip vertex error"] == pytest.approx(1, abs=1e-3)
    assert abs(numbers(metres)["FDD"]) < 1
    biwi = evaluate_motion(options(folders, unit="biwi"), False)
    assert numbers(biwi)["lip vertex error"] == pytest.approx(1, abs=1e-3)
    assert {row.unit for row in biwi.results.rows} == {"biwi", "biwi^2", "biwi/s", "share"}
    assert {row.unit for row in metres.results.rows} == {"mm", "m^2", "mm^2", "mm/s", "share"}


def test_without_templates_there_is_no_fdd(folders):
    scores = evaluate_motion(options(folders, templates=None, lip_pairs=None), False)
    assert not {"FDD", "Frechet distance"} & set(numbers(scores))
    assert "AFDD" in numbers(scores)
    assert "2 sequences have no template: no FDD and no Frechet distance of them" in scores.notes


def test_samples_and_conditions(folders):
    true = np.load(folders / "true" / "F2_e37.npy")
    for path in folders.glob("predicted/*"):
        path.unlink()
    for name, error in (("condition_M3", 0.003), ("condition_F2", 0.002), ("condition_A1", 0.004)):
        np.save(folders / "predicted" / f"F2_e37_{name}.npy", true + np.float32(error))
    scores = evaluate_motion(options(folders), False)
    found = numbers(scores)
    assert found["lip vertex error"] == pytest.approx(2 * 3**0.5, rel=1e-3)  # the subject's own style
    assert found["CE"] == pytest.approx(12e-6, rel=1e-3)
    assert found["MEE"] == pytest.approx(27e-6, rel=1e-3)
    assert found["diversity"] == pytest.approx((1 + 1 + 2) / 3 * 3**0.5, rel=1e-3)
    assert scores.notes[0] == "1 recordings have no prediction and do not count"
    assert "up to 3 predictions" in scores.notes[1]


def test_which_file_predicts_what():
    names = ("F2_e37", "FaceTalk_1_TA_sentence21")
    stems = [
        "F2_e37_sample10",
        "F2_e37_sample2",
        "FaceTalk_1_TA_sentence21_condition_FaceTalk_2_TA",
        "FaceTalk_1_TA_sentence21_condition_FaceTalk_1_TA_sample1",
        "FaceTalk_1_TA_sentence21_condition_FaceTalk_1_TA_sample0",
    ]
    assert group_predictions(stems, names) == {
        "F2_e37": ["F2_e37_sample2", "F2_e37_sample10"],
        "FaceTalk_1_TA_sentence21": [stems[4], stems[3], stems[2]],
    }
    with pytest.raises(OptionError, match="F9_e37 predicts none of the 2 recordings"):
        group_predictions(["F9_e37"], names)


def test_npz_with_pose(folders):
    generator = np.random.default_rng(1)
    for folder, turn in (("true", 0.0), ("predicted", 0.1)):
        path = folders / folder / "F2_e37.npy"
        vertices = np.load(path).reshape(-1, V, 3)
        pose = np.zeros((len(vertices), 3))
        pose[:, 1] = turn
        path.unlink()
        np.savez(path.with_suffix(".npz"), vertices=vertices, pose=pose, fps=FPS, other=generator.normal())
    found = evaluate_motion(options(folders), False)
    assert numbers(found)["pose error"] == pytest.approx(np.degrees(0.1))
    measured = next(r for r in found.results.rows if r.metric == "pose error").measured
    assert (measured.sequences, measured.mask, measured.vertices) == (1, "none", 0)
    assert re.search(r"pose error +deg +none ", found.results.metrics_table())
    with pytest.raises(OptionError, match="has 25 frames a second, the recordings 30"):
        evaluate_motion(options(folders, fps=30.0), False)


def test_a_dataset_as_truth(tmp_path):
    corpus = write_small_corpus(tmp_path / "sphere")
    dataset = MeshanimDataset(corpus)
    (tmp_path / "ours").mkdir()
    for name in dataset.split("test"):
        sequence = dataset[name]
        np.savez(tmp_path / "ours" / f"{name}.npz", vertices=sequence.vertices * 1.0, pose=sequence.pose)
    np.save(tmp_path / "top.npy", np.flatnonzero(dataset.mesh.vertices[:, 1] > 0.05))
    job = EvaluateMotionOptions(
        tmp_path / "ours", data=corpus, split="test", lips_mask=str(tmp_path / "top.npy"), name="copy"
    )
    scores = evaluate_motion(job, False)
    found = numbers(scores)
    assert found["lip vertex error"] == found["pose error"] == found["mean vertex error"] == 0
    assert found["Frechet distance"] == pytest.approx(0, abs=1e-9)
    assert {(row.case, row.implementation) for row in scores.results.rows} == {("test", "copy")}
    with pytest.raises(OptionError, match="lacks 4 of 4 sequences, such as anna_sentence01"):
        evaluate_motion(replace(job, split="train"), False)
    with pytest.raises(OptionError, match="is in m, the predictions in biwi"):
        evaluate_motion(replace(job, unit="biwi"), False)


def test_what_cannot_be_scored_is_named(folders, unchecked):
    with pytest.raises(OptionError, match="one of the two"):
        EvaluateMotionOptions(folders / "predicted", fps=25.0)
    with pytest.raises(OptionError, match="--fps"):
        EvaluateMotionOptions(folders / "predicted", folders / "true")
    with pytest.raises(FileFormatError, match=r"holds no \.npy"):
        evaluate_motion(options(folders, predicted=folders / "nowhere"), False)
    np.save(folders / "predicted" / "F2_e37.npy", np.zeros((T, V + 1, 3)))
    with pytest.raises(ShapeError, match="F2_e37: 7 predicted and 6 true vertices"):
        evaluate_motion(options(folders), False)
    np.save(folders / "predicted" / "F2_e37.npy", np.full((T, V, 3), np.nan))
    with pytest.raises(ShapeError, match="NaN"):
        evaluate_motion(options(folders), False)
    np.save(folders / "predicted" / "F2_e37.npy", np.zeros((T, 7)))
    with pytest.raises(FileFormatError, match=r"F2_e37.npy has shape \(20, 7\)"):
        read_motion(folders / "predicted" / "F2_e37.npy")
    (folders / "predicted" / "F2_e37.npy").write_bytes(b"\x93NUMPY\x01\x00v")
    with pytest.raises(FileFormatError, match="damaged"):
        read_motion(folders / "predicted" / "F2_e37.npy")


def test_a_mask_of_another_topology_is_refused(folders):
    (folders / "lips.txt").write_text("0, 2, 300")
    with pytest.raises(ShapeError, match="vertex 300, the mesh has 6"):
        evaluate_motion(options(folders), False)
    with pytest.raises(ShapeError, match="the motion 6"):
        evaluate_motion(options(folders, head="default", lips_mask=""), False)


def test_command_line_writes_what_compare_reads(folders, capsys):
    words = ["--true", str(folders / "true"), "--fps", "25", "--lips-mask", str(folders / "lips.txt")]
    for name, extra in (("a", 0.0), ("b", 0.002)):
        for path in folders.glob("predicted/*"):
            np.save(path, np.load(path) + np.float32(extra))
        out = str(folders / f"{name}.json")
        predicted = ["--predicted", str(folders / "predicted"), "--name", name, "--json", out]
        assert main(["evaluate", "motion", *predicted, *words]) == 0
    printed = capsys.readouterr().out
    assert "lip vertex error: mean over frames of the largest |p - t| of a vertex" in printed
    assert "2 frames dropped" in printed
    assert main(["evaluate", "compare", str(folders / "a.json"), str(folders / "b.json")]) == 0
    lines = capsys.readouterr().out.splitlines()
    (line,) = [x for x in lines if "lip vertex error  " in x and "  b  " in x and " mm " in x]
    assert " yes " in line
    assert len(Results.load(folders / "a.json").rows[0].measured.per_sequence) == 2
