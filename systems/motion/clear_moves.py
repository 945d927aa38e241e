"""Moves straight in joint space are made only where the arm stays clear of the table and of itself."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.errors import UnreachableScanner
from weldcal.calibration.planning.calibration_poses import PlannedPose
from weldcal.calibration.planning.clearance import Body, arm_bodies, path_clearance
from weldcal.models.errors import InputError
from weldcal.systems.motion.goals import stands_at
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.station import Station

Joints = NDArray[np.float64]


def station_bodies(station: Station) -> list[Body]:
    """What may touch: the arm's links and its tool."""
    return arm_bodies(station.arm, () if station.tool is None else station.tool.capsules())


def clear_move(scenario: Scenario, station: Station, bodies: list[Body], q_a: Joints, q_b: Joints) -> bool:
    """Whether a move straight in joint space stays above the table and keeps the arm off itself; (6,) rad."""
    lowest, gap = path_clearance(station.arm, bodies, q_a, q_b)
    return lowest > scenario.calibration.table_z_m and gap > 0.0


def check_way_home(scenario: Scenario, station: Station) -> None:
    """The job begins at home; an arm that stands elsewhere must have a free way there.

    Raises:
        InputError: it has none; nothing has moved.
    """
    home = np.deg2rad(scenario.home_deg)
    if stands_at(station.q_start, home) or clear_move(
        scenario, station, station_bodies(station), station.q_start, home
    ):
        return
    stands = ", ".join(f"{angle:.0f}" for angle in np.rad2deg(station.q_start))
    wanted = ", ".join(f"{angle:.0f}" for angle in scenario.home_deg)
    raise InputError(
        f"The arm stands at [{stands}] deg, where a straight joint move to home would touch the table or the arm itself: "
        f"move it by hand near home_deg [{wanted}] first."
    )


def clear_poses(
    scenario: Scenario, station: Station, poses: Sequence[PlannedPose], bodies: list[Body]
) -> tuple[PlannedPose, ...]:
    """The poses that the FlangeMover reaches, each from the one before and with a free way home, in their order.

    Raises:
        UnreachableScanner: too many moves would touch the table or the arm itself.
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
            f"Only {len(kept)} of {needed} calibration poses can be reached without the arm coming into the table or itself; "
            "choose another home_deg or fewer maximum_scans."
        )
    return tuple(kept)
