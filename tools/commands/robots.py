"""Selects the robot of a run by the --robot option: simulated, an emulated controller, or a controller at an address."""

import dataclasses as dc
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from weldcal.models.errors import InputError
from weldcal.systems.addresses import controller_address, is_loopback, loopback_address
from weldcal.systems.drivers.simulated.ur import SimulatedUr
from weldcal.systems.drivers.station_build import PreparedRobot
from weldcal.systems.drivers.ur.readiness.preflight import preflight, require_ready
from weldcal.systems.drivers.ur.rtde import UrRtde
from weldcal.systems.pacing import draw_in_this_thread
from weldcal.systems.scenario.arm import nominal_arm
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.emulators.ur.process import LOCKSTEP_S, emulator_process

SIMULATED, EMULATED = "simulated", "emulated"
EMULATED_PACE = 0.7  # two cores almost keep up at 1; at this pace they do with other load
SLOWEST_PACE = 0.05
GRAVITY = 9.82  # m/s^2, as a controller has it


@dc.dataclass(frozen=True, eq=False)
class ChosenRobot:
    """The robot of a run. `title` is its name for display; `prepared` is set where the driver need not prepare it."""

    title: str
    prepared: PreparedRobot | None = None


@contextmanager
def chosen_robot(
    word: str | None, scenario: Scenario, *, dry_run: bool = False, pace: float | None = None
) -> Iterator[ChosenRobot]:
    """Set `scenario.robot` by the option's value for the duration of the block.

    Args:
        word: `simulated`; `emulated`, on a loopback address of its own, or `emulated@ADDRESS`; the address of a controller;
            None: the scenario's own.
        scenario: its `robot` is replaced.
        dry_run: read the robot's state, then run with a simulated arm that has its kinematics and configuration.
        pace: controller seconds per second of the wall clock; other than 1 only for an emulated controller.

    Raises:
        InputError: the options cannot be combined, or the address is none.
        RobotRefused: the controller does not answer, or does not allow the job; nothing has moved.
    """
    if word is None and not isinstance(scenario.robot, UrRtde) and not scenario.robot.SIMULATED:
        if dry_run or pace is not None:
            raise InputError("--dry-run and --pace need a controller: give --robot with its address.")
        yield ChosenRobot(type(scenario.robot).__name__)
        return
    if word is None:
        word = scenario.robot.host if isinstance(scenario.robot, UrRtde) else SIMULATED
        if isinstance(scenario.robot, UrRtde) and pace is None and scenario.robot.pace != 1.0:
            pace = scenario.robot.pace
    if word == SIMULATED:
        if dry_run or pace is not None:
            raise InputError(
                "--dry-run and --pace need a controller: give --robot emulated or the address of a controller."
            )
        if isinstance(scenario.robot, UrRtde):
            scenario.robot = SimulatedUr()
        yield ChosenRobot("simulated")
        return
    kind, _, address = word.partition("@")
    if kind != EMULATED:
        host = controller_address(word)
        if pace is not None and not is_loopback(host):
            raise InputError(
                "A real controller runs in real time: --pace is for an emulated one, at a loopback address."
            )
        pace = 1.0 if pace is None else pace
        _check_pace(pace)
        yield _at(host, f"the controller at {host}", scenario, dry_run=dry_run, pace=pace)
        return
    wanted = loopback_address(address) if address else None
    pace = EMULATED_PACE if pace is None else pace
    _check_pace(pace)
    kinematics = None if scenario.kinematics is None else Path(scenario.kinematics)
    q_home = np.deg2rad(scenario.home_deg)
    with emulator_process(
        host=wanted, robot=scenario.arm, q=q_home.tolist(), kinematics=kinematics, pace=pace, lockstep=LOCKSTEP_S
    ) as emulator:
        load = (scenario.robot if isinstance(scenario.robot, UrRtde) else robot_at(emulator.host, scenario)).load()
        emulator.do("set_payload", mass=load.mass_kg, cog=list(load.cog_m))
        emulator.do("set_gravity", gravity=(GRAVITY * nominal_arm(scenario).up).tolist())
        yield _at(emulator.host, "an emulated controller", scenario, dry_run=dry_run, pace=pace, lockstep=True)


def _check_pace(pace: float) -> None:
    if not SLOWEST_PACE <= pace <= 1.0:
        raise InputError(f"--pace must be from {SLOWEST_PACE:g} to 1, and it is {pace:g}.")


def _at(host: str, name: str, scenario: Scenario, *, dry_run: bool, pace: float, lockstep: bool = False) -> ChosenRobot:
    config = scenario.robot if isinstance(scenario.robot, UrRtde) else robot_at(host, scenario)
    config = dc.replace(config, host=host, pace=pace, lockstep=lockstep or config.lockstep)
    if not dry_run:
        scenario.robot = config
        draw_in_this_thread()
        return ChosenRobot(name)
    scenario.robot = SimulatedUr()
    return ChosenRobot(
        f"dry run: a simulated arm with the kinematics and configuration of {name}; nothing was sent to it",
        look_at(config, scenario),
    )


def robot_at(host: str, scenario: Scenario) -> UrRtde:
    """The robot at an address, with the scenario's tool as its payload."""
    if scenario.tool == "none":
        return UrRtde(host=host, payload_kg=0.0, payload_cog_m=[0.0, 0.0, 0.0])
    if scenario.tool == "pen":
        return UrRtde(host=host, payload_kg=0.42, payload_cog_m=[0.03, 0.0, 0.02])
    loaded = scenario.loaded_tool()
    assert loaded is not None
    return UrRtde(host=host, payload_kg=loaded.tool.mass_kg, payload_cog_m=list(loaded.tool.centre_of_mass_m))


def look_at(config: UrRtde, scenario: Scenario) -> PreparedRobot:
    """Read the kinematics and configuration of a controller's arm; nothing is written, sent or moved.

    Raises:
        RobotRefused: the controller does not answer, or a check of the pre-flight failed; the message gives the operator action.
    """
    report = preflight(
        config.host, upper_registers=config.upper_registers, nominal=nominal_arm(scenario), load=config.load(),
        set_points=config.set_points,
    )  # fmt: skip
    require_ready(report)
    assert report.arm is not None
    assert report.arm_q is not None
    return PreparedRobot(report.arm, report.arm_q)
