"""Exceptions of the calibration package; each message names what to change."""

from typing import Any

from weldcal.models.errors import InputError, WeldcalError


class TooFewLandmarks(InputError):
    """Fewer touched landmarks than the unknowns need."""


class CollinearLandmarks(InputError):
    """All landmarks lie on one line, which leaves a turn about it open."""


class EqualRotations(InputError):
    """Report that the hand never turned between touches, so that pen offset and camera position are not separable."""


class TabletDataError(InputError):
    """A file of touches cannot be used as it is."""


class LandmarksNotFound(WeldcalError):
    """A camera image does not show the landmarks that the tablet displays."""


class ToolNotFound(WeldcalError):
    """Scans or touches do not show a part of the tool."""


class FeatureNotFound(WeldcalError):
    """A profile does not show the feature that was asked for."""


class ArcNotFound(FeatureNotFound):
    """A profile does not show an arc of the sphere."""


class TooFewRotations(InputError):
    """Fewer orientations of the flange than the method needs."""


class TooFewTranslations(InputError):
    """Fewer positions of the flange in one orientation than the method needs."""


class DegenerateMotion(InputError):
    """The robot's motion leaves a part of the answer open, whatever the accuracy."""


class InconsistentData(WeldcalError):
    """The profiles do not show one and the same object."""


class RadiusError(InputError):
    """Report that the sphere's radius does not agree with its profiles."""


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
