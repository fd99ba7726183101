import pytest

from meshanim.heads import load_head
from meshanim.render.look import look_assets


@pytest.fixture(scope="session")
def head():
    return load_head("default")


@pytest.fixture(scope="session")
def assets(head):
    return look_assets(head, 256)
