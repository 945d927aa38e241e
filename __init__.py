"""weldcal: calibrate a 3D scanner to a robot by the robot's own flange, then weld along a seam that is felt by touch.

The functions are those of `weldcal.tools.api`. They are imported when they are first used: importing weldcal stays
fast.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from weldcal.models.errors import InputError as InputError, WeldcalError as WeldcalError
    from weldcal.tools.api import (
        build_cell as build_cell,
        calibrate as calibrate,
        fit_flange as fit_flange,
        hand_eye as hand_eye,
        load_scenario as load_scenario,
        read_calibration as read_calibration,
        read_cloud as read_cloud,
        run as run,
        verify as verify,
    )

    __version__: str
else:
    from weldcal.models import exported

    _load, _names = exported(__name__)

    def __getattr__(name: str) -> object:
        if name != "__version__":
            return _load(name)
        from importlib.metadata import PackageNotFoundError, version

        try:
            return version("weldcal")
        except PackageNotFoundError:
            raise AttributeError("weldcal is not installed, so its version is not known") from None

    def __dir__() -> list[str]:
        return [*_names(), "__version__"]
