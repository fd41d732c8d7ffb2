"""Every test runs on the CPU, seeded by its own name, with JAX's strictest checks."""

import os
import resource
import zlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("CI", "1")  # silences Rerun's usage statistics

import jax
import pytest

from pipeline.jax_setup import set_up_jax
from scene.execution import FAST_COMPILE

ROOT = Path(__file__).parent.parent

_ALL_COMPILED_FAST = " ".join(f"--{name}={str(value).lower()}" for name, value in FAST_COMPILE.items())
os.environ.setdefault("XLA_FLAGS", _ALL_COMPILED_FAST)  # of commands too; tests compile more than they run

jax.config.update("jax_debug_key_reuse", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
set_up_jax("tests")  # once a machine, not once a checkout: that is half of the time of the tests


@pytest.fixture
def seed(request: pytest.FixtureRequest) -> int:
    """A seed that depends on the test's name alone."""
    return zlib.crc32(request.node.nodeid.encode())


@pytest.fixture
def key(seed: int) -> jax.Array:
    """A typed key seeded from the test's name."""
    return jax.random.key(seed)


@pytest.fixture
def double_precision() -> Iterator[None]:
    """Charts and chains run in float64."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder with real recordings, from VOXSCENE_DATA; tests that use it skip where it is missing."""
    folder = Path(os.environ.get("VOXSCENE_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}; set VOXSCENE_DATA to its folder")
    return folder


@pytest.fixture
def limited_files() -> Callable[[int], AbstractContextManager[None]]:
    """Files of at most so many bytes can be written within the block, as on a disk that is nearly full."""

    @contextmanager
    def limited(size: int) -> Iterator[None]:
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)

    return limited
