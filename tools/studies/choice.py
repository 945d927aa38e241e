"""One command for several measurements of a subject: --what names the one that is run."""

import inspect
from collections.abc import Callable, Mapping
from typing import Any

from weldcal.models.errors import InputError
from weldcal.tools.cli.options import Call, Outcome

MISSED = "Some targets were missed; see the table."


def run_chosen(call: Call, what: str, parts: Mapping[str, Callable[..., Any]], given: Mapping[str, Any]) -> Outcome:
    """Run one of the parts with the options that were given; None is an option that was not.

    Raises:
        InputError: there is no such part, or it has no such option.
    """
    if what not in parts:
        raise InputError(f"--what is '{what}': use one of {', '.join(parts)}.")
    options = {name: value for name, value in given.items() if value is not None}
    known = inspect.signature(parts[what]).parameters
    for name in options:
        if name not in known:
            raise InputError(f"--{name.replace('_', '-')} is no option of --what {what}.")
    found = parts[what](call, **options)
    return found if isinstance(found, Outcome) else Outcome(found)
