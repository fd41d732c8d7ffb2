"""`voxscene doctor`: is everything here that the program needs?"""

from __future__ import annotations

import importlib.metadata
import platform

import click

PACKAGES = ("jax", "jaxlib", "numpy", "open3d-cpu", "open3d", "kiss-icp", "mcap", "rerun-sdk")


@click.command(name="doctor")
def command() -> None:
    """Versions, JAX device, and missing system libraries with the package that holds them."""
    click.echo(f"python {platform.python_version()} on {platform.platform()}")
    for package in PACKAGES:
        try:
            click.echo(f"{package} {importlib.metadata.version(package)}")
        except importlib.metadata.PackageNotFoundError:
            continue
    import jax

    click.echo(f"jax device {jax.devices()[0]}")
