"""What a scenario says of a calibration in another mounting than a scanner beside the arm: the target, and the second arm."""

import dataclasses as dc

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from weldcal.models.arms.kinematics import LINKS
from weldcal.models.errors import InputError

CARRIERS = ("base", "flange", *LINKS)
"""What may carry a scanner: nothing that moves, the flange, or a link of the arm."""
CARRIED = {
    "eye_in_hand": ("flange",),
    "eye_on_base": ("base",),
    "eye_on_arm_target_on_flange": LINKS[:-1],
    "eye_on_arm_target_on_base": LINKS[:-1],
    "co_manipulation": ("flange",),
}
"""What carries the scanner in each configuration."""


@dc.dataclass
class SecondArm:
    """The second robot of a co-manipulation as it is drawn, and how far it truly stands from there (from the run's seed)."""

    arm: str = "ur10e"
    xyz_m: list[float] = dc.field(default_factory=lambda: [1.5, 0.0, 0.0])  # X_BD, its base in the first one's
    rpy_deg: list[float] = dc.field(default_factory=lambda: [0.0, 0.0, 180.0])
    placement_translation_mm: float = 20.0
    placement_rotation_deg: float = 1.0
    home_deg: list[float] = dc.field(default_factory=lambda: [0.0, -80.0, 110.0, -120.0, -90.0, 0.0])

    def pose(self) -> RigidTransform:
        """X_BD as drawn."""
        return RigidTransform(RollPitchYaw(np.deg2rad(self.rpy_deg)), self.xyz_m)


@dc.dataclass
class MountingJob:
    """Calibrate by looking at the robot itself: its flange, its base circle, or the flange of a second arm."""

    target_known: bool = True  # the drawing says where the circle sits; false: that is sought too
    second_arm: SecondArm | None = None
    spread_deg: float = 35.0  # how far joints may go from home where a joint, not a view, is what is chosen
    travel_deg: float = 126.0  # and where it follows from the view: shorter moves, but poses that tell less


def check_mounting(
    configuration: str, job: MountingJob | None, mounted_on: str, *, second_robot: bool, weld: bool
) -> None:
    """Refuse what does not belong together.

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
        if configuration != "eye_on_base":
            raise InputError(f"{configuration} needs a mounting part in the scenario: write mounting: {{}}.")
        if second_robot:
            raise InputError("A second robot belongs to co_manipulation: write robot_2: !NoDevice {}.")
        return
    if weld:
        raise InputError("A mounting job calibrates only: write job: {weld: false}.")
    two = configuration == "co_manipulation"
    if second_robot != two or (job.second_arm is not None) != two:
        raise InputError("co_manipulation, and it alone, has robot_2: !SimulatedUr {} and mounting.second_arm.")
