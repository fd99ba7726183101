import numpy as np
import pytest
import torch

from meshanim.attention.benchmark import BenchmarkOptions, closed_mesh_faces, run
from meshanim.errors import BackendError
from meshanim.geometry import TriangleMesh


def test_mesh_is_closed_and_of_the_size_asked_for():
    faces = closed_mesh_faces(503)
    edges = TriangleMesh(np.zeros((503, 3)), faces).edges
    assert np.unique(faces).size == 503
    assert 503 - len(edges) + len(faces) == 2


def test_rows_and_ratios():
    pytest.importorskip("meshanim._native", reason="the extension was not built")
    results = run(BenchmarkOptions(vertices=162, batch=1, repeats=1, scaling=(100,), memory_vertices=0))
    case = "162 vertices"
    ratio = results.value(case, "dense / native", "forward ratio")
    times = [results.value(case, name, "forward") for name in ("dense", "native")]
    assert ratio == pytest.approx(times[0] / times[1])
    for case in ("100 vertices", "100 vertices, numbered at random"):
        assert results.value(case, "native", "forward + backward a vertex") > 0
        assert results.value(case, "native", "forward + backward processor time a vertex") > 0
    traffic = results.value("100 vertices", "native", "traffic")
    copied = results.value("memory", "copy", "traffic")
    assert results.value("100 vertices", "native / copy", "traffic share") == pytest.approx(traffic / copied)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_missing_gpu_is_named():
    with pytest.raises(BackendError, match="no NVIDIA GPU"):
        run(BenchmarkOptions(device="cuda"))


@pytest.mark.cuda
def test_rows_of_a_gpu():
    results = run(
        BenchmarkOptions(vertices=162, batch=1, repeats=1, scaling=(100,), memory_vertices=0, device="cuda")
    )
    assert results.value("162 vertices", "dense / cuda", "forward + backward ratio") > 0
