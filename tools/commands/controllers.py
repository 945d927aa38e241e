"""weldcal check-robot, emulate-ur: a controller's readiness, a controller on loopback."""

import shutil
import textwrap
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from weldcal.models.arms.kinematics import load_arm
from weldcal.systems.drivers.ur.readiness.preflight import Check, Preflight, preflight
from weldcal.systems.drivers.ur.rtde import UrRtde, chosen_transport
from weldcal.systems.drivers.ur.wire.rtde_client import UPPER_OFFSET
from weldcal.systems.drivers.ur.wire.transport import UR_RTDE
from weldcal.systems.pacing import measure_host
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.parts import nominal_arm
from weldcal.tools.cli.options import LOOK, Call, Outcome, command, option
from weldcal.tools.commands.run import robot_at
from weldcal.tools.emulators.ur.main import HOME, run_emulator

WIDEST = 100
MARKS = {"ok": typer.colors.GREEN, "to change": typer.colors.RED, "not checked": typer.colors.YELLOW}


@command("check-robot", common=LOOK, short_help="Check whether a robot is ready. Nothing moves.")
def check_robot(
    call: Call,
    host: Annotated[str, typer.Argument(metavar="HOST", help="Name or address of the robot's controller.")],
    scenario: Annotated[
        str | None,
        option("--scenario", "NAME", "Compare arm and payload with this scenario's; without it, the welding tool's."),
    ] = None,
    arm: Annotated[str, option("--arm", "NAME", "The arm, where no scenario is given: ur3e, ur5e, ur20 ...")] = "ur10e",
) -> Outcome:
    """Check whether a robot and this computer are ready: what is right and what to change. Nothing moves or is
    written."""
    nominal = nominal_arm(load_scenario(scenario)) if scenario is not None else load_arm(arm)
    config = configured(host, scenario)
    report = preflight(
        host,
        nominal=nominal,
        load=config.load("the welding tool" if scenario is None else f"the scenario {Path(scenario).stem}"),
    )
    report = with_transport(with_host(report), config)
    problem = "" if report.first_problem is None else report.first_problem.operator_action
    return Outcome(as_json(report), text=partial(emit_table, report), problem=problem)


def configured(host: str, name: str | None) -> UrRtde:
    """The robot of a scenario at this address; with the welding tool, which most scenarios have, where none is named.

    Raises:
        InputError: there is no such scenario.
    """
    if name is None:
        return UrRtde(host=host)
    scenario = load_scenario(name)
    return replace(scenario.robot if isinstance(scenario.robot, UrRtde) else robot_at(host, scenario), host=host)


def with_transport(report: Preflight, config: UrRtde) -> Preflight:
    """Return the report of a controller that is ready, with a further row: how the driver will reach it, and why so."""
    if not report.ok:
        return report
    transport, why = chosen_transport(config, report.version or (), report.upper_registers)
    if transport == UR_RTDE:
        base = UPPER_OFFSET if report.upper_registers else 0
        why += f" It claims the integer input registers {base} to {base + 7} and the double ones {base} to {base + 17}."
    return replace(report, checks=(*report.checks, Check("transport", True, why.removeprefix("Transport "))))


def with_host(report: Preflight) -> Preflight:
    """Return the report of a controller that answered, with a further check: this computer's timing."""
    if report.version is None:
        return report
    timing = measure_host()
    check = Check("computer", timing.ok, timing.words, "" if timing.ok else timing.advice)
    return replace(report, checks=(*report.checks, check))


def state_of(check: Check) -> str:
    """ok, to change, or not checked."""
    if not check.checked:
        return "not checked"
    return "ok" if check.ok else "to change"


