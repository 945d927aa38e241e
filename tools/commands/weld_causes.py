"""Causes for the doctor from a weld log and from the reason for which a run was held."""

from weldcal.calibration.doctor.diagnose import Cause
from weldcal.welding.record.signs import PICTURE_S, WORN, blind_s, gain_off
from weldcal.welding.record.weld_log import WeldRecord

_SURE, _LIKELY, _SAID = 1e4, 1e3, 1.0


def weld_causes(record: WeldRecord | None, reason: str) -> tuple[Cause, ...]:
    """A hidden tag and a worn tip, from the log; another reason of a hold as it was given ("": the run was not held)."""
    causes = []
    blind = 0.0 if record is None else blind_s(record)
    if "Tag hidden" in reason or (not reason and blind > PICTURE_S):
        causes.append(Cause("hidden tag", 0.99 if reason else 0.8, _SURE, {"blind_s": blind}, (), reason))
    elif reason:
        causes.append(Cause("the run was held", 0.5, _SAID, {}, (), reason))
    off = None if record is None else gain_off(record)
    if off is not None and abs(off) > WORN:
        causes.append(Cause("soft tip worn", 0.9, _LIKELY, {"gain": 1.0 + off}, ()))
    return tuple(causes)
