"""The examples of docs/gaussians.md run and do what is said beside them."""

import re
from pathlib import Path

import torch

PAGE = (Path(__file__).parents[2] / "docs" / "gaussians.md").read_text()


def test_examples_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)
    assert len(blocks) == 5
    names: dict = {}
    for block in blocks:
        exec(compile(block, "docs/gaussians.md", "exec"), names)
    count = names["head"].mesh.n_faces
    assert names["world"].means.shape == (4, count, 3)
    assert names["world"].opacities is names["local"].opacities
    torch.testing.assert_close(names["again"].means, names["local"].means, atol=1e-3, rtol=0)
    assert int(names["refined"].binding.count.min()) == 1
    assert len(names["finer_binding"]) == count
    assert names["finer"].mesh.n_faces > count
    assert torch.equal(names["back"].means, names["frame"].means)
    assert torch.equal(names["binding_again"].face, names["binding"].face)
