"""A straight groove played by `weldcal emulate-cell`, with a cell that welds it by wire."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from weldcal.models.errors import WeldcalError
from weldcal.systems.scenario.loading import SCENARIO_FOLDER

PLAYED = "127.30.0.1", "/tmp/weldcal-cell/scans"
CELL = "wired_straight_groove"
X_BC = "{xyz_m: [0.65, 0.0, 0.95], rpy_deg: [180.0, 0.0, -90.0]}"
WELD_ONLY = "job: {{calibrate: false, X_BC: {X_BC}}}\nwelding: {{seam_length_mm: {seam_mm}}}\n"
WORLD = """\
description: A straight groove whose scanner stands where the drawing has it.
robot: !SimulatedUr {}
scanner: !RenderedScanner
  {preset: ideal, width: 824, height: 616, mounting_translation_mm: 0.0, mounting_rotation_deg: 0.0}
finger_camera: !RenderedFingerCamera {}
workpiece:
  shape: straight
  pose_guess: {xyz_m: [0.65, 0.0, 0.02], rpy_deg: [0.0, 0.0, 90.0]}
  placement_error: {translation_mm: 3.0, rotation_deg: 0.5}
  groove_error: {translation_mm: 1.0, rotation_deg: 0.2}
home_deg: [190.0, -120.0, 135.0, -105.0, -90.0, 90.0]
"""


class NoWorld(WeldcalError):
    """The process that plays the world has not begun."""


@dataclass(frozen=True)
class WiredWorld:
    """A running world: the cell's scenario file, and the processes of scanner and finger camera."""

    cell: Path
    scanner: int
    finger: int


@contextmanager
def wired_world(folder: Path, host: str, seed: int, seam_mm: float) -> Iterator[WiredWorld]:
    """Play the world at a loopback address for the duration of the block.

    Raises:
        NoWorld: it has not begun.
    """
    folder.mkdir(parents=True, exist_ok=True)
    cell, world = folder / "cell.yaml", folder / "world.yaml"
    text = (SCENARIO_FOLDER / f"{CELL}.yaml").read_text(encoding="utf-8")
    for old, new in zip(PLAYED, (host, str(folder / "scans")), strict=True):
        text = text.replace(old, new)
    text = text.replace("pace: 0.5", "pace: 1.0") + WELD_ONLY.format(X_BC=X_BC, seam_mm=seam_mm)
    cell.write_text(text, encoding="utf-8")
    world.write_text(WORLD, encoding="utf-8")
    command = [sys.executable, "-P", "-m", "weldcal.tools", "emulate-cell", "--scenario", str(world)]
    command += ["--cell", str(cell), "--seed", str(seed), "--truth", str(folder / "truth.json")]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True)
    children: list[int] = []
    try:
        line = process.stdout.readline() if process.stdout is not None else ""
        children = [int(pid) for pid in re.findall(r"process (\d+)", line)]
        if len(children) < 2:
            raise NoWorld(f"The world at {host} has not begun: {line or 'it ended without a word'}")
        yield WiredWorld(cell, children[0], children[-1])
    finally:
        for pid in children:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)
        process.terminate()
        with suppress(subprocess.TimeoutExpired):
            process.wait(10.0)
        process.kill()
        process.wait()
