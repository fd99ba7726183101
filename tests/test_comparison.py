import json
from dataclasses import replace

import numpy as np
import pytest

from meshanim.cli import main
from meshanim.comparison import (
    CompareOptions,
    compare,
    comparison_results,
    comparison_table,
    paired_bootstrap,
)
from meshanim.errors import OptionError
from meshanim.results import MetricValue, Results

SEQUENCES = [f"s{k:02d}" for k in range(20)]


def measured(values, unit="mm", mask="lips", vertices=4, digest="abcd", names=SEQUENCES):
    per_sequence = {name: (float(v), 10.0 + k) for k, (name, v) in enumerate(zip(names, values))}
    total = sum(v * w for v, w in per_sequence.values()) / sum(w for _, w in per_sequence.values())
    frames = int(sum(w for _, w in per_sequence.values()))
    count = len(per_sequence)
    formula = "largest |p - t|"
    return MetricValue(
        "lip vertex error",
        total,
        unit,
        mask,
        vertices,
        digest,
        formula,
        "frames",
        frames,
        count,
        per_sequence,
    )


def written(path, **implementations):
    results = Results("evaluate motion")
    for name, values in implementations.items():
        results.add_measured("test", name, values)
    results.save(path)
    return path


@pytest.fixture
def hard():
    """What every method finds hard about a sequence: much larger than the methods' difference."""
    return np.random.default_rng(0).uniform(2, 8, 20)


def test_results_come_back_as_they_were_written(tmp_path, hard):
    results = Results("evaluate motion")
    results.add("test", "ours", "speed", 3.0, "x")
    results.add_measured("test", "ours", measured(hard))
    results.save(tmp_path / "a.json")
    again = Results.load(tmp_path / "a.json")
    assert again == results
    (row,) = [row for row in json.loads((tmp_path / "a.json").read_text())["rows"] if "mask" in row]
    assert row["formula"] == "largest |p - t|"
    assert (row["mask"], row["vertices"], row["unit"]) == ("lips", 4, "mm")
    assert row["per_sequence"]["s00"] == [hard[0], 10.0]


def test_a_table_of_mixed_measures_is_refused(hard):
    results = Results("evaluate motion")
    results.add_measured("test", "ours", measured(hard))
    for other, named in (
        (measured(hard, unit="biwi"), "unit mm here, biwi there"),
        (measured(hard, vertices=5), r"mask lips \(4 vertices, abcd\) here, lips \(5 vertices"),
        (measured(hard, digest="ffff"), "mask"),
        (measured(hard, mask="mouth"), "mask"),
        (replace(measured(hard), formula="mean |p - t|"), "formula"),
        (replace(measured(hard), pooled="sequences"), "over sequences there"),
    ):
        with pytest.raises(OptionError, match=named):
            results.add_measured("test", "theirs", other)
    results.add_measured("test", "theirs", measured(hard + 1))
    assert len(results.rows) == 2


def test_a_small_difference_on_hard_sequences_is_found(tmp_path, hard):
    noise = np.random.default_rng(1).normal(0, 0.02, 20)
    a = written(tmp_path / "a.json", ours=measured(hard))
    b = written(tmp_path / "b.json", theirs=measured(hard + 0.1 + noise))
    reference, other = compare(CompareOptions((a, b)))
    assert (reference.is_reference, reference.implementation) == (True, "ours")
    low, high = other.interval
    assert other.difference == pytest.approx(other.measured.value - reference.measured.value)
    assert 0.07 < low < other.difference < high < 0.13
    assert other.excludes_zero
    table = comparison_table([reference, other])
    assert "reference" in table
    assert "yes" in table.splitlines()[-1]
    rows = comparison_results([reference, other])
    assert rows.value("test", "theirs", "lip vertex error: low") == low


def test_no_difference_is_not_found(tmp_path, hard):
    noise = np.random.default_rng(2).normal(0, 0.2, 20)
    a = written(tmp_path / "a.json", ours=measured(hard), theirs=measured(hard + noise - noise.mean()))
    _, other = compare(CompareOptions((a,)))
    assert not other.excludes_zero
    assert "no" in comparison_table([other]).split()


def test_the_interval_is_that_of_resampled_sequences(hard):
    rng = np.random.default_rng(3)
    first, second = (np.stack([hard + rng.normal(0, 0.3, 20), rng.uniform(50, 200, 20)], 1) for _ in range(2))
    second[:, 1] = first[:, 1]
    difference, (low, high) = paired_bootstrap(first, second, resamples=4000)
    draws = []
    for _ in range(4000):
        chosen = rng.integers(20, size=20)
        weight = first[chosen, 1]
        draws.append(((second - first)[chosen, 0] * weight).sum() / weight.sum())
    assert np.percentile(draws, [2.5, 97.5]) == pytest.approx([low, high], abs=0.01)
    assert difference == pytest.approx(np.average((second - first)[:, 0], weights=first[:, 1]))
    assert paired_bootstrap(first, second, seed=1) == paired_bootstrap(first, second, seed=1)
    assert paired_bootstrap(first, second, seed=1) != paired_bootstrap(first, second, seed=2)
    narrow = paired_bootstrap(first, second, level=0.5)[1]
    assert low < narrow[0] < narrow[1] < high
    with pytest.raises(OptionError, match="at least 2"):
        paired_bootstrap(first[:1], second[:1])


