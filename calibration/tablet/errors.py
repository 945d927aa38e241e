"""Exceptions of the tablet calibration; each message names what to change."""

from weldcal.models.errors import InputError, WeldcalError


class TooFewLandmarks(InputError):
    """Fewer touched landmarks than the unknowns need."""


class CollinearLandmarks(InputError):
    """All landmarks lie on one line, which leaves a turn about it open."""


class EqualRotations(InputError):
    """The hand never turned between touches, so that the pen's offset cannot be told from the camera's place."""


class TabletDataError(InputError):
    """A file of touches cannot be used as it is."""


class LandmarksNotFound(WeldcalError):
    """A camera image does not show the landmarks that the tablet displays."""
