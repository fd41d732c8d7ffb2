import jax
import pytest


@pytest.fixture(autouse=True)
def _double_precision():
    """Charts and chains run in float64."""
    with jax.enable_x64(True):
        yield
