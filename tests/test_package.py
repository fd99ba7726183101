import os
import subprocess
import sys

import jaxtyping
import numpy as np
import pytest

from meshanim.datasets import synthetic
from meshanim.errors import FileFormatError
from meshanim.files import written_whole
from meshanim.motion import MeshSequence


def test_shape_checks_are_on(tetrahedron):
    with pytest.raises((jaxtyping.TypeCheckError, Exception), match="frames"):
        MeshSequence(np.zeros((3, 4), np.float32), 30.0, tetrahedron)


def test_datasets_install_inside_the_package():
    assert synthetic.__name__ == "meshanim.datasets.synthetic"
    code = "import meshanim.datasets.synthetic, meshanim.gaussians, sys; assert 'datasets' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, cwd="/")


def test_a_start_loads_nothing_that_is_slow_and_seldom_needed():
    code = """
import sys, numpy as np, torch, meshanim.gaussians
from meshanim.attention import MeshGraph, mesh_attention
from meshanim.cli import animate, avatar
mesh_attention(*torch.rand(3, 1, 4, 1, 4), MeshGraph.from_faces(np.array([[0, 1, 2]])))
print(*{"torch._dynamo", "trimesh", "pymeshlab", "scipy.signal", "transformers"} & set(sys.modules))
"""
    run = subprocess.run([sys.executable, "-c", code], check=True, cwd="/", capture_output=True, text=True)
    assert run.stdout.strip() == ""


def test_written_whole_leaves_nothing_behind(tmp_path):
    target = tmp_path / "out.bin"
    with pytest.raises(ZeroDivisionError), written_whole(target) as temporary:
        temporary.write_bytes(bytes(1 // 0))
    assert list(tmp_path.iterdir()) == []
    with written_whole(target) as temporary:
        temporary.write_bytes(b"whole")
    assert target.read_bytes() == b"whole"
    assert [path.name for path in tmp_path.iterdir()] == ["out.bin"]


def test_written_whole_names_the_missing_folder(tmp_path):
    with pytest.raises(FileFormatError, match="nowhere"), written_whole(tmp_path / "nowhere" / "a.npz"):
        pass


@pytest.mark.skipif(os.environ.get("MESHANIM_NATIVE") == "0", reason="the extension was switched off")
def test_the_extension_was_built():
    """A failed build installs without it, so that nobody is locked out; where tests run, it must be there."""
    from meshanim import _native

    assert _native.instruction_set() in ("generic", "avx2", "avx512")
