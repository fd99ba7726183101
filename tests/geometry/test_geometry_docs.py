"""The examples of docs/geometry.md run."""

import re
from pathlib import Path

import meshanim.geometry

PAGE = (Path(__file__).parents[2] / "docs" / "geometry.md").read_text()


def test_examples_run():
    blocks = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)
    assert len(blocks) == 7
    names: dict = {}
    for block in blocks:
        exec(compile(block, "docs/geometry.md", "exec"), names)
    assert names["mended"].mesh.is_closed
    assert names["by_moves"].shape == (2, names["other"].n_vertices, 3)


def test_every_public_function_is_named():
    public = [
        name
        for name in meshanim.geometry.__all__
        if name[0].islower() and not name.startswith(("cot", "vertex_m"))
    ]
    assert not [name for name in public if name not in PAGE]
