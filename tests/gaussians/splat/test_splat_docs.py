"""The example of docs/splatting.md runs and its images are what is said beside them."""

import re
from pathlib import Path

PAGE = (Path(__file__).parents[3] / "docs" / "splatting.md").read_text()


def test_example_runs():
    names: dict = {}
    for block in re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL):
        exec(compile(block, "docs/splatting.md", "exec"), names)
    image = names["image"]
    assert image.rgb.shape == (1, 256, 256, 3)
    assert float(image.alpha[0, 128, 128]) > 0.9
    assert float(image.rgb[0, 0, 0].min()) > 0.99
