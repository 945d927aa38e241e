"""A whole order by wire with one command: three seams, root and cap, tacks, schedule, a measured torch, and the record.

python -m tests.scenario.whole_order FOLDER [--seed N] [--shown] [--analog] [--welding "{between_seams: direct}"]
plays the devices with `weldcal emulate-cell`, runs `weldcal weld`, and prints what the world knows of torch and part.
The torch is measured by a generator's scans and touches, or (--shown) by `weldcal tool measure` with the cell's own arm.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import yaml

from tests.calibration.tool.torches import Wrong, cell
from tests.worlds.parts.step_parts import assembly, box, write_step
from weldcal.calibration.data.results import CalibrationResult, save_result
from weldcal.calibration.tool.comparison import measured_file, tool_text
from weldcal.calibration.tool.measure import measure_tool
from weldcal.models.tools.loading import WELDING, load_tool
from weldcal.models.workpieces.reading import read_shape
from weldcal.systems.scenario.loading import SCENARIO_FOLDER, load_scenario
from weldcal.tools.emulators.cell.process import CELL, PLAYED_HOST, PLAYED_SCANS, WORLD, X_BC, played_world

BENT_M, TILTED_RAD = 1.5e-3, 0.01  # of the torch against the shipped tool file
POWER_PORT = 5021
ANALOG = """\
  wire_feed: {output: 0, at_full: 22.0, value: 6.0}
  arc_voltage: {output: 1, unit: mA, at_zero: 10.0, at_full: 40.0, value: 20.0}
"""
CAP = {"lateral_mm": 2.0, "vertical_mm": 3.0, "reverse": True, "interpass_s": 5.0}
TACKS = [{"from_mm": 20.0, "to_mm": 32.0, "height_mm": 4.5, "seam": 2}]


def tools(folder: Path, seed: int) -> None:
    """Write true.yaml, the bent torch, and measured.yaml, what scans and touches find of it."""
    bent = cell(seed, Wrong(bend=BENT_M, tilt=TILTED_RAD))
    found = measure_tool(load_tool(WELDING), bent.scans, bent.covariance, bent.touches)
    true: Any = SimpleNamespace(
        tool=found.tool, p_FW=bent.truth.p_FW, axis=bent.truth.axis, move=lambda _: None, stick_out_m=float("nan")
    )
    (folder / "measured.yaml").write_text(tool_text(found, measured_file(found), "scans"), encoding="utf-8")
    (folder / "true.yaml").write_text(yaml.safe_dump(measured_file(true)), encoding="utf-8")


def shown(folder: Path, order: Path) -> None:
    """Let the cell's arm show its tool to its scanner; measured.yaml is what that finds, from the shipped tool file."""
    scenario = load_scenario(str(order))
    assert scenario.job.X_BC is not None
    covariance = np.diag(np.repeat([1e-4, 5e-5], 3) ** 2)
    pose = scenario.job.X_BC.pose()
    result = CalibrationResult(X_BC=pose, covariance=covariance, held_out_mm={}, tilt_deg={}, poses=())
    save_result(result, folder / "result")
    before = folder / "before.yaml"
    before.write_text(order.read_text("utf-8").replace(str(folder / "measured.yaml"), str(WELDING)), encoding="utf-8")
    command = ["tool", "measure", "--scenario", str(before), "--calibration", str(folder / "result")]
    command += ["--robot", PLAYED_HOST, "--out", str(folder / "shown"), "--overwrite"]
    print("weldcal", *command, flush=True)
    subprocess.run([sys.executable, "-m", "weldcal.tools", *command], check=True)
    (folder / "measured.yaml").write_text((folder / "shown/tool.yaml").read_text("utf-8"), encoding="utf-8")


def part(folder: Path) -> list[dict[str, list[int]]]:
    """Write a block on a plate, two solids; its three seams that the arm reaches."""
    write_step(assembly(box((-90, -70, -15), (180, 140, 15)), box((-40, -30, 0), (80, 60, 40))), folder / "part.step")
    shape = read_shape(folder / "part.step")
    (joint,) = shape.joints
    return [{"edges": [id]} for id in joint.edges[:3]]


