"""What is told of objects whose presence was computed exactly, beside what moves told of the others."""

from dataclasses import replace

import numpy as np

from scene.presence.posterior import Presence

ALIKE = np.array([[1, 1, 0], [1, 1, 0], [0, 0, 1]], bool)


def by_moves() -> Presence:
    """Three objects, the first two of one shape."""
    return Presence(
        probability=np.array([0.5, 0.6, 0.7]),
        number=np.array([[0.2, 0.5, 0.3, 0.0], [0.2, 0.5, 0.3, 0.0], [0.3, 0.7, 0.0, 0.0]]),
        standard_error=np.full(3, 0.1),
        hidden=np.array([0.05, 0.1, 0.02]),
        out_of_sight=np.array([0.1, 0.2, 0.3]),
        out_of_sight_error=np.array([0.01, 0.02, 0.03]),
        seen=np.array([False, True, True]),
        poses=np.zeros((3, 7)),
    )


def test_numbers_follow_exact_presences() -> None:
    """Both copies: (1 - a - b + c, a + b - 2 c, c). What moves told stays as it is."""
    before = by_moves()

    told = before.with_exact({0: (0.4, 0.01), 1: (0.3, 0.02)}, 0.1, ALIKE)

    np.testing.assert_allclose(told.probability, [0.4, 0.3, 0.7])
    np.testing.assert_allclose(told.standard_error, [0.01, 0.02, 0.1])
    np.testing.assert_allclose(told.hidden, [0.4, 0.3, 0.02])
    np.testing.assert_allclose(told.number[:2], [[0.4, 0.5, 0.1, 0.0]] * 2)
    np.testing.assert_allclose(told.number[2], before.number[2])
    np.testing.assert_allclose(before.probability, [0.5, 0.6, 0.7])


def test_one_exact_object_has_a_number_of_its_own() -> None:
    """A shape asked for once; of two copies one exact presence alone tells no number."""
    told = by_moves().with_exact({2: (0.9, 0.01)}, 0.0, ALIKE)
    np.testing.assert_allclose(told.number[2], [0.1, 0.9, 0.0, 0.0])

    told = by_moves().with_exact({0: (0.9, 0.01)}, 0.0, ALIKE)
    np.testing.assert_allclose(told.number[0], [0.2, 0.5, 0.3, 0.0])


def test_what_chains_show_nowhere_is_told_as_out_of_sight() -> None:
    """It is not seen; presence and standard error are those that it has out of sight."""
    before = by_moves()

    told = before.without_sight_of(np.array([False, False, True]), ALIKE)

    np.testing.assert_allclose(told.probability, [0.5, 0.6, 0.3])
    np.testing.assert_allclose(told.standard_error, [0.1, 0.1, 0.03])
    np.testing.assert_allclose(told.hidden, [0.05, 0.1, 0.3])
    np.testing.assert_allclose(told.number[2], [0.7, 0.3, 0.0, 0.0])
    assert told.seen.tolist() == [False, True, False]
    assert before.seen.tolist() == [False, True, True]


def test_numbers_of_copies_follow_what_is_told_out_of_sight() -> None:
    """Of two copies one that chains show nowhere, or both: P(k or more) is the presence of the k-th."""
    before = replace(
        by_moves(), probability=np.array([0.9, 0.8, 0.7]), out_of_sight=np.array([0.7, 0.6, 0.3])
    )

    one = before.without_sight_of(np.array([False, True, False]), ALIKE)
    both = before.without_sight_of(np.array([True, True, False]), ALIKE)

    np.testing.assert_allclose(one.number[:2], [[0.1, 0.3, 0.6, 0.0]] * 2)
    np.testing.assert_allclose(both.number[:2], [[0.3, 0.1, 0.6, 0.0]] * 2)
    np.testing.assert_allclose(both.number[2], before.number[2])
