"""Camera trajectories, learned voxel shapes and scene graphs from recorded depth: `pipeline.interface`."""

from pipeline.interface import *  # noqa: F403
from pipeline.interface import __all__ as __all__
