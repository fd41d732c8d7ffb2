import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scene.model.scene_graph import ROOT, all_trees, subtree, tree_code


@pytest.mark.parametrize("free", [1, 2, 3, 4])
def test_tree_counts(free: int) -> None:
    """(N+1)^(N-1) trees, and 2 (N+2)^(N-1) with a table that only the root carries."""
    assert len(all_trees(free)) == (free + 1) ** (free - 1)
    assert len(all_trees(free, table=True)) == 2 * (free + 2) ** (free - 1)


def test_codes_tell_trees_apart() -> None:
    """No two trees of one capacity share a code."""
    codes = jax.vmap(tree_code)(jnp.asarray(all_trees(4, table=True)))
    assert len(np.unique(codes)) == 432


def test_subtree_is_what_reaches_the_top() -> None:
    """A node is in v's subtree if and only if following parents from it meets v."""
    for parents in all_trees(4):
        for top in range(4):
            expected = []
            for node in range(4):
                walker = node
                while walker not in (top, ROOT):
                    walker = parents[walker]
                expected.append(walker == top)

            actual = subtree(jnp.asarray(parents), jnp.asarray(top))

            assert actual.tolist() == expected
