"""Finds jobs: modules of weldcal.systems.jobs, and modules that installed packages register with their drivers."""

import importlib
import pkgutil
from functools import cache
from typing import Any

import weldcal.systems.jobs as rooms
from weldcal.models.errors import InputError
from weldcal.systems.drivers.discovery import plugins
from weldcal.systems.jobs.job import Job
from weldcal.systems.scenario.schema import Scenario

MODULE = "job"  # jobs/<job>/job.py holds JOB


@cache
def jobs() -> tuple[Job[Any], ...]:
    """All jobs, sorted by key; the job without a key is the last."""
    names = [info.name for info in pkgutil.iter_modules(rooms.__path__, rooms.__name__ + ".") if info.ispkg]
    modules = [importlib.import_module(f"{name}.{MODULE}") for name in names]
    found = [module.JOB for module in (*modules, *plugins()) if hasattr(module, "JOB")]
    return tuple(sorted(found, key=lambda job: (not job.key, job.key)))


def job_of(scenario: Scenario) -> Job[Any]:
    """The job of a scenario: the one whose part the scenario contains, else the job without a key.

    Raises:
        InputError: the scenario has the parts of two jobs.
    """
    asked = [job for job in jobs() if job.key and getattr(scenario, job.key, None) is not None]
    if len(asked) > 1:
        keys = " or ".join(job.key for job in asked)
        raise InputError(f"A scenario has one job: move {keys} to another scenario.")
    return asked[0] if asked else jobs()[-1]
