"""Configuration of a calibration in a mounting other than eye-to-hand: the target, and the second arm."""

import dataclasses as dc

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from weldcal.models.arms.kinematics import LINKS
from weldcal.models.errors import InputError

CARRIERS = ("base", "flange", *LINKS)
"""The possible carriers of a scanner: the base, the flange, or a link of the arm."""
CARRIED = {
    "eye_in_hand": ("flange",),
    "eye_on_base": ("base",),
    "eye_on_arm_target_on_flange": LINKS[:-1],
    "eye_on_arm_target_on_base": LINKS[:-1],
    "co_manipulation": ("flange",),
}
"""The carriers of the scanner in each configuration."""


@dc.dataclass
class SecondArm:
    """The nominal pose of a co-manipulation's second robot, and the true pose's deviation (from the run's seed)."""

    arm: str = "ur10e"
    xyz_m: list[float] = dc.field(default_factory=lambda: [1.5, 0.0, 0.0])  # X_BD, its base in the first arm's base
    rpy_deg: list[float] = dc.field(default_factory=lambda: [0.0, 0.0, 180.0])
    placement_translation_mm: float = 20.0
    placement_rotation_deg: float = 1.0
    home_deg: list[float] = dc.field(default_factory=lambda: [0.0, -80.0, 110.0, -120.0, -90.0, 0.0])

    def pose(self) -> RigidTransform:
        """Return the nominal X_BD."""
        return RigidTransform(RollPitchYaw(np.deg2rad(self.rpy_deg)), self.xyz_m)


@dc.dataclass
class MountingJob:
    """A calibration with a circle of the robot as its target: flange, base circle, or a second arm's flange."""

    target_known: bool = True  # the circle's pose is known from the drawing; false: it is estimated too
    second_arm: SecondArm | None = None
    spread_deg: float = 35.0  # largest joint distance from home where joints are sampled, not views
    travel_deg: float = 126.0  # and where views are sampled: shorter moves, but less informative poses


def check_mounting(
    configuration: str, job: MountingJob | None, mounted_on: str, *, second_robot: bool, weld: bool
) -> None:
    """Check the mounting's settings against each other.

    Raises:
        InputError: one sentence that says what to change.
    """
    if configuration not in CARRIED:
        raise InputError(f"calibration.configuration must be one of {', '.join(CARRIED)}, not '{configuration}'.")
    if mounted_on not in CARRIERS:
        raise InputError(f"scanner.mounted_on must be one of {', '.join(CARRIERS)}, not '{mounted_on}'.")
    if mounted_on not in CARRIED[configuration]:
        raise InputError(
            f"In {configuration} the scanner is mounted_on {' or '.join(CARRIED[configuration])}, not '{mounted_on}'."
        )
    if job is None:
        if configuration != "eye_on_base" and not (configuration == "eye_in_hand" and weld):
            raise InputError(f"{configuration} needs a mounting part in the scenario: write mounting: {{}}.")
        if second_robot:
            raise InputError("A second robot belongs to co_manipulation: write robot_2: !NoDevice {}.")
        return
    if weld:
        raise InputError("A mounting job calibrates only: write job: {weld: false}.")
    two = configuration == "co_manipulation"
    if second_robot != two or (job.second_arm is not None) != two:
        raise InputError("co_manipulation, and it alone, has robot_2: !SimulatedUr {} and mounting.second_arm.")
