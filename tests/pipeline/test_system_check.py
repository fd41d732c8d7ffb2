"""Doctor names what is missing with the package that holds it."""

import ctypes
import json
import os
import subprocess
import sys

import pytest
from click.testing import CliRunner

from pipeline import system_check
from pipeline.cli import voxscene


def test_all_is_well_here() -> None:
    """Where the tests run, everything that is required is there; one JSON document says so."""
    result = CliRunner().invoke(voxscene, ["doctor", "--json"])
    found = {one["name"]: one for one in json.loads(result.stdout)}

    assert result.exit_code == 0
    assert found["import open3d"]["found"] == "works"
    assert found["JAX device"]["found"].startswith("cpu")


def test_a_missing_library_is_named_with_its_package(monkeypatch: pytest.MonkeyPatch) -> None:
    """And doctor ends with exit code 1."""
    load = ctypes.CDLL

    def without_gl(name: str, *arguments: object, **options: object) -> object:
        if name in ("libGL.so.1", "libusb-1.0.so.0"):
            raise OSError(name)
        return load(name, *arguments, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(system_check.ctypes, "CDLL", without_gl)
    monkeypatch.setattr(system_check, "IMPORTS", ())
    result = CliRunner().invoke(voxscene, ["doctor"])

    assert result.exit_code == 1
    assert "system libraries: missing: libGL.so.1, libusb-1.0.so.0" in result.stdout
    assert "apt-get install libgl1 libusb-1.0-0" in result.stdout


def test_a_missing_vulkan_driver_does_not_fail(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only review needs it."""
    monkeypatch.setattr(system_check, "VULKAN_DRIVERS", ())
    monkeypatch.setattr(system_check, "IMPORTS", ())
    result = CliRunner().invoke(voxscene, ["doctor"])

    assert result.exit_code == 0
    assert "apt-get install mesa-vulkan-drivers libvulkan1" in result.stdout


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_shell_completion(shell: str) -> None:
    """The lines that a shell reads."""
    environment = dict(os.environ, _VOXSCENE_COMPLETE=f"{shell}_source")
    script = "import sys; sys.argv = ['voxscene']; from pipeline.cli import main; main()"
    done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True)

    assert "voxscene" in done.stdout
    assert "_VOXSCENE_COMPLETE" in done.stdout
