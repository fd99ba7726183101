import json

import pytest

from meshanim.errors import FileFormatError
from meshanim.results import Results


def test_results_round_trip_and_table(tmp_path):
    results = Results("attention")
    results.add("5,023 vertices", "native", "forward", 1.25, "ms")
    results.add("5,023 vertices", "dense", "forward", 250, "ms")
    results.add("5,023 vertices", "dense", "ratio", 200, "x")
    results.save(tmp_path / "out.json")
    stored = json.loads((tmp_path / "out.json").read_text())
    assert stored["name"] == "attention"
    assert stored["rows"][0] == {
        "case": "5,023 vertices",
        "implementation": "native",
        "metric": "forward",
        "value": 1.25,
        "unit": "ms",
    }
    assert stored["machine"]["cores"] >= 1
    assert results.value("5,023 vertices", "dense", "ratio") == 200
    lines = results.table().splitlines()
    assert lines[0].split() == ["case", "implementation", "forward", "[ms]", "ratio", "[x]"]
    assert lines[1].split() == ["5,023", "vertices", "native", "1.25"]
    assert len(lines) == 3


def test_results_name_a_missing_folder(tmp_path):
    with pytest.raises(FileFormatError, match="nowhere"):
        Results("empty").save(tmp_path / "nowhere" / "out.json")
