"""Rendered tiles of the current scene of a chain, and of the candidate scenes that change some of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RenderedScene:
    """What a scene shows in the X tiles of all frames, for each of R draws of the objects' shapes.

    Attributes:
        shapes: (R, N) int32, which of its known shapes each object has.
        layers_m: (R, N, X, TILE_PIXELS) float32, depth of each object alone, +inf where it is not seen.
        log_layers: the same shape, log density of the pixels where it is what they show.
        covered: (R, N, X) bool, where it is.
        log_tiles: (R, X) float32, log density of each tile.
    """

    shapes: jax.Array
    layers_m: jax.Array
    log_layers: jax.Array
    covered: jax.Array
    log_tiles: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class CandidateScenes:
    """What K scenes show of which most is the same.

    Attributes:
        present: of the first; its `log_tiles` are of no use.
        shapes: (K, R, N) int32 of all.
        log_tiles: (K, R, X) float32 of all.
        fresh_m: (R, L, X, TILE_PIXELS) layers of what stands elsewhere in one of the others.
        fresh_log: the same shape, log density where they are what a pixel shows.
        covered: (R, L, X) bool, where they show it.
        scene, body: (L,) which scene each belongs to, and which object it is; K and N where there is none.
    """

    present: RenderedScene
    shapes: jax.Array
    log_tiles: jax.Array
    fresh_m: jax.Array
    fresh_log: jax.Array
    covered: jax.Array
    scene: jax.Array
    body: jax.Array

    def put(self, body: jax.Array) -> RenderedScene:
        """The present scene with fresh layers in place of those of the objects `body` (L,)."""
        present = self.present
        return replace(
            present,
            layers_m=present.layers_m.at[:, body].set(self.fresh_m, mode="drop"),
            log_layers=present.log_layers.at[:, body].set(self.fresh_log, mode="drop"),
            covered=present.covered.at[:, body].set(self.covered, mode="drop"),
        )
