"""The numbers of the published evaluation scripts, written out as loops from their definitions.

CodeTalker main/cal_metric.py, FaceDiffuser evaluation/compute_objective_metrics.py, ProbTalk3D evaluation.py,
UniTalker loss/loss.py. Predictions are longer or shorter than recordings by some frames.
"""

import itertools
import math

import numpy as np
import pytest
import torch

from meshanim.training.metrics.masks import Mask
from meshanim.training.metrics.modules import (
    AxisDynamicsDeviation,
    CoverageError,
    Diversity,
    LipVertexError,
    MeanEstimateError,
    MeanVertexError,
    UpperFaceDynamicsDeviation,
)
from meshanim.training.motion_evaluation import MotionEvaluation, MotionMasks

LIPS, UPPER = [1, 4, 5], [0, 2, 3, 7]
LENGTHS = ((9, 11), (14, 12), (5, 5))  # of the recording, of the prediction
METRES = 0.01


@pytest.fixture(scope="module")
def clips():
    generator = np.random.default_rng(0)
    templates = [generator.normal(size=(8, 3)) * METRES for _ in LENGTHS]
    return [
        (
            template + generator.normal(size=(4, predicted, 8, 3)) * METRES,
            template + generator.normal(size=(true, 8, 3)) * METRES,
            template,
        )
        for (true, predicted), template in zip(LENGTHS, templates)
    ]


@pytest.fixture(scope="module")
def table(clips):
    masks = MotionMasks(lips=Mask("lips", np.array(LIPS)), upper_face=Mask("upper", np.array(UPPER)))
    evaluation = MotionEvaluation(masks, 30.0)
    for index, (samples, true, template) in enumerate(clips):
        evaluation.add(str(index), *map(torch.from_numpy, (samples, true, template)))
    return evaluation


def row(table, name):
    (found,) = [value for value in table.values() if value.metric == name]
    return found


def squared(a, b):
    return sum((a[axis] - b[axis]) ** 2 for axis in range(3))


def worst_of_frames(predicted, true):
    return [
        max(squared(predicted[frame][vertex], true[frame][vertex]) for vertex in LIPS)
        for frame in range(min(len(predicted), len(true)))
    ]


def deviation(values):
    mean = sum(values) / len(values)
    return math.sqrt(sum((value - mean) ** 2 for value in values) / len(values))


def motion_deviation(vertices, template, frames, power):
    """Mean over upper-face vertices of the deviation over time of the (squared) length of the motion."""
    return sum(
        deviation([squared(vertices[t][v], template[v]) ** (power / 2) for t in range(frames)]) for v in UPPER
    ) / len(UPPER)


def test_codetalker_lve_pools_all_frames(clips, table):
    pooled = [value for samples, true, _ in clips for value in worst_of_frames(samples[0], true)]
    found = row(table, "lip vertex error squared")
    assert found.value == pytest.approx(sum(pooled) / len(pooled))
    assert (found.unit, found.mask, found.vertices) == ("m^2", "lips", 3)
    assert (found.frames, found.sequences) == (9 + 12 + 5, 3)


def test_gava_and_unitalker_take_the_root(clips, table):
    roots = [[math.sqrt(v) for v in worst_of_frames(samples[0], true)] for samples, true, _ in clips]
    found = row(table, "lip vertex error")
    pooled = [value for values in roots for value in values]
    assert found.value == pytest.approx(1000 * sum(pooled) / len(pooled))
    assert found.unit == "mm"
    # UniTalker's meter takes the mean of each batch, which is one sequence.
    lvd = LipVertexError(Mask("lips", np.array(LIPS)), pooled="sequences")
    for samples, true, _ in clips:
        frames = min(len(true), samples.shape[1])
        lvd.update(torch.from_numpy(samples[0, :frames]), torch.from_numpy(true[:frames]))
    per_sequence = [sum(values) / len(values) for values in roots]
    assert float(lvd.compute()) == pytest.approx(1000 * sum(per_sequence) / 3)
    assert float(lvd.compute()) != pytest.approx(found.value)


def test_codetalker_and_facediffuser_fdd(clips, table):
    signed, magnitude, plain = [], [], []
    for samples, true, template in clips:
        frames = min(samples.shape[1], len(true))
        both = [[motion_deviation(x, template, frames, p) for x in (true, samples[0])] for p in (2, 1)]
        signed.append(both[0][0] - both[0][1])
        magnitude.append(abs(both[0][0] - both[0][1]))
        plain.append(both[1][0] - both[1][1])
    assert row(table, "FDD squared").value == pytest.approx(sum(signed) / 3)
    assert row(table, "FDD absolute squared").value == pytest.approx(sum(magnitude) / 3)
    assert row(table, "FDD").value == pytest.approx(1000 * sum(plain) / 3)
    assert row(table, "FDD squared").unit == "m^2"
    assert row(table, "FDD").pooled == "sequences"


