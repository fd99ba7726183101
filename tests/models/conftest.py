import pytest
import torch
from conftest_gava import awake, small_config, sphere

from meshanim.models.gava import Gava


@pytest.fixture
def model():
    torch.manual_seed(0)
    return awake(Gava(small_config(), sphere()))