def test_the_interval_covers_as_often_as_it_says():
    rng = np.random.default_rng(4)
    hits = 0
    for seed in range(200):
        noise = rng.normal(0.5, 1, 25)
        first = np.stack([np.zeros(25), np.ones(25)], 1)
        _, (low, high) = paired_bootstrap(first, first + np.stack([noise, 0 * noise], 1), 0.9, 400, seed)
        hits += low <= 0.5 <= high
    assert 0.8 < hits / 200 < 0.97


def test_runs_with_other_units_and_masks_are_refused(tmp_path, hard):
    a = written(tmp_path / "a.json", ours=measured(hard))
    b = written(tmp_path / "b.json", theirs=measured(hard, unit="biwi"))
    with pytest.raises(OptionError, match="unit mm here, biwi there"):
        compare(CompareOptions((a, b)))
    c = written(tmp_path / "c.json", theirs=measured(hard, mask="vocaset_lve", vertices=428))
    with pytest.raises(OptionError, match="vocaset_lve"):
        compare(CompareOptions((a, c)))


def test_names_that_clash_are_told_apart_and_baselines_merged(tmp_path, hard):
    still = measured(hard + 3)
    a = written(tmp_path / "a.json", gava=measured(hard), still=still)
    b = written(tmp_path / "b.json", gava=measured(hard + 1), still=still)
    names = [entry.implementation for entry in compare(CompareOptions((a, b)))]
    assert names == ["a: gava", "b: gava", "still"]
    entries = compare(CompareOptions((a, b), reference="still"))
    assert [entry.implementation for entry in entries if entry.is_reference] == ["still"]
    with pytest.raises(OptionError, match="no implementation 'x'; there are a: gava, b: gava, still"):
        compare(CompareOptions((a, b), reference="x"))
    with pytest.raises(OptionError, match="no metric x"):
        compare(CompareOptions((a, b), metrics=("x",)))


def test_only_common_sequences_are_compared(tmp_path, hard):
    a = written(tmp_path / "a.json", ours=measured(hard))
    names = [*SEQUENCES[5:], *(f"t{k}" for k in range(5))]
    b = written(tmp_path / "b.json", theirs=measured([*(hard[5:] + 1), 99, 99, 99, 99, 99], names=names))
    _, other = compare(CompareOptions((a, b)))
    assert other.common == 15
    weights = np.arange(10.0, 30.0)
    first = np.average(hard[5:], weights=weights[5:])
    assert other.difference == pytest.approx(np.average(hard[5:] + 1, weights=weights[:15]) - first)
    c = written(tmp_path / "c.json", theirs=measured([1.0, 2.0], names=["x", "y"]))
    with pytest.raises(OptionError, match="no sequence in common"):
        compare(CompareOptions((a, c)))


def test_numbers_of_a_whole_set_have_no_interval(tmp_path, hard):
    ours, theirs = (replace(measured(hard), value=v, per_sequence={}) for v in (2.0, 3.5))
    _, other = compare(CompareOptions((written(tmp_path / "a.json", ours=ours, theirs=theirs),)))
    assert (other.difference, other.interval, other.excludes_zero) == (1.5, None, False)


def test_what_has_nothing_in_common_is_told(tmp_path, hard):
    for case in ("val", "test"):
        results = Results(case)
        results.add_measured(case, f"of {case}", measured(hard))
        results.save(tmp_path / f"{case}.json")
    with pytest.raises(OptionError, match="of val is: of val on val; of test on test"):
        compare(CompareOptions((tmp_path / "val.json", tmp_path / "test.json")))


def test_command_line(tmp_path, hard, capsys):
    a = written(tmp_path / "a.json", ours=measured(hard))
    b = written(tmp_path / "b.json", theirs=measured(hard + 1))
    assert main(["evaluate", "compare", str(a), str(b), "--json", str(tmp_path / "c.json")]) == 0
    assert "yes" in capsys.readouterr().out
    assert Results.load(tmp_path / "c.json").value("test", "theirs", "lip vertex error: sequences") == 20
    (tmp_path / "bad.json").write_text("{}")
    assert main(["evaluate", "compare", str(tmp_path / "bad.json")]) == 2
    assert "holds no results" in capsys.readouterr().err
    assert main(["evaluate", "compare"]) == 2
