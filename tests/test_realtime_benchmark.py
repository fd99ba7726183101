"""The benchmark of real time: its search, its clock, its rows."""

import json

import pytest

from meshanim.cli import main
from meshanim.errors import BackendError, OptionError
from meshanim.realtime_benchmark import RealtimeBenchmark, largest, run, untrained


@pytest.mark.parametrize("bound", range(10))
@pytest.mark.parametrize("most", [1, 2, 5, 8])
@pytest.mark.parametrize("guess", [0, 1, 4, 99])
def test_the_search_finds_the_largest(bound, most, guess):
    asked = []

    def holds(number):
        asked.append(number)
        return number <= bound

    assert largest(holds, most, guess) == min(bound, most)
    assert max(asked) <= most
    assert len(asked) == len(set(asked))


def test_untrained_networks_have_the_published_sizes():
    regression, diffusion = untrained("a2f-regression"), untrained("a2f-diffusion")
    assert regression.actors.basis.width == 169
    assert len(regression.config.emotions) == 10
    assert (diffusion.config.width, diffusion.config.layers, diffusion.config.sampling) == (256, 2, 2)
    assert diffusion.numbers == 3 * len(diffusion.actors.basis.parts.skin) + 29


def test_rows_of_the_command(tmp_path, capsys):
    words = "bench realtime --models a2f-regression --seconds 1 --most 2 --repeats 1 --workers 2 --behind 60"
    assert main([*words.split(), "--json", str(tmp_path / "r.json")]) == 0
    rows = json.loads((tmp_path / "r.json").read_text())["rows"]
    assert {row["case"] for row in rows} == {"a2f-regression"}
    found = {row["metric"]: row["value"] for row in rows}
    # The window reaches 0.26 s and the encoder hears what follows 0.24 s later: four chunks of 0.1 s.
    assert found["sound needed"] == pytest.approx(400)
    assert found["first frame"] == pytest.approx(found["sound needed"] + found["computing of it"])
    assert found["longest chunk"] > 0
    assert found["speed"] > 0
    assert found["encoder"] > 0
    assert found["real time"] == 2  # nobody is a minute behind after a second
    assert "real time [tracks]" in capsys.readouterr().out


def test_speakers_who_are_late_do_not_count():
    with_nothing = RealtimeBenchmark(
        models=("a2f-diffusion",), seconds=2, repeats=1, workers=1, behind=1e-9, clock="processor"
    )
    from importlib.resources import as_file, files

    from meshanim.cli.demo import CLIP

    with as_file(files("meshanim").joinpath(CLIP)) as clip:
        results = run(with_nothing, clip)
        implementation = "cpu, 1 thread, processor clock"
        assert results.value("a2f-diffusion", implementation, "real time") == 0
        assert results.value("a2f-diffusion", implementation, "sound needed") == pytest.approx(900)
        with pytest.raises(OptionError, match="chunk"):
            RealtimeBenchmark(chunk=0)
        with pytest.raises(OptionError, match="at least 1"):
            RealtimeBenchmark(repeats=0)


def test_a_missing_gpu_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(BackendError, match="NVIDIA"):
        run(RealtimeBenchmark(device="cuda"), tmp_path / "none.wav")
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    with pytest.raises(OptionError, match="GPU"):
        run(RealtimeBenchmark(device="cuda", clock="processor"), tmp_path / "none.wav")