def test_gava_afdd(clips, table):
    values = []
    for samples, true, _ in clips:
        frames = min(samples.shape[1], len(true))
        differences = [
            abs(deviation(list(true[:frames, v, i])) - deviation(list(samples[0, :frames, v, i])))
            for v in UPPER
            for i in range(3)
        ]
        values.append(sum(differences) / (3 * len(UPPER)))
    assert row(table, "AFDD").value == pytest.approx(1000 * sum(values) / 3)


def test_facediffuser_mve_and_diversity(clips, table):
    distances, diversities = [], []
    for samples, true, _ in clips:
        frames = min(samples.shape[1], len(true))
        distances += [
            math.sqrt(squared(samples[0][t][v], true[t][v])) for t in range(frames) for v in range(8)
        ]
        pairs = [
            sum(math.sqrt(squared(a[t][v], b[t][v])) for t in range(frames) for v in range(8)) / frames / 8
            for a, b in itertools.combinations(samples, 2)
        ]
        diversities.append(sum(pairs) / len(pairs))
    assert row(table, "mean vertex error").value == pytest.approx(1000 * sum(distances) / len(distances))
    assert row(table, "mean vertex error").vertices == 8
    assert row(table, "diversity").value == pytest.approx(1000 * sum(diversities) / 3)


def test_probtalk3d_mee_and_ce(clips, table):
    of_mean, of_best = [], []
    for samples, true, _ in clips:
        of_mean += worst_of_frames(sum(samples) / len(samples), true)
        of_best += min((worst_of_frames(sample, true) for sample in samples), key=sum)
    assert row(table, "MEE").value == pytest.approx(sum(of_mean) / len(of_mean))
    assert row(table, "CE").value == pytest.approx(sum(of_best) / len(of_best))


def test_torchmetrics_agrees_on_lve(clips, table):
    from torchmetrics.functional.multimodal.lve import lip_vertex_error

    ours = row(table, "lip vertex error squared").per_sequence
    for index, (samples, true, _) in enumerate(clips):
        theirs = lip_vertex_error(torch.from_numpy(samples[0]), torch.from_numpy(true), LIPS)
        assert ours[str(index)] == pytest.approx((float(theirs), min(samples.shape[1], len(true))))


def test_truncation_is_told(table):
    assert table.truncation == (
        "2 of 3 sequences cut to the shorter of prediction and truth: 4 frames dropped, at most 2 (0)"
    )


def test_per_sequence_numbers_make_the_whole(table):
    for value in table.values():
        if value.per_sequence:
            pairs = list(value.per_sequence.values())
            mean = sum(v * w for v, w in pairs) / sum(w for _, w in pairs)
            assert mean == pytest.approx(value.value, rel=1e-6), value.metric


def _metrics():
    lips, upper = Mask("lips", np.array(LIPS)), Mask("upper", np.array(UPPER))
    return {
        "lve": LipVertexError(lips, squared=True),
        "mve": MeanVertexError(),
        "fdd": UpperFaceDynamicsDeviation(upper, form="absolute"),
        "afdd": AxisDynamicsDeviation(upper),
        "mee": MeanEstimateError(lips),
        "ce": CoverageError(lips),
        "diversity": Diversity(),
    }


def _arguments(name, samples, true, template):
    frames = min(samples.shape[1], len(true))
    samples, true = torch.from_numpy(samples[:, :frames]), torch.from_numpy(true[:frames])
    pair = (samples[0], true)
    return {
        "fdd": (*pair, torch.from_numpy(template)),
        "mee": (samples, true),
        "ce": (samples, true),
        "diversity": (samples,),
    }.get(name, pair)


def _frechet(parts):
    from meshanim.training.metrics.modules import FrechetDistance

    metric = FrechetDistance(Mask("lips", np.array(LIPS)))
    for samples, true, template in parts:
        metric.update(*_arguments("fdd", samples, true, template))
    return metric


def _on_a_rank(rank, store, folder, clips):
    import torch.distributed as dist

    dist.init_process_group("gloo", init_method=f"file://{store}", rank=rank, world_size=2)
    metrics = _metrics()
    mine = clips[rank::2]  # two sequences here, one there
    for name, metric in metrics.items():
        for clip in mine:
            metric.update(*_arguments(name, *clip))
    found = {name: metric.summary(8) for name, metric in metrics.items()}
    values = {name: (value.value, value.frames, value.sequences) for name, value in found.items()}
    frechet = _frechet(mine).summary()
    values["frechet"] = (frechet.value, frechet.frames, frechet.sequences)
    torch.save(values, f"{folder}/{rank}.pt")
    dist.destroy_process_group()


def test_two_processes_give_the_number_of_one(clips, tmp_path):
    torch.multiprocessing.spawn(_on_a_rank, (tmp_path / "store", tmp_path, clips), nprocs=2)
    metrics = _metrics()
    for name, metric in metrics.items():
        for clip in clips:
            metric.update(*_arguments(name, *clip))
    whole = {name: metric.summary(8) for name, metric in metrics.items()}
    whole["frechet"] = _frechet(clips).summary()
    for rank in (0, 1):
        found = torch.load(tmp_path / f"{rank}.pt")
        for name, value in whole.items():
            assert found[name][0] == pytest.approx(value.value, rel=1e-12), name
            assert found[name][1:] == (26, 3), name
