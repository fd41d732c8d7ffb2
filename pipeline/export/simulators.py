"""Objects for physics simulators: URDF and MJCF with a visual mesh, convex parts for contact, and inertia.

The parts are a convex decomposition (Wei et al. 2022, CoACD); mass and inertia are those of the solid of
the visual mesh at one density. URDF: http://wiki.ros.org/urdf/XML. MJCF: MuJoCo's XML reference.
"""

from __future__ import annotations

from dataclasses import dataclass
from xml.etree import ElementTree as Xml

import numpy as np
import trimesh
from numpy.typing import NDArray

from pipeline.export.meshes import mean_colour, mesh_bytes
from pipeline.simplification import few_triangles

DENSITY_KG_M3 = 1000.0
"""Of water: nothing that a depth camera sees tells what a thing weighs."""
CONCAVITY = 0.05
"""How far a part may be from its hull, in half the object's size: the default of CoACD's authors."""
CONTACT_TRIANGLES = 4_000
"""From which parts for contact are cut: those of a learned shape without thin walls, which have many more."""
GREY = (0.6, 0.6, 0.6)


@dataclass(frozen=True, kw_only=True, eq=False)
class Solid:
    """A body of one density.

    Attributes:
        mass_kg: density times volume.
        centre_m: (3,) centre of mass.
        inertia: (3, 3) about the centre of mass, in kg m^2.
    """

    mass_kg: float
    centre_m: NDArray[np.float64]
    inertia: NDArray[np.float64]


def simulator_files(
    name: str, mesh: trimesh.Trimesh, formats: tuple[str, ...], density: float, detail_m: float = 0.0
) -> dict[str, bytes]:
    """Contents by path of NAME.urdf and NAME.xml (MJCF), as asked for, and the meshes that both refer to.

    Args:
        name: of the object.
        mesh: closed, in metres, z up.
        formats: of urdf and mjcf.
        density: in kg/m^3.
        detail_m: smaller hollows are not cut out: the pitch of a learned shape, whose surface has steps.
    """
    solid = solid_of(mesh, density)
    parts = convex_parts(mesh, detail_m)
    visual = f"{name}.parts/visual.obj"
    collisions = [f"{name}.parts/convex_{number:02d}.obj" for number in range(len(parts))]
    files = {visual: mesh_bytes(mesh, "obj")}
    files |= {path: mesh_bytes(part, "obj") for path, part in zip(collisions, parts, strict=True)}
    if "urdf" in formats:
        files[f"{name}.urdf"] = _written(_urdf(name, solid, visual, collisions, mean_colour(mesh) or GREY))
    if "mjcf" in formats:
        files[f"{name}.xml"] = _written(_mjcf(name, solid, visual, collisions, mean_colour(mesh) or GREY))
    return files


def solid_of(mesh: trimesh.Trimesh, density: float) -> Solid:
    """Mass and inertia of the inside of a closed mesh (Mirtich 1996, as trimesh computes it)."""
    copy = mesh.copy()
    copy.density = density
    return Solid(
        mass_kg=float(copy.mass),
        centre_m=np.asarray(copy.center_mass, np.float64),
        inertia=np.asarray(copy.moment_inertia, np.float64),
    )


def convex_parts(mesh: trimesh.Trimesh, detail_m: float) -> list[trimesh.Trimesh]:
    """Convex meshes that together fill a closed mesh up to a size of detail; the same ones at each call."""
    fewer = few_triangles(mesh.vertices, mesh.faces, CONTACT_TRIANGLES)
    import coacd  # after Open3D, which cannot be imported after it

    coacd.set_log_level("error")
    threshold = min(max(CONCAVITY, 2 * detail_m / float(mesh.extents.max())), 1.0)
    found = coacd.run_coacd(coacd.Mesh(fewer.vertices, fewer.faces), threshold=threshold, seed=0)
    return [trimesh.Trimesh(vertices, faces).convex_hull for vertices, faces in found]


def _urdf(
    name: str, solid: Solid, visual: str, collisions: list[str], colour: tuple[float, float, float]
) -> Xml.Element:
    robot = Xml.Element("robot", name=name)
    link = Xml.SubElement(robot, "link", name=name)
    inertial = Xml.SubElement(link, "inertial")
    Xml.SubElement(inertial, "origin", xyz=_numbers(solid.centre_m), rpy="0 0 0")
    Xml.SubElement(inertial, "mass", value=_numbers([solid.mass_kg]))
    moments = {f"i{a}{b}": solid.inertia["xyz".index(a), "xyz".index(b)] for a, b in _PAIRS}
    Xml.SubElement(inertial, "inertia", {key: _numbers([value]) for key, value in moments.items()})
    for kind, files in (("visual", [visual]), ("collision", collisions)):
        for file in files:
            body = Xml.SubElement(link, kind)
            Xml.SubElement(body, "origin", xyz="0 0 0", rpy="0 0 0")
            Xml.SubElement(Xml.SubElement(body, "geometry"), "mesh", filename=file)
            if kind == "visual":
                material = Xml.SubElement(body, "material", name=f"{name}_colour")
                Xml.SubElement(material, "color", rgba=_numbers([*colour, 1]))
    return robot


def _mjcf(
    name: str, solid: Solid, visual: str, collisions: list[str], colour: tuple[float, float, float]
) -> Xml.Element:
    model = Xml.Element("mujoco", model=name)
    assets = Xml.SubElement(model, "asset")
    meshes = {f"{name}_visual": visual}
    meshes |= {f"{name}_convex_{number:02d}": file for number, file in enumerate(collisions)}
    for mesh, file in meshes.items():
        Xml.SubElement(assets, "mesh", name=mesh, file=file)
    body = Xml.SubElement(Xml.SubElement(model, "worldbody"), "body", name=name)
    Xml.SubElement(body, "freejoint")
    inertia = [solid.inertia["xyz".index(a), "xyz".index(b)] for a, b in ("xx", "yy", "zz", "xy", "xz", "yz")]
    Xml.SubElement(
        body,
        "inertial",
        pos=_numbers(solid.centre_m),
        mass=_numbers([solid.mass_kg]),
        fullinertia=_numbers(inertia),
    )
    for number, mesh in enumerate(meshes):
        seen = {"contype": "0", "conaffinity": "0", "group": "2", "rgba": _numbers([*colour, 1])}
        role = {"group": "3"} if number else seen
        Xml.SubElement(body, "geom", {"type": "mesh", "mesh": mesh, **role})
    return model


def _written(root: Xml.Element) -> bytes:
    Xml.indent(root)
    return Xml.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n"


def _numbers(values: object) -> str:
    return " ".join(f"{value:.9g}" for value in np.asarray(values, float).ravel())


_PAIRS = ("xx", "xy", "xz", "yy", "yz", "zz")
