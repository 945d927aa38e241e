"""Exceptions of the profiler calibration; each message names what to change."""

from weldcal.models.errors import InputError, WeldcalError


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
    """The sphere's radius does not agree with what was seen of it."""
