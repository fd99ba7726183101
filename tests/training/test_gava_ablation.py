from dataclasses import replace

import pytest
from corpus_small import write_small_corpus

from meshanim.cli import main
from meshanim.errors import OptionError
from meshanim.models.gava import Gava
from meshanim.results import Results
from meshanim.training import gava
from meshanim.training.gava_ablation import (
    ORDERINGS,
    VARIANTS,
    AblationOptions,
    gava_ablation,
)

SMALL = {
    "encoder": "mel",
    "steps": 4,
    "learning_rate": 5e-3,
    "tokens": 60,
    "width": 8,
    "heads": 2,
    "layers": 2,
    "rank": 6,
    "batch_windows": 2,
    "save_every": 2,
}

METRIC = "mean vertex error"  # a sphere has no lips
CHOSEN = ("LG+GAVA", "LG+SA", "G+MLP")


@pytest.fixture(scope="module")
def corpus(tmp_path_factory):
    return write_small_corpus(tmp_path_factory.mktemp("corpus") / "sphere", seconds=0.6)


@pytest.fixture(scope="module")
def whole(corpus, tmp_path_factory):
    options = AblationOptions(corpus, tmp_path_factory.mktemp("runs") / "whole", **SMALL)
    return options, gava_ablation(options, progress=False)


def numbers(results):
    return {
        (r.case, r.implementation, r.metric): r.value for r in results.rows if r.metric != "training time"
    }


def test_every_network_has_its_row_and_every_pair_its_difference(whole):
    options, results = whole
    for split in ("test", "train"):
        still = results.value(split, "template held still", METRIC)
        assert all(0 < results.value(split, name, METRIC) < still for name in VARIANTS)
    for better, worse in ORDERINGS:
        found = results.value("order", f"{better} - {worse}", f"{METRIC}: difference")
        errors = [results.value("test", name, METRIC) for name in (better, worse)]
        assert found == pytest.approx(errors[0] - errors[1])
    assert results.value("size", "data and budget", "steps") == options.steps
    assert len({round(results.value("test", name, METRIC), 9) for name in VARIANTS}) == 7


def test_networks_differ_by_what_their_name_says_and_nothing_else(whole):
    options, _ = whole
    configs = {name: Gava.from_pretrained(options.output / f"{name}-0" / "model").config for name in VARIANTS}
    for name, config in configs.items():
        features, decoder = name.split("+")
        assert (config.features, config.decoder) == (features, decoder.lower())
        assert not config.pose
        assert replace(config, features="LG", decoder="gava") == configs["LG+GAVA"]
    runs = {name: options.training(name, 5) for name in VARIANTS}
    for run in runs.values():
        same = replace(run, features="LG", decoder="gava", output=runs["LG+GAVA"].output)
        assert same == runs["LG+GAVA"]


def test_pairs_differ_in_one_thing():
    for better, worse in ORDERINGS:
        assert sum(a != b for a, b in zip(VARIANTS[better], VARIANTS[worse])) == 1


def test_an_interrupted_ablation_gives_the_same_table(whole, tmp_path, monkeypatch):
    options, _ = whole
    expected = gava_ablation(replace(options, variants=CHOSEN), progress=False)
    cut = replace(options, output=tmp_path / "cut", variants=CHOSEN)
    batch = gava.GavaTask.batch
    taken = []

    def until_fourth(task, number, *shares):
        if task.config.decoder == "sa" and number == 3:
            raise KeyboardInterrupt
        return batch(task, number, *shares)

    def recorded(task, number, *shares):
        taken.append((task.config.decoder, number))
        return batch(task, number, *shares)

    monkeypatch.setattr(gava.GavaTask, "batch", until_fourth)
    with pytest.raises(KeyboardInterrupt):
        gava_ablation(cut, progress=False)
    assert [folder.parent.name for folder in cut.output.glob("*/measured.json")] == ["LG+GAVA-0"]
    monkeypatch.setattr(gava.GavaTask, "batch", recorded)
    again = gava_ablation(cut, progress=False)
    assert taken == [("sa", 2), ("sa", 3), ("mlp", 0), ("mlp", 1), ("mlp", 2), ("mlp", 3)]
    assert numbers(again) == numbers(expected)


def test_two_seeds_give_mean_and_spread(whole):
    options, first = whole
    chosen = ("G+MLP",)
    both = gava_ablation(replace(options, seeds=(0, 1), variants=chosen), progress=False)
    second = gava_ablation(replace(options, seeds=(1,), variants=chosen), progress=False)
    for name in chosen:
        one, two = (r.value("test", name, METRIC) for r in (first, second))
        assert one != two
        assert both.value("test", name, METRIC) == pytest.approx((one + two) / 2)
        assert both.value("test", name, f"{METRIC}, spread") == pytest.approx(abs(one - two))


def test_another_budget_needs_another_folder(whole):
    options, _ = whole
    with pytest.raises(OptionError, match="another steps"):
        gava_ablation(replace(options, steps=9), progress=False)
    with pytest.raises(OptionError, match="LG\\+CNN"):
        replace(options, variants=("LG+CNN",))
    with pytest.raises(OptionError, match="seeds"):
        replace(options, seeds=(1, 1))


def test_the_command_prints_the_table_and_writes_the_rows(whole, corpus, tmp_path, capsys):
    options, results = whole
    words = [f"--{name.replace('_', '-')}={value}" for name, value in SMALL.items()]
    file = tmp_path / "rows.json"
    arguments = ["evaluate", "gava-ablation", "--data", str(corpus), "--output", str(options.output)]
    assert main([*arguments, *words, "--json", str(file)]) == 0
    printed = capsys.readouterr().out
    assert all(name in printed for name in VARIANTS)
    assert "frames a step" in printed
    assert numbers(Results.load(file)) == numbers(results)
    assert main([*arguments, "--steps", "7"]) == 2
    assert "another steps" in capsys.readouterr().err
