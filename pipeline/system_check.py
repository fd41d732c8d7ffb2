"""What the program needs of the machine: Python packages, system libraries, a JAX device, a Vulkan driver."""

from __future__ import annotations

import ctypes
import importlib
import importlib.metadata
import os
import platform
from dataclasses import dataclass
from pathlib import Path

VERSIONS = (
    *("jax", "jaxlib", "jaxlie", "numpy", "scipy", "open3d-cpu", "open3d", "kiss-icp", "small_gicp"),
    *("mcap", "rerun-sdk", "scikit-image", "trimesh", "manifold3d"),
)
IMPORTS = ("jax", "open3d", "kiss_icp", "rerun", "manifold3d", "mcap")
LIBRARIES = {
    "libGL.so.1": "libgl1",
    "libEGL.so.1": "libegl1",
    "libX11.so.6": "libx11-6",
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libgomp.so.1": "libgomp1",
    "libudev.so.1": "libudev1",
}
"""System libraries of Open3D and Rerun, and the Debian packages that hold them."""
VULKAN_PACKAGES = "mesa-vulkan-drivers libvulkan1"
VULKAN_DRIVERS = (Path("/usr/share/vulkan/icd.d"), Path("/etc/vulkan/icd.d"))


@dataclass(frozen=True, kw_only=True)
class Check:
    """One thing that was looked at.

    Attributes:
        name: what.
        found: what is there.
        remedy: what to do; empty where all is well.
        required: False where only a part of the program needs it.
    """

    name: str
    found: str
    remedy: str = ""
    required: bool = True


def checks() -> list[Check]:
    """Look at everything; slow packages are imported."""
    return [_system(), *_packages(), *map(_import, IMPORTS), _libraries(), _device(), _vulkan()]


def _system() -> Check:
    name, version = platform.libc_ver()
    old = name == "glibc" and tuple(map(int, version.split(".")[:2])) < (2, 35)
    remedy = "Open3D needs glibc 2.35: Debian 12, Ubuntu 22.04, or newer" if old else ""
    return Check(
        name="system",
        found=f"Python {platform.python_version()}, {platform.platform()}, {name} {version}".strip(", "),
        remedy=remedy,
    )


def _packages() -> list[Check]:
    found = []
    for package in VERSIONS:
        try:
            found.append(Check(name=package, found=importlib.metadata.version(package)))
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def _import(module: str) -> Check:
    try:
        importlib.import_module(module)
    except Exception as error:  # native packages fail in many ways, and doctor tells of every one
        return Check(name=f"import {module}", found=f"fails: {error}", remedy="see what is missing below")
    return Check(name=f"import {module}", found="works")


def _libraries() -> Check:
    if platform.system() != "Linux":
        return Check(name="system libraries", found="looked at on Linux alone")
    missing = [library for library in LIBRARIES if not _loads(library)]
    packages = " ".join(LIBRARIES[library] for library in missing)
    return Check(
        name="system libraries",
        found=f"missing: {', '.join(missing)}" if missing else "all there",
        remedy=f"apt-get install {packages}" if missing else "",
    )


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def _device() -> Check:
    try:
        import jax

        devices = ", ".join(f"{device.platform} ({device.device_kind})" for device in jax.devices())
    except Exception as error:  # jaxlib raises its own kinds for drivers that do not fit
        asked = os.environ.get("JAX_PLATFORMS")
        remedy = "unset JAX_PLATFORMS" if asked else "pip install --upgrade jax jaxlib"
        return Check(
            name="JAX device", found=f"none {f'for {asked}' if asked else ''}: {error}", remedy=remedy
        )
    return Check(name="JAX device", found=devices)


def _vulkan() -> Check:
    drivers = [
        driver.stem for folder in VULKAN_DRIVERS if folder.is_dir() for driver in folder.glob("*.json")
    ]
    found = platform.system() != "Linux" or (bool(drivers) and _loads("libvulkan.so.1"))
    return Check(
        name="Vulkan, for voxscene review",
        found=", ".join(sorted(drivers)) or ("of the system" if found else "no driver"),
        remedy="" if found else f"apt-get install {VULKAN_PACKAGES}",
        required=False,
    )
