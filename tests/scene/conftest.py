import pytest


@pytest.fixture(autouse=True)
def _double_precision(double_precision: None) -> None:
    """Charts and chains run in float64."""
