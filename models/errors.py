"""Base classes of all named exceptions."""


class WeldcalError(Exception):
    """A problem that the user can put right; its text is one clear sentence that says what to change."""


class InputError(WeldcalError):
    """Something that was handed in cannot be used as it is (a file, a number, a unit, a scenario)."""
