"""Runs one task with one thread for numerics, so that its numbers do not depend on the computer's cores."""

import importlib
from collections.abc import Mapping
from typing import Any

from weldcal.models.errors import WeldcalError
from weldcal.tools.console import plain

FAILED = "failed"


def run_task(function: str, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Call ``function`` ("package.module:name") with keyword arguments; its result in JSON's own types.

    A WeldcalError becomes {"state": "failed", "reason": ...}: one task that cannot be done does not end a study.
    """
    import cv2
    from threadpoolctl import threadpool_limits

    module, name = function.split(":")
    call = getattr(importlib.import_module(module), name)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with threadpool_limits(1):
            found = plain(call(**arguments))
    except WeldcalError as error:
        return {"state": FAILED, "reason": str(error)}
    finally:
        cv2.setNumThreads(threads)
    if not isinstance(found, dict):
        raise TypeError(f"{function} returns a {type(found).__name__}. A task returns a mapping.")
    return found
