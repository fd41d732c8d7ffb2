"""What is told of frames: the spread of the keyframe that carries a frame is part of the frame's."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from shapes.geometry import pose_gaussian
from shapes.geometry.pose_sets import IDENTITY
from slam.pose_graph.refinement import RefinedKeyframes
from slam.smoothing import UNDERSTATED, _with_placed


def _pose(*tangent: float) -> jax.Array:
    return jaxlie.SE3.exp(jnp.asarray(tangent, jnp.float32)).wxyz_xyz


ANCHOR, DRAWN = _pose(0.3, 0.2, -0.1, 0.5, 0.2, -0.4), _pose(0.1, 0.0, 0.0, 0.0, 0.1, 0.0)
RELATIVE = _pose(0.1, 0.7, 0.3, -0.3, 0.6, 0.2)


def test_the_spread_of_a_keyframe_is_carried_to_its_frames(seed):
    """As by autodiff, the distortion field's included; keyframes that nothing holds stay as they were."""
    rng = np.random.default_rng(seed)
    factor, of_keyframe, of_frame = rng.normal(size=(6, 6)), rng.normal(size=(6, 3)), rng.normal(size=(6, 3))
    placed = RefinedKeyframes(
        mode=jnp.zeros(2, jnp.int32),
        poses=jnp.stack([jnp.asarray(IDENTITY), ANCHOR, ANCHOR])[None],
        covariances=jnp.asarray(np.stack([0 * factor, *[factor @ factor.T] * 2])[None], jnp.float32),
        held=jnp.asarray([[True, True, False]]),
        factor=jnp.zeros((1, 63, 3)),
        disparity_per_m=jnp.zeros((1, 63)),
        sd_per_m=jnp.ones((1, 63)),
        sensitivity=jnp.asarray(np.stack([0 * of_keyframe, of_keyframe, of_keyframe])[None], jnp.float32),
    )
    own = jnp.eye(6)
    drawn, relative = (jnp.tile(pose, (2, 2, 1)) for pose in (DRAWN, RELATIVE))

    known, spread = _with_placed(
        drawn,
        relative,
        jnp.tile(own, (2, 2, 1, 1)),
        placed,
        jnp.asarray([1, 2], jnp.int32),
        jnp.asarray(np.stack([of_frame, of_frame])[None], jnp.float32),
    )

    def moved(xi: jax.Array) -> jax.Array:
        displaced = jaxlie.SE3(pose_gaussian.displace(ANCHOR, xi)) @ jaxlie.SE3(RELATIVE)
        camera = jaxlie.SE3(ANCHOR) @ jaxlie.SE3(RELATIVE)
        return pose_gaussian.coordinates(camera.wxyz_xyz, displaced.wxyz_xyz)

    jacobian = np.asarray(jax.jacfwd(moved)(jnp.full(6, 1e-4)))
    following = of_frame + jacobian @ of_keyframe
    expected = UNDERSTATED * (np.eye(6) + jacobian @ factor @ factor.T @ jacobian.T)
    expected = expected + following @ following.T
    alone = UNDERSTATED * np.eye(6) + of_frame @ of_frame.T
    np.testing.assert_allclose(known[0, 0], ANCHOR)
    np.testing.assert_allclose(spread[0, 0], expected, rtol=0.01, atol=0.02)
    np.testing.assert_array_equal(known[:, 1], DRAWN[None].repeat(2, 0))
    np.testing.assert_allclose(spread[0, 1], alone, rtol=1e-4, atol=1e-4)
