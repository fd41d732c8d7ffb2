"""What there is to export: surfaces of learned shapes and of the objects that a run looked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import trimesh
from numpy.typing import NDArray

from pipeline.export.meshes import Unseen, checked, moved, shape_mesh
from pipeline.meshes import Units
from pipeline.publishing.values import RunValues
from pipeline.shape_folder import usable
from shapes.prior import ShapePrior

Origin = Literal["base", "middle", "grid"]

SHELLS = (0.1, 0.9)
GRID_FRAME = (
    "the shape's grid frame: right-handed; where the object stood on a plane, z is the plane's normal and "
    "z = 0 the plane"
)
OWN_FRAME = "the frame of the mesh that was looked for"


@dataclass(frozen=True, kw_only=True, eq=False)
class ExportModel:
    """A closed surface to be written for other programs.

    Attributes:
        name: of the shape.
        mesh: in metres, in the shape's own frame.
        learned: whether that is the frame of a grid, whose origin means nothing to other programs.
        shells: surfaces where the probability has other values, by that value.
        npz: the learned shape itself, as its file.
        facts: what the manifest says of the shape.
    """

    name: str
    mesh: trimesh.Trimesh
    learned: bool
    shells: Mapping[float, trimesh.Trimesh] = field(default_factory=dict)
    npz: bytes | None = None
    facts: Mapping[str, Any] = field(default_factory=dict)

    def own_from_model(self, origin: Origin) -> NDArray[np.float64]:
        """Pose (4, 4) of the written model's frame in the shape's own: same axes, another origin.

        A surface that came with its own frame keeps it: poses elsewhere refer to it.
        """
        pose = np.eye(4)
        if not self.learned or origin == "grid":
            return pose
        low, high = self.mesh.bounds
        pose[:3, 3] = (low + high) / 2
        if origin == "base":
            pose[2, 3] = low[2]
        return pose

    def in_frame(self, origin: Origin, units: Units = "m") -> trimesh.Trimesh:
        """The surface in the written model's frame."""
        own_from_model = self.own_from_model(origin)
        return moved(self.mesh, np.asarray(np.linalg.inv(own_from_model), np.float64), units)


def learned_model(path: Path, *, shells: bool = False, unseen: Unseen = "fill") -> ExportModel:
    """The surface of a learned shape, closed where nothing was seen or left open there.

    Raises:
        PipelineError: the shape cannot be read, or has no closed surface.
    """
    with usable(path):
        shape = ShapePrior.load(path)
        shares = shape.surface_shares(shape.surface())
    return ExportModel(
        name=path.stem,
        mesh=shape_mesh(shape, path.stem, unseen=unseen),
        learned=True,
        shells={level: shape_mesh(shape, path.stem, level, unseen=unseen) for level in SHELLS}
        if shells
        else {},
        npz=path.read_bytes(),
        facts={
            "frame": GRID_FRAME,
            "pitch_m": shape.pitch_m,
            "reference_from_grid": shape.reference_from_grid.tolist(),
            "unseen": unseen,
            "surface": {state.name.lower(): round(share, 4) for state, share in shares.items()},
        },
    )


def looked_for_models(values: RunValues, *, closed: bool) -> list[ExportModel]:
    """The shapes that a run's parse looked for, in their own frames; copies of one shape are one model.

    Args:
        values: of the run.
        closed: whether they have to bound volumes.

    Raises:
        PipelineError: one does not that has to.
    """
    if values.surfaces is None:
        return []
    originals = set(values.surfaces.shape_names.values())
    shapes = {name: one for name, one in values.surfaces.by_name.items() if name in originals}
    meshes = {
        name: trimesh.Trimesh(one.vertices_m, one.faces, vertex_colors=one.rgb, process=False)
        for name, one in shapes.items()
    }
    return [
        ExportModel(
            name=name,
            mesh=checked(meshes[name], name) if closed else meshes[name],
            learned=one.learned,
            facts={"frame": GRID_FRAME if one.learned else OWN_FRAME},
        )
        for name, one in shapes.items()
    ]