def as_json(report: Preflight) -> Mapping[str, object]:
    """Return the JSON object of the command; what was not read is null."""
    problem = report.first_problem
    return {
        "state": "ready" if report.ok else "refused",
        "reason": problem.operator_action if problem else "",
        "checks": [
            {"name": check.name, "state": state_of(check), "found": check.found, "remedy": check.operator_action}
            for check in report.checks
        ],
        "version": ".".join(str(number) for number in report.version) if report.version else None,
        "joints_deg": np.rad2deg(report.arm_q) if report.arm_q is not None else None,
        "kinematics": report.kinematics and ("calibrated" if report.kinematics.calibrated else "nominal"),
        "pose_error_mm": report.pose_error_m and 1e3 * report.pose_error_m,
        "pose_error_deg": report.pose_error_rad and float(np.rad2deg(report.pose_error_rad)),
    }


def emit_table(report: Preflight) -> None:
    """Writes one row per check on stdout, and below each failed check the operator's action."""
    width = min(shutil.get_terminal_size((80, 24)).columns, WIDEST)
    marks = max(map(len, MARKS))
    names = max(len(check.name) for check in report.checks)
    indent = " " * (2 + marks + 2)
    problems = sum(check.checked and not check.ok for check in report.checks)
    verdict = "ready" if report.ok else f"not ready, {problems} to change"
    typer.secho(f"{report.host}: {verdict}", bold=True)
    shown = [check for check in report.checks if check.checked]
    if len(shown) > 1:
        shown = list(report.checks)
    for check in shown:
        state = state_of(check)
        found = _wrapped(check.found, width, f"  {state:<{marks}}  {check.name:<{names}}  ")
        typer.echo("  " + typer.style(f"{state:<{marks}}", fg=MARKS[state]) + found[2 + marks :])
        if check.operator_action:
            typer.echo(_wrapped(check.operator_action, width, indent))
    if waiting := len(report.checks) - len(shown):
        typer.secho(f"  not checked  {waiting} more that need an answer", fg=MARKS["not checked"])


def _wrapped(text: str, width: int, first: str) -> str:
    return textwrap.fill(text, width, initial_indent=first, subsequent_indent=" " * len(first), break_on_hyphens=False)


Joints = tuple[float, float, float, float, float, float]


@command("emulate-ur", common=("seed", "debug"), short_help="Run an emulated UR controller on loopback.")
def emulate_ur(
    call: Call,
    polyscope: Annotated[str, option("--polyscope", "VERSION", "Controller version: 5.12, 5.21, 10.7 ...")] = "5.21",
    robot: Annotated[str, option("--arm", "NAME", "The arm: ur3e, ur5e, ur10e, ur16e, ur20, ur30 ...")] = "ur10e",
    kinematics: Annotated[Path | None, option("--kinematics", "FILE", "A robot's factory calibration.")] = None,
    q: Annotated[Joints, option("--q", "RAD...", "Six joint angles at the start.")] = HOME,
    safety_limits: Annotated[
        str, option("--safety-limits", "DEG", "Six joint ranges LOWER:UPPER, commas between; reported and obeyed.")
    ] = "",
    operational_mode: Annotated[str, option("--operational-mode", "MODE", "none, manual or automatic.")] = "none",
    host: Annotated[str, option("--host", "ADDRESS", "Loopback address 127.x.y.z.")] = "127.0.0.1",
    control_port: Annotated[
        int, option("--control-port", "PORT", "Port that takes injected faults, as JSON lines.")
    ] = 30090,
    pace: Annotated[float, option("--pace", "P", "Speed relative to real time, 0.05 to 1.")] = 1.0,
    lockstep: Annotated[float, option("--lockstep", "S", "Seconds for which time waits for a late client.")] = 0.0,
) -> None:
    """Run a UR controller on loopback that executes the URScript it is sent, until it is interrupted."""
    controller = partial(run_emulator, polyscope=polyscope, robot=robot, kinematics=kinematics, q=q, seed=call.seed)
    controller = partial(controller, safety_limits=safety_limits, operational_mode=operational_mode)
    controller(host=host, control_port=control_port, pace=pace, lockstep=lockstep, ready=typer.echo)
