"""Checks that moves on straight lines in joint space keep the arm clear of the table, the surroundings and itself."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.errors import UnreachableScanner
from weldcal.calibration.planning.calibration_poses import PlannedPose
from weldcal.calibration.planning.clearance import LinkCapsule, Surroundings, arm_bodies, path_clearance
from weldcal.models.arms.kinematics import Chain
from weldcal.models.errors import InputError
from weldcal.models.tool import WeldingTool
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.station import Station

AT_HOME_RAD = 0.01  # within this distance of home the job starts without a move


def stands_at(q: NDArray[np.float64], q_home: NDArray[np.float64]) -> bool:
    """Return whether each joint (6,) rad is within AT_HOME_RAD of home."""
    return bool(np.max(np.abs(q - q_home)) <= AT_HOME_RAD)


Joints = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class BareArm:
    """What plans of scans need of a station, for an arm that no driver moves."""

    arm: Chain
    tool: WeldingTool | None
    surroundings: Surroundings


def station_bodies(station: Station | BareArm) -> list[LinkCapsule]:
    """Return the bodies of the clearance checks: the arm's links and its tool."""
    return arm_bodies(station.arm, () if station.tool is None else station.tool.capsules())


def clear_move(
    scenario: Scenario, station: Station | BareArm, bodies: list[LinkCapsule], q_a: Joints, q_b: Joints
) -> bool:
    """Whether a straight move in joint space stays above the table, clear of the surroundings and of the arm itself.

    (6,) rad.
    """
    if station.surroundings.touched_on_path(station.arm, bodies, q_a, q_b):
        return False
    lowest, gap = path_clearance(station.arm, bodies, q_a, q_b)
    return lowest > scenario.table_height_m() and gap > 0.0


def check_way_home(scenario: Scenario, station: Station) -> None:
    """Check that the move from the arm's present configuration to home, where the job starts, is free.

    Raises:
        InputError: it is not free; nothing has moved.
    """
    home = np.deg2rad(scenario.home_deg)
    if stands_at(station.q_start, home) or clear_move(
        scenario, station, station_bodies(station), station.q_start, home
    ):
        return
    stands = ", ".join(f"{angle:.0f}" for angle in np.rad2deg(station.q_start))
    wanted = ", ".join(f"{angle:.0f}" for angle in scenario.home_deg)
    raise InputError(
        f"The arm is at [{stands}] deg, where a straight move home touches the table, the surroundings or the arm:"
        f" move it by hand near home_deg [{wanted}] first."
    )


def clear_poses(
    scenario: Scenario, station: Station | BareArm, poses: Sequence[PlannedPose], bodies: list[LinkCapsule]
) -> tuple[PlannedPose, ...]:
    """Return the poses that the FlangeMover can reach from the previous one and with a free move home, in their order.

    Raises:
        UnreachableScanner: too many moves would touch the table, the surroundings or the arm itself.
    """
    c, home = scenario.calibration, np.deg2rad(scenario.home_deg)
    kept: list[PlannedPose] = []
    for pose in poses:
        before = kept[-1].q if kept else home
        if clear_move(scenario, station, bodies, before, pose.q) and clear_move(
            scenario, station, bodies, pose.q, home
        ):
            kept.append(pose)
    needed = 1 + c.maximum_scans + c.verification_scans
    if len(kept) < needed:
        raise UnreachableScanner(
            f"Only {len(kept)} of {needed} calibration poses can be reached without contact of the arm with the table,"
            " the surroundings or itself; choose another home_deg or fewer maximum_scans."
        )
    return tuple(kept)
