"""Shapes are checked while tests run: jaxtyping and beartype on the sources of the checkout."""

import os
from pathlib import Path

from jaxtyping import install_import_hook

os.environ["HF_HUB_OFFLINE"] = "1"  # no test talks to the network
if "PYTEST_XDIST_WORKER" in os.environ:
    # One thread a worker: threads that look for work take it from the other workers, up to 25 times as long.
    os.environ.setdefault("OMP_NUM_THREADS", "1")

install_import_hook("meshanim", "shape_checks.check")

import meshanim  # noqa: E402

# gaussians/ and datasets/ install as meshanim.gaussians and meshanim.datasets.
meshanim.__path__.append(str(Path(__file__).parent.parent))

import pytest  # noqa: E402
import torch  # noqa: E402


def pytest_collection_modifyitems(items):
    if torch.cuda.is_available():
        return
    for item in items:
        if "cuda" in item.keywords:
            item.add_marker(pytest.mark.skip(reason="needs an NVIDIA GPU"))


@pytest.fixture
def tetrahedron():
    from meshanim.geometry import TriangleMesh

    return TriangleMesh(
        [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]],
    )


@pytest.fixture
def unchecked():
    """Run without shape checks, as users do, to test the library's own errors."""
    import jaxtyping

    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
