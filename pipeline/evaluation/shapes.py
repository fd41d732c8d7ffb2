"""Agreement of a learned shape with the true mesh: three intersections over unions.

As docs/model.md, section C defines them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from pipeline.evaluation.inside import lies_inside
from shapes.prior import ShapePrior


@dataclass(frozen=True, kw_only=True)
class ShapeAgreement:
    """Intersections over unions of learned and true voxels.

    Attributes:
        solid: occupied or enclosed against the solid truth.
        shell: the outer layer of occupied voxels against that of the truth.
        observed: voxels that some ray decided, alone.
    """

    solid: float
    shell: float
    observed: float


def shape_agreement(
    shape: ShapePrior, mesh: trimesh.Trimesh, reference_from_mesh: NDArray[np.float64]
) -> ShapeAgreement:
    """Compare a learned shape with a true mesh posed in the same reference frame (4, 4)."""
    truth = true_voxels(shape, mesh, reference_from_mesh)
    decided = shape.seen_free | shape.seen_occupied
    return ShapeAgreement(
        solid=intersection_over_union(shape.solid, truth),
        shell=intersection_over_union(_shell(shape.solid), _shell(truth)),
        observed=intersection_over_union(shape.seen_occupied, truth & decided),
    )


def true_voxels(
    shape: ShapePrior, mesh: trimesh.Trimesh, reference_from_mesh: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Voxels (I, J, K) of a shape's grid whose centre lies inside the mesh.

    Raises:
        PipelineError: as `lies_inside`.
    """
    mesh_from_grid = np.linalg.inv(reference_from_mesh) @ shape.reference_from_grid
    points = trimesh.transform_points(shape.grid.centres_m, mesh_from_grid)
    return lies_inside(mesh, points).reshape(shape.phi.shape)


def intersection_over_union(one: NDArray[np.bool_], other: NDArray[np.bool_]) -> float:
    """Of two sets of voxels; 1 where both are empty."""
    union = (one | other).sum()
    return float((one & other).sum() / union) if union else 1.0


def _shell(voxels: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Voxels with a face on the outside."""
    return voxels & ~np.asarray(binary_erosion(voxels), np.bool_)
