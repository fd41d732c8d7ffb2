"""The exact posterior of hidden objects: is it there, and where, when no pixel shows it (supplement L).

With m(S) the mean likelihood ratio of the objects S over their prior poses, p(S | images) is in proportion
to p(S) m(S): for one object with prior presence p the odds are m p / (1 - p), the supplement's 9 m at
p = 0.9. What stands in sight comes as draws of its posterior, over which the ratio is averaged too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scene.config import MOST_EXACT
from scene.hidden.depth_evidence import DepthImages
from scene.hidden.pose_draws import DrawsOf, pose_draws
from scene.hidden.pose_priors import PosePrior
from scene.model.number_prior import NumberPrior
from scene.objects.scene_object import SceneObject

LARGEST_LOG = 709.0
"""Of a double."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MeanRatio:
    """An estimate of a mean likelihood ratio from independent draws.

    Attributes:
        log_mean: log m; m of what is in plain sight is no number.
        relative_error: standard error over m.
        effective_draws: (sum w)^2 / sum w^2; few where the object would be seen, and m is then a lower guess.
        poses: (n, K, 4, 4) world_from_box of the n objects in K independent draws of the posterior.
    """

    log_mean: float
    relative_error: float
    effective_draws: float
    poses: NDArray[np.float64]

    @property
    def mean(self) -> float:
        """The ratio m, 1e308 at most."""
        return float(np.exp(min(self.log_mean, LARGEST_LOG)))

    @property
    def standard_error(self) -> float:
        """Of m."""
        return self.mean * self.relative_error


@dataclass(frozen=True, kw_only=True, eq=False)
class HiddenPosterior:
    """What is known of n hidden objects.

    Attributes:
        presence: (n,) probability that each is there.
        standard_error: (n,) of it, from the number of draws.
        both: probability that both are, of two.
        ratios: by set of objects.
        poses: (n, K, 4, 4) world_from_box in draws of the posterior given that it is there.
    """

    presence: NDArray[np.float64]
    standard_error: NDArray[np.float64]
    both: float
    ratios: dict[tuple[int, ...], MeanRatio]
    poses: NDArray[np.float64]


def hidden_posterior(
    rng: np.random.Generator,
    objects: Sequence[SceneObject],
    prior: PosePrior,
    images: DepthImages,
    number: NumberPrior,
    *,
    draws: int,
    keep: int = 256,
    draws_of: DrawsOf = pose_draws,
) -> HiddenPosterior:
    """Presence and place of one hidden object or two.

    Args:
        rng: random numbers.
        objects: one or two, of which no pixel shows any.
        prior: of their poses, independent but for their keeping clear of each other.
        images: what was seen.
        number: prior on how many of them are there.
        draws: of poses for each set of objects.
        keep: K, draws of the posterior.
        draws_of: where poses come from.

    Raises:
        ValueError: there are more, or no room for one.
    """
    count = len(objects)
    if not 1 <= count <= MOST_EXACT:
        raise ValueError(
            f"exact answers are for one hidden object or two, not {count}: {2**count - 1} sets of them would "
            f"have to be rendered together, {draws} times each"
        )
    sets = [(one,) for one in range(count)] + ([(0, 1)] if count == 2 else [])
    ratios = {
        members: mean_ratio(
            rng, [objects[one] for one in members], prior, images, draws=draws, keep=keep, draws_of=draws_of
        )
        for members in sets
    }
    return _joined(rng, ratios, number.log_set_probabilities(count), keep)


def mean_ratio(
    rng: np.random.Generator,
    objects: Sequence[SceneObject],
    prior: PosePrior,
    images: DepthImages,
    *,
    draws: int,
    keep: int,
    draws_of: DrawsOf = pose_draws,
) -> MeanRatio:
    """The mean over these objects' prior poses; memory does not grow with the number of draws.

    Each of `keep` places holds a draw of the posterior: where a batch has share s of all weight so far, each
    is replaced with probability s by a draw from the batch.
    """
    sampler = draws_of(objects, prior, images, draws)
    log_total, log_squares = -np.inf, -np.inf
    poses = np.tile(np.eye(4), (len(objects), keep, 1, 1))
    done = 0
    while done < draws:
        count = min(sampler.together, draws - done)
        drawn, log_weights = sampler.draw(rng, count)
        done += count
        log_batch = np.logaddexp.reduce(log_weights)
        if np.isneginf(log_batch):
            continue
        log_total = np.logaddexp(log_total, log_batch)
        log_squares = np.logaddexp(log_squares, np.logaddexp.reduce(2 * log_weights))
        replaced = rng.uniform(size=keep) < np.exp(log_batch - log_total)
        chances = np.exp(log_weights - log_batch)
        picked = rng.choice(len(chances), int(replaced.sum()), p=chances / chances.sum())
        poses[:, replaced] = drawn[:, picked]
    effective = float(np.exp(2 * log_total - log_squares)) if log_total > -np.inf else 0.0
    spread = max(draws / effective - 1, 0.0) if effective else 0.0
    return MeanRatio(
        log_mean=float(log_total - np.log(draws)),
        relative_error=float(np.sqrt(spread / max(draws - 1, 1))),
        effective_draws=effective,
        poses=poses,
    )


def _joined(
    rng: np.random.Generator,
    ratios: dict[tuple[int, ...], MeanRatio],
    log_sets: NDArray[np.float64],
    keep: int,
) -> HiddenPosterior:
    """The posterior over sets, its errors by the delta method, and poses of each object over all sets."""
    count = len(log_sets) - 1
    log_weights = {members: log_sets[len(members)] + ratio.log_mean for members, ratio in ratios.items()}
    log_total = np.logaddexp.reduce([log_sets[0], *log_weights.values()])
    weights = {members: float(np.exp(one - log_total)) for members, one in log_weights.items()}
    presence, errors = np.zeros((2, count))
    poses = np.zeros((count, keep, 4, 4))
    for one in range(count):
        holding = [members for members in ratios if one in members]
        presence[one] = sum(weights[members] for members in holding)
        errors[one] = np.sqrt(
            sum(
                (weights[each] * ((one in each) - presence[one]) * ratio.relative_error) ** 2
                for each, ratio in ratios.items()
            )
        )
        shares = np.array([weights[members] for members in holding])
        chances = shares / shares.sum() if shares.any() else None  # where all would be seen, any will do
        chosen = rng.choice(len(holding), keep, p=chances)
        for which, members in enumerate(holding):
            mine = chosen == which
            poses[one, mine] = ratios[members].poses[members.index(one), mine]
    return HiddenPosterior(
        presence=presence,
        standard_error=errors,
        both=weights.get((0, 1), 0.0),
        ratios=ratios,
        poses=poses,
    )
