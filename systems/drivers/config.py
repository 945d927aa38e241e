"""Base classes of driver configurations.

The devices that a driver supports, and whether it needs the simulated world.
"""

import dataclasses as dc
from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np

from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.errors import InputError
from weldcal.models.scanners import ScannerPreset
from weldcal.models.tool import FingerCamera
from weldcal.welding.record.schedule import WeldSchedule

DEVICES = (
    *("robot_2", "robot", "scanner", "finger_camera", "wrist_camera", "digitizer", "profiler", "touch_probe"),
    "power_source",
)
"""The devices of a station, by their key in the scenario; drivers are applied in this order."""


def check_range(key: str, value: float, low: float, high: float) -> None:
    """Raise InputError for a key of the scenario whose value is not from `low` to `high`."""
    if not low <= value <= high:
        raise InputError(f"{key} must be from {low:g} to {high:g}, and it is {value:g}.")


class DriverConfig:
    """Base class of the dataclass that a driver module defines.

    Its name is the tag in the scenario, such as `!SimulatedUr`.

    The module also defines `ApplyDriverConfig(config, build)`. A robot driver may define `PrepareRobot(config,
    nominal)`, and any sensor's driver `preflight(config) -> Sensed`, which looks at the device and causes no motion.
    """

    FOR: ClassVar[tuple[str, ...]] = ()  # some of DEVICES
    DEFAULT_FOR: ClassVar[tuple[str, ...]] = ()  # devices for which it is used where a scenario does not name one
    SIMULATED: ClassVar[bool] = False  # needs the simulated world

    def true_arm(self, arm: ArmModel, q_start: np.ndarray, rng: np.random.Generator) -> ArmModel:
        """The arm that a simulated world holds in place of the controller's model; the model itself by default."""
        return arm

    @property
    def reports_arc(self) -> bool:
        """Whether a driver of a robot or of a power source reports the arc."""
        return False

    @property
    def takes(self) -> tuple[str, ...]:
        """The set values of the power source that the driver passes on: names of schedule.VALUES, and job."""
        return ()

    def check_schedule(self, schedule: WeldSchedule) -> None:
        """Check that the driver can set each value of a schedule that it takes. Raises InputError."""

    def torch_delay_s(self) -> float:
        """Time from the command of the torch to the torch, s, such as for the shielding gas."""
        return 0.0


@dc.dataclass
class NoDevice(DriverConfig):
    """`!NoDevice {}`: the cell does not have this device."""

    FOR: ClassVar[tuple[str, ...]] = DEVICES


class ScannerConfig(DriverConfig, ABC):
    """Base class of all scanner configurations."""

    FOR: ClassVar[tuple[str, ...]] = ("scanner",)
    mounted_on: str = "base"  # or flange, or a link of the arm

    @abstractmethod
    def scanner(self) -> ScannerPreset:
        """Intrinsics, range and noise, used by pose planning."""

    def stream_delay_s(self) -> float | None:
        """Nominal time from capture to arrival, s, of a scanner that streams.

        None for one that scans when it is asked.
        """
        return None

    def put_at_nominal(self) -> tuple[list[float], list[float]] | None:
        """Put a simulated scanner exactly at its nominal pose; return xyz (m) and rpy (deg). None for a real one."""
        return None


class FingerCameraConfig(DriverConfig, ABC):
    """Base class of all finger camera configurations."""

    FOR: ClassVar[tuple[str, ...]] = ("finger_camera",)

    @abstractmethod
    def camera(self) -> FingerCamera:
        """Image size, focal length, frame rate and latency."""

    def tag_size_m(self) -> float | None:
        """The measured black side of the tag, m; None: as the tool has it."""
        return None
