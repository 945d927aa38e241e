"""The nominal arm of a scenario: its model or factory calibration, and how it is mounted."""

from pathlib import Path

from weldcal.models.arms.kinematics import ArmModel, load_arm, mounted
from weldcal.systems.scenario.schema import Scenario


def nominal_arm(scenario: Scenario) -> ArmModel:
    """The arm of a scenario, with the scenario's kinematics file where it names one.

    Raises:
        InputError: the arm is not known, or its file is not one.
    """
    arm = load_arm(scenario.arm, None if scenario.kinematics is None else Path(scenario.kinematics))
    return mounted(arm, scenario.base.pose())
