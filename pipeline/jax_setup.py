"""JAX as the program uses it: compiled kernels are kept in the user's cache folder."""

from __future__ import annotations

import gc
import os
import warnings
from importlib.metadata import version
from pathlib import Path

from pipeline.errors import PipelineError
from pipeline.fingerprints import canonical_hash, program_hash


def set_up_jax(name: str = "jax") -> None:
    """Keep compiled kernels, the shortest too, and traces of the largest; trace new ones without pauses.

    Where JAX was imported before this package, it is told the precision of products here.

    `JAX_COMPILATION_CACHE_DIR` decides the folder where it is set. Without platformdirs, or where the
    folder cannot be made, kernels are compiled in every process.

    Args:
        name: of the folder among those that the program keeps in the user's cache.

    Raises:
        PipelineError: JAX was told to use a device that is not there.
    """
    import jax

    try:
        jax.devices()
    except Exception as error:  # JAX raises what its plugins raise
        asked = os.environ.get("JAX_PLATFORMS", "")
        raise PipelineError(
            f"JAX finds no device for JAX_PLATFORMS={asked}; unset it, or set it to cpu"
        ) from error
    jax.config.update("jax_default_matmul_precision", os.environ["JAX_DEFAULT_MATMUL_PRECISION"])
    gc.set_threshold(50_000, 10, 10)  # a fifth of the time of tracing goes into looking for cycles
    from jax._src import compilation_cache  # what keeps its entries cannot be chosen otherwise

    from pipeline.kernel_cache import KernelCache

    warnings.filterwarnings("ignore", message="Error (reading|writing) persistent compilation cache entry")
    compilation_cache.get_file_cache = lambda path: (KernelCache(Path(path)), path)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    told = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    folder = Path(told) if told else _user_folder(name)
    if folder is None:
        return
    if not told:
        jax.config.update("jax_compilation_cache_dir", str(folder))
    if jax.default_backend() == "cpu":  # nobody has tried on others what `jax.export` promises
        _keep_traces(folder)


def _user_folder(name: str) -> Path | None:
    """A folder of the user's cache; None where there is none."""
    try:
        from platformdirs import user_cache_path

        folder = user_cache_path("voxscene", appauthor=False) / name
        folder.mkdir(parents=True, exist_ok=True)
    except (ImportError, OSError):
        return None
    return folder


def _keep_traces(folder: Path) -> None:
    """Below a folder, under the version of all that decides what a trace is, beside the arguments."""
    from pipeline.kernel_cache import trace_cache
    from shapes.stored_kernels import keep_traces

    libraries = [f"{name} {version(name)}" for name in ("jax", "jaxlib", "jaxlie", "numpy")]
    decided = canonical_hash([program_hash(), *libraries, os.environ["JAX_DEFAULT_MATMUL_PRECISION"]])
    try:
        keep_traces(trace_cache(folder, decided), decided)
    except OSError:
        return
