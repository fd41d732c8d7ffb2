"""`bench speed` measures what it says, of the functions in use, with jax, numpy and click alone."""

import subprocess
import sys

import numpy as np
import pytest

import scene.likelihood.object_renderer
import scene.search.competing_scenes
import scene.search.importance_sampling
from pipeline.benchmarks import speed
from pipeline.benchmarks.hypotheses import BACKGROUND_M, DISTANCE_M, NOISE, Problem, posed, problem
from pipeline.benchmarks.lathe import mug
from pipeline.benchmarks.roofline import measure_roofline
from pipeline.peers.embree_scoring import EmbreeScorer
from shapes.rendering.object_library import library_of_mesh
from shapes.rendering.ray_casting import STEPS

NOT_NEEDED = ("open3d", "trimesh", "jaxlie", "pydantic", "mcap", "rerun", "PIL", "skimage", "platformdirs")


@pytest.fixture(scope="module")
def task() -> Problem:
    """The mug in a small image, at the pitch that the bench takes."""
    return problem(library_of_mesh(*mug()), 50, np.random.default_rng(11))


def test_it_calls_what_parse_calls() -> None:
    """The very functions: refinement scores with one; searches render with the other."""
    assert speed.log_likelihood_ratio is scene.search.importance_sampling.log_likelihood_ratio
    assert speed.render_layers is scene.likelihood.object_renderer.render_layers
    assert scene.search.competing_scenes.refine is scene.search.importance_sampling.refine


@pytest.mark.slow
def test_the_rooflines_follow_from_the_rates(task: Problem) -> None:
    """One look-up and one density a covered pixel; by sphere tracing, several looks a pixel cast."""
    roof = measure_roofline(task, np.random.default_rng(15))
    pixel = 1 / roof["lookups_per_second"] + 1 / roof["densities_per_second"]
    traced = roof["looks"] / roof["looks_per_second"] + roof["cast_pixels"] / roof["densities_per_second"]

    assert 50 < roof["covered_pixels"] < np.pi * (50 / 6) ** 2
    assert roof["covered_pixels"] < roof["cast_pixels"] < 50 * 50
    assert roof["cast_pixels"] < roof["looks"] < sum(STEPS) * roof["cast_pixels"]
    np.testing.assert_allclose(roof["bound_per_second"] * roof["covered_pixels"] * pixel, 1.0)
    np.testing.assert_allclose(roof["tracing_bound_per_second"] * traced, 1.0)


def test_it_imports_jax_numpy_and_click_alone() -> None:
    """A machine with an accelerator needs nothing else for the figures."""
    script = (
        "import sys, pipeline.commands.benches.speed, pipeline.benchmarks.speed; "
        f"print([name for name in {NOT_NEEDED!r} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)

    assert done.stdout.strip() == "[]"


def test_hypotheses_are_distinct_and_span_a_third_of_the_image(task: Problem) -> None:
    """No two alike; the bounding sphere's circle lies inside the image."""
    poses = task.poses(np.random.default_rng(12), 500)
    radius = float(task.library.radius_m[0])
    centre = poses[:, :3, :3] @ np.asarray(task.library.centre_m[0]) + poses[:, :3, 3]
    share = 2 * radius / centre[:, 2] * task.intrinsics.fx / task.intrinsics.width
    edge = np.abs(centre[:, :2]) / centre[:, 2:] * task.intrinsics.fx + 0.5 * share[:, None] * 50

    assert len(np.unique(poses.reshape(500, -1), axis=0)) == 500
    np.testing.assert_allclose(share, 1 / 3, rtol=0.06)
    assert edge.max() < 25
    assert abs(centre[:, 2].mean() - DISTANCE_M) < 0.01


def test_the_peer_does_the_same_work(task: Problem) -> None:
    """Embree's likelihoods tell hypotheses apart as ours do; both its settings agree to rounding."""
    poses = task.poses(np.random.default_rng(13), 64)
    ours = speed.log_likelihood_ratio(task.library, NOISE, task.evidence, posed(poses, np.zeros(64)))
    scorer = EmbreeScorer(*mug(), task.intrinsics, NOISE, task.observed_m, BACKGROUND_M)

    whole, cropped = scorer.whole_image(poses), scorer.under_sphere(poses)

    np.testing.assert_allclose(whole, cropped, rtol=1e-4)
    assert np.corrcoef(np.asarray(ours), whole)[0, 1] > 0.99


def test_each_timed_call_gets_inputs_of_its_own() -> None:
    """One call to warm up, five that are timed, none with inputs seen before."""
    drawn = []

    def draw() -> np.ndarray:
        drawn.append(np.full(3, len(drawn), np.float32))
        return drawn[-1]

    rate = speed._rate(lambda values: values, draw, 3)

    assert len(drawn) == speed.ROUNDS + 1
    assert 0 < rate["least"] <= rate["median"] <= rate["most"]
