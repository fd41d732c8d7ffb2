"""What few overlaps hold together."""

import numpy as np

from slam.keyframes.covisibility import held_together, together_with

CHAIN = np.asarray([(index + 1, index) for index in range(9)])


def test_keyframes_within_three_overlaps_are_held_together():
    """Along a chain of ten; the two functions agree, and the order of a pair does not matter."""
    apart = np.abs(np.arange(10)[:, None] - np.arange(10))

    together = held_together(10, CHAIN).toarray()

    np.testing.assert_array_equal(together, apart < 4)
    for index in range(10):
        np.testing.assert_array_equal(together_with(index, 10, CHAIN[:, ::-1]), together[index])


def test_a_closed_loop_holds_its_ends_together():
    """And what is next to them; without any overlap each stands alone."""
    closed = np.concatenate([CHAIN, [(9, 0)]])

    assert together_with(9, 10, closed).nonzero()[0].tolist() == [0, 1, 2, 6, 7, 8, 9]
    np.testing.assert_array_equal(held_together(3, np.zeros((0, 2), int)).toarray(), np.eye(3, dtype=bool))
