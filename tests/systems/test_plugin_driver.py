"""A stranger's scanner: an installed package offers it in the entry-point group, and no file of weldcal changes."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.places import ROOT
from weldcal.tools.cli.app import app

METADATA = "Metadata-Version: 2.1\nName: somebodys-scanner\nVersion: 1.0\n"
SCENARIO = """
description: A stranger's scanner looks at the bare flange.
tool: none
robot: {robot}
scanner: !RayScanner {{}}
finger_camera: !NoDevice {{}}
calibration:
  feature: flange
  mounting_guess: {{xyz_m: [0.65, 0.0, 0.95], rpy_deg: [180.0, 0.0, -90.0]}}
  minimum_scans: 4
  maximum_scans: 4
  verification_scans: 1
job: {{weld: false}}
home_deg: [180.0, -70.0, 120.0, -50.0, 90.0, 0.0]
"""


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """The variables of a process that sees a package as pip leaves it: a module, its metadata, its entry point."""
    packages = tmp_path / "site"
    metadata = packages / "somebodys_scanner-1.0.dist-info"
    metadata.mkdir(parents=True)
    shutil.copy(ROOT / "tests/systems/plugin_scanner.py", packages / "somebodys_scanner.py")
    (metadata / "METADATA").write_text(METADATA)
    (metadata / "entry_points.txt").write_text("[weldcal.drivers]\nray = somebodys_scanner\n")
    return {**os.environ, "PYTHONPATH": str(packages)}


def weldcal(environment: dict[str, str], *words: str) -> subprocess.CompletedProcess[str]:
    """Run a command in a process of its own."""
    command = [sys.executable, "-P", "-m", "weldcal.tools", *words]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=300, env=environment)


def test_a_job_runs_with_the_scanner_of_an_installed_package(environment: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(SCENARIO.format(robot="!SimulatedUr {}"))
    words = ["calibrate", "--scenario", str(tmp_path / "mine.yaml"), "--out", str(tmp_path / "out"), "--json"]
    finished = weldcal(environment, *words)
    assert finished.returncode == 0, finished.stderr
    found = json.loads(finished.stdout.splitlines()[-1])
    assert found["state"] == "done"
    # 0.03 mm of noise on 1 500 points: the centre is known far better than the first guess of the scenario's own tape
    assert found["X_BC_error_mm"] < 0.5
    assert (tmp_path / "out" / "report.html").is_file()


def test_without_the_package_the_scenario_is_refused_by_its_scanners_name(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(SCENARIO.format(robot="!SimulatedUr {}"))
    finished = CliRunner().invoke(app, ["calibrate", "--scenario", str(tmp_path / "mine.yaml")])
    assert finished.exit_code == 1
    assert "RayScanner" in finished.stderr
    assert "Traceback" not in finished.stderr


def test_a_driver_that_cannot_be_imported_is_named_with_its_package(
    environment: dict[str, str], tmp_path: Path
) -> None:
    Path(environment["PYTHONPATH"], "somebodys_scanner.py").write_text("import a_module_that_nobody_has\n")
    finished = weldcal(environment, "calibrate", "--scenario", "calibrate_only", "--out", str(tmp_path / "out"))
    assert finished.returncode == 1
    said = " ".join(finished.stderr.split())
    assert "The driver 'ray' of the package somebodys-scanner cannot be imported" in said
    assert "a_module_that_nobody_has" in said


def test_a_scanner_that_does_not_say_what_it_is_is_refused_by_name(environment: dict[str, str]) -> None:
    Path(environment["PYTHONPATH"], "somebodys_scanner.py").write_text(
        "import dataclasses as dc\n"
        "from weldcal.systems.drivers.config import ScannerConfig\n"
        "@dc.dataclass\n"
        "class HalfScanner(ScannerConfig):\n"
        "    serial: str = ''\n"
    )
    finished = weldcal(environment, "calibrate", "--scenario", "calibrate_only")
    assert finished.returncode == 1
    said = " ".join(finished.stderr.split())
    assert "The driver HalfScanner in somebodys_scanner does not define scanner()" in said
