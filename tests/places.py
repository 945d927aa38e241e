"""Folders that tests read from: the project's root, and the shared data beside it, without which CI fails."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SHARED_DATA = ROOT.parent / "shared" / "data"
ABSENT = "the measured data (shared/data beside the checkout) are not here"


def in_ci() -> bool:
    """Whether this is a check before a merge: the environment variable CI is set and not 0 or false; `.ci/run` sets
    it."""
    return os.environ.get("CI", "").lower() not in ("", "0", "false")


def require_data(path: Path) -> None:
    """Skip the test where measured data are absent, and fail it in CI."""
    if path.exists():
        return
    if in_ci():
        pytest.fail(f"{ABSENT}, and in CI no test may be left out for that: {path.name}", pytrace=False)
    pytest.skip(ABSENT)


def needs(path: Path) -> pytest.MarkDecorator:
    """The mark of tests that read measured data."""
    return pytest.mark.needs_data(path)
