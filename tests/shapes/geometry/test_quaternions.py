"""Our few operations on quaternions are those of a library."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from shapes.geometry import quaternions

pytestmark = pytest.mark.usefixtures("double_precision")


def test_operations_are_those_of_jaxlie(key: jax.Array) -> None:
    """Products, turned vectors, exponentials, logarithms of 500 turns, tiny and half turns among them."""
    pair_key, vector_key = jax.random.split(key)
    pairs = jax.random.normal(pair_key, (500, 2, 4))
    pairs = (pairs / jnp.linalg.norm(pairs, axis=-1, keepdims=True)).at[:2, 0, 0].set(jnp.array([0.0, -1.0]))
    vectors = jax.random.normal(vector_key, (500, 3))
    vectors *= (jnp.geomspace(1e-12, 3.1, 500) / jnp.linalg.norm(vectors, axis=1))[:, None]
    vectors = vectors.at[0].set(0.0)
    first, second = pairs[:, 0], pairs[:, 1]

    def same(ours: jax.Array, theirs: jax.Array) -> None:
        np.testing.assert_allclose(ours, theirs, rtol=1e-11, atol=1e-13)

    def product(one: jax.Array, other: jax.Array) -> jax.Array:
        return (jaxlie.SO3(one) @ jaxlie.SO3(other)).wxyz

    same(jax.vmap(quaternions.multiply)(first, second), jax.vmap(product)(first, second))
    same(jax.vmap(quaternions.inverse)(first), jax.vmap(lambda q: jaxlie.SO3(q).inverse().wxyz)(first))
    turned = jax.vmap(lambda wxyz, vector: jaxlie.SO3(wxyz).apply(vector))(second, vectors)
    same(jax.vmap(quaternions.rotate)(second, vectors), turned)
    turns = jax.vmap(quaternions.exp)(vectors)
    same(turns, jax.vmap(lambda vector: jaxlie.SO3.exp(vector).wxyz)(vectors))
    same(jax.vmap(quaternions.log)(turns), vectors)
    same(jax.vmap(quaternions.log)(second), jax.vmap(lambda q: jaxlie.SO3(q).log())(second))
