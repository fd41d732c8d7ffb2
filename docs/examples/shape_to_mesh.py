"""A learned shape as a mesh, with the volume that is sure and the volume that is possible.

python shape_to_mesh.py mug.npz mug.ply
"""

import sys
from pathlib import Path

import trimesh
import voxscene


def main(path: str, out: str) -> None:
    """Write the surface and print how much of the shape is sure."""
    shape = voxscene.ShapePrior.load(Path(path))
    surface = shape.surface()
    mesh = trimesh.Trimesh(surface.vertices_m, surface.triangles, process=False)
    mesh.export(out)
    voxel_cm3 = (100 * shape.pitch_m) ** 3
    sure, possible = ((shape.phi > level).sum() * voxel_cm3 for level in (0.9, 0.1))
    print(f"{len(mesh.faces)} triangles, {1e6 * mesh.volume:.0f} cm3")
    print(f"between {sure:.0f} cm3 that are sure and {possible:.0f} that are possible")


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
