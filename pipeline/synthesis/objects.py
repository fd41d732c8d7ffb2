"""The built-in objects: watertight solids made in code, metres, z up, origin at the bounding box's centre."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import trimesh
from manifold3d import CrossSection, Manifold

from pipeline.synthesis.solids import SEGMENTS, block, cylinder, polygon, surface_of, turned


def built_in_names() -> tuple[str, ...]:
    """Names of the built-in objects."""
    return tuple(_BUILDERS)


def built_in_object(name: str) -> trimesh.Trimesh:
    """Watertight mesh of a built-in object.

    Raises:
        KeyError: there is no built-in object of that name.
    """
    mesh = surface_of(_BUILDERS[name]())
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    return mesh


def _box() -> Manifold:
    return block(0.16, 0.06, 0.21)


def _can() -> Manifold:
    return turned(
        [(0, 0), (0.031, 0), (0.034, 0.003), (0.034, 0.099), (0.031, 0.102), (0.031, 0.099), (0, 0.099)]
    )


def _mug() -> Manifold:
    wall = turned([(0, 0), (0.042, 0), (0.042, 0.092), (0.038, 0.092), (0.038, 0.006), (0, 0.006)])
    handle = CrossSection.circle(0.006, 24).translate((0.027, 0)).revolve(SEGMENTS)
    handle = handle.rotate((90, 0, 0)).translate((0.045, 0, 0.046))
    return wall + (handle - cylinder(0.092, 0.040))


def _bowl() -> Manifold:
    angles = np.linspace(0, np.pi / 2, 17)
    outer = [(0.080 * np.sin(a), 0.058 * (1 - np.cos(a))) for a in angles]
    inner = [(0.075 * np.sin(a), 0.058 - 0.053 * np.cos(a)) for a in angles[::-1]]
    foot = turned([(0.024, 0), (0.030, 0), (0.034, 0.012), (0.024, 0.012)])
    return turned(outer + inner).translate((0, 0, 0.006)) + foot


def _bottle() -> Manifold:
    body = [(0, 0), (0.040, 0), (0.044, 0.006), (0.044, 0.120), (0.034, 0.150)]
    neck = [(0.014, 0.168), (0.014, 0.176), (0.018, 0.176), (0.018, 0.192), (0.012, 0.200), (0, 0.200)]
    return turned(body + neck).scale((1.0, 0.66, 1.0))


def _clamp() -> Manifold:
    jaw = [(-0.075, 0.004), (-0.070, -0.003), (0.020, 0.010), (0.085, 0.034), (0.080, 0.044), (0.015, 0.022)]
    half = polygon(jaw).extrude(0.030)
    pivot = cylinder(0.036, 0.014).translate((0, 0, -0.003))
    return half + half.mirror((0, 1, 0)) + pivot


def _bracket() -> Manifold:
    corner = [(0, 0), (0.10, 0), (0.10, 0.012), (0.012, 0.012), (0.012, 0.14), (0, 0.14)]
    leg = polygon(corner).extrude(0.06)
    rib = polygon([(0.012, 0.012), (0.06, 0.012), (0.012, 0.07)]).extrude(0.01).translate((0, 0, 0.025))
    return (leg + rib).rotate((90, 0, 0))


def _marker() -> Manifold:
    return turned(
        [(0, 0), (0.0095, 0), (0.0095, 0.085), (0.0085, 0.085), (0.0085, 0.115), (0.004, 0.121), (0, 0.121)]
    )


_BUILDERS: dict[str, Callable[[], Manifold]] = {
    "box": _box,
    "can": _can,
    "mug": _mug,
    "bowl": _bowl,
    "bottle": _bottle,
    "clamp": _clamp,
    "bracket": _bracket,
    "marker": _marker,
}
