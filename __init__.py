"""weldcal: calibrate a 3D scanner to a robot by the robot's own flange, then weld along a seam that is felt by touch.

The functions are those of `weldcal.tools.api`. They are imported when they are first used: importing weldcal stays
fast.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from weldcal.tools.api import (
        build_cell,
        calibrate,
        fit_flange,
        hand_eye,
        load_scenario,
        read_calibration,
        read_cloud,
        run,
        verify,
    )

    __version__: str

__all__ = [
    "build_cell",
    "calibrate",
    "fit_flange",
    "hand_eye",
    "load_scenario",
    "read_calibration",
    "read_cloud",
    "run",
    "verify",
]

if not TYPE_CHECKING:  # a type checker would take every name for one of weldcal

    def __getattr__(name: str) -> object:
        if name == "__version__":
            from importlib.metadata import PackageNotFoundError, version

            try:
                return version("weldcal")
            except PackageNotFoundError:
                raise AttributeError("weldcal is not installed, so its version is not known") from None
        if name not in __all__:
            raise AttributeError(f"module 'weldcal' has no attribute '{name}'")
        from weldcal.tools import api

        return getattr(api, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, "__version__"})
