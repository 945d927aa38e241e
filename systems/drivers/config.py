"""What every driver's configuration says of itself: which devices it may be, and whether it needs the simulated world."""

import dataclasses as dc
from typing import ClassVar

from weldcal.models.scanners import ScannerPreset
from weldcal.models.tool import FingerCamera

DEVICES = ("robot_2", "robot", "scanner", "finger_camera", "wrist_camera", "digitizer", "profiler")
"""The devices of a station, by their key in the scenario; drivers are applied in this order."""


class DriverConfig:
    """Base class of the dataclass that a driver's module offers; its name is the tag in the scenario, such as `!SimulatedUr`.

    Beside it the module has `ApplyDriverConfig(config, build)`; a robot's may have `PrepareRobot(config, nominal)`, and any
    module `preflight(config)` for a check that moves nothing.
    """

    FOR: ClassVar[tuple[str, ...]] = ()  # some of DEVICES
    DEFAULT_FOR: ClassVar[tuple[str, ...]] = ()  # where a scenario does not name the device
    SIMULATED: ClassVar[bool] = False  # acts in the simulated world


@dc.dataclass
class NoDevice(DriverConfig):
    """`!NoDevice {}`: this cell has no such device."""

    FOR: ClassVar[tuple[str, ...]] = DEVICES


class ScannerConfig(DriverConfig):
    """What the cell asks of any scanner's configuration."""

    FOR: ClassVar[tuple[str, ...]] = ("scanner",)
    mounted_on: str = "base"  # or flange, or a link of the arm

    def scanner(self) -> ScannerPreset:
        """Intrinsics, range and noise: what poses are planned by."""
        raise NotImplementedError(f"{type(self).__name__} does not say which scanner it is")


class FingerCameraConfig(DriverConfig):
    """What the cell asks of any finger camera's configuration."""

    FOR: ClassVar[tuple[str, ...]] = ("finger_camera",)

    def camera(self) -> FingerCamera:
        """Size, focal length, rate and latency."""
        raise NotImplementedError(f"{type(self).__name__} does not say which camera it is")
