"""The mark of tests that need ur_rtde, a client of the emulator, which Python 3.13 does not have yet."""

from __future__ import annotations

import importlib.util

import pytest

NEEDS_UR_RTDE = pytest.mark.skipif(
    importlib.util.find_spec("rtde_control") is None,
    reason="ur-rtde is not installed: it has no wheel for Python 3.13 yet",
)
