"""The arm of a scenario: its model or factory calibration, how it is mounted, and its corrected kinematics."""

from pathlib import Path

from weldcal.models.arms.kinematics import ArmModel, load_arm, mounted, with_link_transforms
from weldcal.systems.scenario.schema import Scenario


def nominal_arm(scenario: Scenario) -> ArmModel:
    """The arm of a scenario, with the scenario's kinematics file where it names one.

    Raises:
        InputError: the arm is not known, or its file is not one.
    """
    arm = load_arm(scenario.arm, None if scenario.kinematics is None else Path(scenario.kinematics))
    return mounted(arm, scenario.base.pose())


def corrected_arm(scenario: Scenario, arm: ArmModel) -> ArmModel:
    """The arm as the scenario's corrected kinematics state it, else `arm`, by which its controller computes.

    Raises:
        InputError: the file cannot be read, or is of another robot.
    """
    if scenario.corrected_kinematics is None:
        return arm
    path = Path(scenario.corrected_kinematics)
    read = load_arm(scenario.arm, path)
    return with_link_transforms(arm, read.stack, read.calibration, f"corrected_kinematics: '{path.name}'")
