"""Errors for a robot that cannot be started; each message is one sentence with the operator action."""

from weldcal.models.errors import WeldcalError


class RobotRefused(WeldcalError):
    """The robot or its state does not allow the job to start; nothing has moved."""


class RobotUnreachable(RobotRefused):
    """Nothing answers at the robot's address."""