def texts(folder: Path, more: dict[str, Any], *, analog: bool) -> tuple[str, str]:
    """The scenario of the world, and that of the cell; `more` of its part `welding`."""
    pose = {"xyz_m": [0.65, 0.0, 0.015], "rpy_deg": [0.0, 0.0, 90.0]}
    piece: dict[str, Any] = {"file": str(folder / "part.step"), "seams": part(folder), "joint": "fillet"}
    piece |= {"pose_guess": pose}
    world = WORLD.split("workpiece:")[0] + "home_deg:" + WORLD.split("home_deg:")[1]
    off = {"placement_error": {"translation_mm": 3.0, "rotation_deg": 0.5}}
    keys: dict[str, Any] = {"workpiece": piece | off, "tool": {"file": str(folder / "true.yaml")}}
    keys |= {"welding": {"tacks": TACKS, "passes": [CAP]}}
    world += yaml.safe_dump(keys)
    wires = (SCENARIO_FOLDER / f"{CELL}.yaml").read_text(encoding="utf-8")
    home = "home_deg:" + wires.split("home_deg:")[1]
    wires = wires.split("workpiece:")[0].replace("pace: 0.5", "pace: 1.0") + home
    wires = wires.replace("  arc_input: 0\n  arc_fault_input: 1\n", "  arc_input: 0\n" + ANALOG if analog else "")
    order: dict[str, Any] = {
        "order": "4711",
        "wps": "WPS-135-07 rev. B",
        "part": "block on plate",
        "serial": "1",
        "operator": "ak",
    }
    order |= {"limits": {"heat_input_kJ_mm": [0.1, 2.0], "speed_mm_s": [7.0, 9.0], "path_mm": 0.5}}
    welding: dict[str, Any] = {
        "order": order,
        "process": {"name": "MAG"},
        "passes": [CAP],
        "tacks": TACKS,
        "arc": {"start": "rest", "start_s": 0.2, "crater_s": 0.4},
        "schedule": {
            "job": 3,
            "wire_feed_m_min": 6.0,
            "voltage_V": 20.0,
            "hot_start": {"wire_feed_m_min": 7.0, "voltage_V": 21.0, "time_s": 0.3, "ramp_s": 0.2},
            "crater": {"wire_feed_m_min": 3.0, "voltage_V": 17.0, "ramp_s": 0.3},
        },
    }
    if analog:
        del welding["schedule"]["job"]
        welding["process"] |= {"current_A": 180.0, "voltage_V": 20.0}
    cell_keys = {
        "workpiece": piece,
        "tool": {"file": str(folder / "measured.yaml")},
        "welding": welding | more,
        "job": {"calibrate": False, "X_BC": yaml.safe_load(X_BC), "X_BC_sigma_mm": 0.1, "maximum_time_s": 900.0},
    }
    wires += yaml.safe_dump(cell_keys)
    if analog:
        return world, wires
    return world, wires + f"power_source: !ModbusPowerSource {{host: {PLAYED_HOST}, port: {POWER_PORT}}}\n"


def main() -> None:
    """Play the world, run the command, print its answer and the truth."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--shown", action="store_true", help="the torch is measured by scans that the cell's arm takes")
    parser.add_argument("--analog", action="store_true", help="the schedule by analog outputs, not by Modbus")
    parser.add_argument("--welding", default="{}", metavar="YAML", help="more keys of the cell's part `welding`")
    words = parser.parse_args()
    folder = words.folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    tools(folder, words.seed)
    world, wires = texts(folder, yaml.safe_load(words.welding), analog=words.analog)
    wires = wires.replace(PLAYED_SCANS, str(folder / "scans"))
    order = folder / "cell.yaml"
    order.write_text(wires, encoding="utf-8")
    with played_world(folder, world, wires, words.seed) as played:
        if words.shown:
            shown(folder, order)
        command = [sys.executable, "-m", "weldcal.tools", "weld", str(order), "--out", str(folder / "out")]
        print("weldcal", *command[3:], flush=True)
        answer = subprocess.run([*command, "--overwrite"], check=False)
        print("exit code", answer.returncode)
        truth = played.truth()
    print(
        json.dumps({key: truth[key] for key in truth if key not in ("torch_s_left_up_mm", "set_points_each")}, indent=1)
    )
    times = truth["torch_every_s"] * np.arange(len(truth.get("set_points_each", [])))
    for k in range(0, len(times), 25):
        print(f"{times[k]:7.2f} s", *truth["set_points_each"][k])


if __name__ == "__main__":
    main()
