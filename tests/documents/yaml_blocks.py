"""YAML and TOML blocks are read by the loader that a user's file goes through."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import cv2
import numpy as np

from tests.documents.blocks import Block
from tests.documents.props import lay_out
from tests.documents.scans import write_scans
from weldcal.calibration.data.dataset import load_dataset
from weldcal.models.scanners import get_scanner
from weldcal.models.tools.loading import load_tool
from weldcal.systems.scenario.loading import load_scenario

# What the example of a driver is written in: it is tried as an installed package.
DRIVER = '''"""A scanner of one's own, as far as a scenario names it."""
from dataclasses import dataclass
from weldcal.systems.drivers.config import DriverConfig

@dataclass
class MyScanner(DriverConfig):
    """A scanner with a serial number."""
    FOR = ("scanner",)
    serial: str = ""

def ApplyDriverConfig(config, build):
    """Adds nothing: it is only named."""
'''
METADATA = "Metadata-Version: 2.1\nName: my-package\nVersion: 1.0\n"
LOAD = (
    "import sys; from weldcal.systems.scenario.loading import load_scenario; print(load_scenario(sys.argv[1]).scanner)"
)


def check_yaml(block: Block, folder: Path, entry_points: str = "") -> str:
    """Read a block as a user's file would be read; returns what it was read as.

    Args:
        folder: an empty folder; entry_points: TOML of a package that brings a driver, for a block that names one.

    Raises:
        the error of the loader, which says what is wrong with the block.
    """
    lay_out(block.text, folder)
    if re.search(r"^schema: 1", block.text, re.MULTILINE):
        return _dataset(block, folder)
    if re.search(r"^intrinsics:", block.text, re.MULTILINE):
        return _depth_images(block, folder)
    if re.search(r"^width:", block.text, re.MULTILINE):
        file = folder / "scanner.yaml"
        file.write_text(block.text, encoding="utf-8")
        return f"scanner {get_scanner(str(file)).name}"
    if re.search(r"^torch:", block.text, re.MULTILINE):
        file = folder / "tool.yaml"
        file.write_text(block.text, encoding="utf-8")
        return f"tool {load_tool(file).name}"
    whole = re.search(r"^(extends|description):", block.text, re.MULTILINE)
    file = folder / "snippet.yaml"
    if "extends: my_cell/cell.yaml" in block.text:
        lay_out("my_cell/cell.yaml", folder)
    file.write_text(block.text if whole else f"extends: s_groove\n{block.text}", encoding="utf-8")
    if "!MyScanner" in block.text:
        return _with_driver(file, folder, entry_points)
    load_scenario(str(file))
    return "scenario"


def _dataset(block: Block, folder: Path) -> str:
    scans = write_scans(folder / "scans", 2, 0)
    (scans / "dataset.yaml").write_text(block.text, encoding="utf-8")
    if "euler_ZYX" in block.text:
        (scans / "poses.csv").write_text("id,x,y,z,e1,e2,e3\npose01,400,0,300,10,20,30\npose02,450,50,300,20,10,40\n")
    data = load_dataset(scans, carried=True)
    assert set(data.clouds) == {"pose01", "pose02"}
    return "dataset"


def _depth_images(block: Block, folder: Path) -> str:
    """The keys of depth images, added to the dataset.yaml of a folder that holds some."""
    scans = write_scans(folder / "scans", 2, 0)
    with (scans / "dataset.yaml").open("a", encoding="utf-8") as file:
        file.write(block.text)
    for cloud in list((scans / "clouds").iterdir()):
        cv2.imwrite(str(cloud.with_suffix(".png")), np.full((480, 640), 700, np.uint16))
        cloud.unlink()
    data = load_dataset(scans)
    assert set(data.clouds) == {"pose01", "pose02"}
    assert np.allclose(data.cloud("pose01")[..., 2], 0.7)
    return "dataset of depth images"


def _with_driver(file: Path, folder: Path, entry_points: str) -> str:
    """Load a scenario beside an installed package that registers its driver as the block of TOML says."""
    ((name, module),) = tomllib.loads(entry_points)["project"]["entry-points"]["weldcal.drivers"].items()
    package, _, file_name = module.partition(".")
    site = folder / "site"
    (site / package).mkdir(parents=True)
    (site / package / f"{file_name}.py").write_text(DRIVER)
    metadata = site / "my_package-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(METADATA)
    (metadata / "entry_points.txt").write_text(f"[weldcal.drivers]\n{name} = {module}\n")
    environment = {**os.environ, "PYTHONPATH": str(site)}
    command = [sys.executable, "-P", "-c", LOAD, str(file)]
    finished = subprocess.run(command, capture_output=True, text=True, check=False, env=environment, timeout=120)
    assert finished.returncode == 0, finished.stderr
    assert "MyScanner" in finished.stdout
    return "scenario with a driver of an installed package"
