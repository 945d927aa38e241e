"""Why a robot is not started: one sentence each, with what to press."""

from weldcal.models.errors import WeldcalError


class RobotRefused(WeldcalError):
    """The robot, or its state, does not allow the job to begin; nothing has moved."""


class RobotUnreachable(RobotRefused):
    """Nothing answers at the robot's address."""
