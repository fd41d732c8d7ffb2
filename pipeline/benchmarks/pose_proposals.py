"""Where the search's poses come from: sources of hypotheses beside each other, and what becomes of them.

Of every object the hypothesis of the first round that is nearest to the truth is judged, before and after
refinement, for the search can only find what is among them. Then what is found in the end.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import jax
import numpy as np
from numpy.typing import NDArray

from pipeline.benchmarks.pose_figures import pose_figures
from pipeline.benchmarks.pose_images import ImageKey, PoseImage
from pipeline.benchmarks.pose_methods import Estimated, Method, Parse, sought_shape
from pipeline.benchmarks.pose_report import report_lines
from pipeline.benchmarks.pose_rows import Judged
from pipeline.evaluation.object_poses import add_s_m, model_points
from pipeline.mesh_source import MeshSource
from pipeline.seeds import stage_key
from pipeline.timing import timed
from recordings.types import DepthNoise
from scene.config import ParseConfig
from scene.likelihood.object_renderer import ObjectRenderer
from scene.observation.segmentation import scene_data
from scene.search.hypotheses import PosePools
from scene.search.search_round import FROM_MASKS, SearchRound
from shapes.geometry.poses import matrices_of

Source = Literal["points", "masks", "both"]
STAGES = {
    "before": "hypotheses before refinement, the best of each object",
    "after": "hypotheses after refinement, the best of each object",
    "found": "found in the end",
}
COMPARED_POINTS = 500
"""Of a model, by which the best hypothesis is picked; it is judged by all points."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Hypotheses:
    """Those of an image's first round.

    Attributes:
        before: (N, pool, 7) camera_from_box, unrefined.
        after: (N, pool, 7), refined.
        seconds: that they took, without compiling.
    """

    before: NDArray[np.float32]
    after: NDArray[np.float32]
    seconds: float


@dataclass(frozen=True, kw_only=True)
class BestHypothesis:
    """The hypothesis of each object that is nearest to the truth, from one source.

    Attributes:
        title: of the column.
        source: of the poses.
        refined: whether they are judged after refinement.
        seed: of the search.
    """

    title: str
    source: Source
    refined: bool
    seed: int
    setting: str = ""

    def estimate(self, image: PoseImage, shapes: MeshSource) -> Estimated:
        """One pose of every object that is there."""
        found = _hypotheses(image, shapes, self.source, self.seed)
        pools = found.after if self.refined else found.before
        poses = []
        for one in image.objects:
            box_from_object = sought_shape(shapes, one.shape, 0, self.seed).scene_object.box_from_object
            points_m = model_points(shapes.meshes[one.shape])[:COMPARED_POINTS]
            truth = image.camera_from_world @ one.world_from_object
            pool = matrices_of(pools[image.shapes.index(one.shape)]) @ box_from_object
            poses.append((one.shape, min(pool, key=lambda pose: add_s_m(points_m, truth, pose))))
        return Estimated(poses=poses, seconds=found.seconds)


@lru_cache(maxsize=1)
def _hypotheses(image: PoseImage, shapes: MeshSource, source: Source, seed: int) -> Hypotheses:
    """The hypotheses of an image: before and after refinement are judged one after the other."""
    config = ParseConfig(proposals=source)
    objects = [sought_shape(shapes, name, 0, seed).scene_object for name in image.shapes]
    rng = np.random.default_rng(np.asarray(jax.random.key_data(stage_key(seed, "parse"))))
    data = scene_data(image.frame.depth_m, image.intrinsics, seed)
    pools = PosePools.of(data, objects, ObjectRenderer.of(objects), DepthNoise(), config, config.pool)
    with timed() as timing:
        search_round = SearchRound.of(pools, rng)
        every = list(range(len(objects)))
        refined, candidates = search_round.hypotheses(pools, dict.fromkeys(every, data.foreground))
        after = pools.densest(refined, np.full(len(every), pools.absent), every)
    from_masks = FROM_MASKS[source] * config.pool // candidates.shape[1]
    from_points, others = config.pool - from_masks, candidates.shape[1] - FROM_MASKS[source]
    before = np.concatenate(
        [candidates[:, :from_points], candidates[:, others : others + from_masks]], axis=1
    )
    return Hypotheses(before=before, after=after, seconds=timing.seconds)


def proposal_methods(sources: Sequence[Source], seed: int) -> list[Method]:
    """The columns of each source: its hypotheses before and after refinement, and what is found."""
    columns: list[Method] = []
    for source in sources:
        for stage, refined in (("before", False), ("after", True)):
            title = f"{source} {stage}"
            columns.append(BestHypothesis(title=title, source=source, refined=refined, seed=seed))
        columns.append(Parse(title=f"{source} found", config=ParseConfig(proposals=source), seed=seed))
    return columns


def proposal_figures(
    judged: Sequence[Judged], seconds: Mapping[str, Mapping[ImageKey, float]], sources: Sequence[str]
) -> dict[str, Any]:
    """The figures of `bench poses` for each of STAGES."""
    document = {}
    for stage in STAGES:
        titles = {f"{source} {stage}": None for source in sources}
        rows = [one for title in titles for one in judged if one.method == title]
        document[stage] = pose_figures(rows, {title: seconds.get(title, {}) for title in titles})
    return document


def proposal_lines(document: Mapping[str, Any]) -> list[str]:
    """What `proposal_figures` found."""
    lines = []
    for stage, about in STAGES.items():
        lines += ["", f"{about}:", *report_lines(document[stage])]
    return lines[1:]
