"""Exceptions of the calibration package; each message names what to change."""

from typing import Any

from weldcal.models.errors import InputError, WeldcalError


class FlangeNotFound(WeldcalError):
    """No flange of the asked standard in a cloud; ``reason`` is the sentence without the cloud's name."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


class CircleFitError(WeldcalError):
    """A circle cannot be fitted to these points."""


class PlaneFitError(WeldcalError):
    """A plane cannot be fitted to these points."""


class TooFewPoses(InputError):
    """Fewer usable poses than a calibration needs."""


class CoplanarPoses(InputError):
    """The flange centres lie in one plane (or on one line)."""


class RepeatedPoses(InputError):
    """The same place was scanned again and again."""


class PureTranslation(InputError):
    """The robot never turned, so that rotations or positions stay open."""


class UndeterminedPoses(InputError):
    """The motion leaves so much open that an answer would be a guess; the message names the directions."""


class InconsistentPoses(InputError):
    """No rigid transform explains enough of the poses."""


class ScannerMoved(InconsistentPoses):
    """The camera's pose changed during the recording; ``details`` are the change and both parts, as plain types."""

    def __init__(self, message: str, details: dict[str, Any]) -> None:
        super().__init__(message)
        self.details = details


class DatasetError(InputError):
    """A dataset folder cannot be used as it is."""


class UnreachableScanner(WeldcalError):
    """No flange pose exists that the arm can take and the scanner can see."""
