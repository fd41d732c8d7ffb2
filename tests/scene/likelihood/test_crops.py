"""Crops hold what they are to hold, and are as small as that."""

import numpy as np

from scene.likelihood.crops import LINES_BESIDE, crop_sizes, crops_around, lines_around, most_members

SHAPE = 90, 120


def test_crops_hold_what_masks_hold(seed: int) -> None:
    """Rectangles anywhere: each that is not empty once, with the lines beside it, in the smallest size."""
    rng, masks = np.random.default_rng(seed), np.zeros((200, *SHAPE), bool)
    for mask in masks[1:]:
        row, column, down, across = *rng.integers((0, 0), SHAPE), *rng.integers(1, 70, 2)
        mask[row : row + down, column : column + across] = True
    seen = []
    for crop in crops_around(*lines_around(masks), SHAPE):
        assert len(crop.members) <= most_members(crop.size)
        for one, corner in zip(crop.members, crop.corners, strict=True):
            seen.append(int(one))
            held = np.stack([axis[[0, -1]] for axis in map(np.sort, np.nonzero(masks[one]))], axis=1)
            first = np.maximum(held[0] - LINES_BESIDE, 0)
            after = np.minimum(held[1] + 1 + LINES_BESIDE, SHAPE)
            assert (corner >= 0).all()
            assert (corner <= first).all()
            assert (corner + crop.size >= after).all()
            assert (corner + crop.size <= SHAPE).all()
            smaller = crop_sizes(SHAPE)[: crop_sizes(SHAPE).index(crop.size)]
            assert not any((after - first <= size).all() for size in smaller)
    assert sorted(seen) == list(range(1, 200))


def test_crops_are_put_where_they_were_taken(seed: int) -> None:
    """And what fills a crop up is put nowhere; one image is cut as its crops are."""
    images = np.random.default_rng(seed).random((70, *SHAPE)).astype(np.float32)
    first = np.random.default_rng(seed).integers((0, 0), np.subtract(SHAPE, 20), (70, 2))
    copies = np.zeros_like(images)
    for crop in crops_around(first, first + 20, SHAPE):
        taken = crop.taken(images)
        crop.put(copies, crop.filled(taken))
        np.testing.assert_array_equal(crop.of(images[3])[crop.members == 3], taken[crop.members == 3])
    for image, copy, (row, column) in zip(images, copies, first, strict=True):
        near = slice(row, row + 20), slice(column, column + 20)
        np.testing.assert_array_equal(copy[near], image[near])


def test_small_images_are_not_cut() -> None:
    """What is no larger than a crop is one."""
    assert crop_sizes((24, 32)) == [(24, 32)]
    assert crop_sizes((32, 200)) == [(32, 200)]
