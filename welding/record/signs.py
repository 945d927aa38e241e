"""Signs of trouble in a weld log.

A tag that is no longer seen, and a tip whose tag moves otherwise than it was calibrated.
"""

import numpy as np

from weldcal.welding.record.weld_log import WeldRecord

# A finger camera sends pictures far more often: a deflection that is constant for longer belongs to none of them.
PICTURE_S = 0.1


def blind_s(record: WeldRecord) -> float:
    """How long (s) before its end the log repeats one deflection to the last bit, if it ends with a fault; else 0."""
    if len(record) < 2 or record.phase[-1] != "FAULT":
        return 0.0
    deflection = record.points("deflection")
    last = deflection[-1]
    same = ((deflection == last) | (np.isnan(deflection) & np.isnan(last))).all(axis=1)
    changed = np.flatnonzero(~same)
    begin = 0 if len(changed) == 0 else int(changed[-1]) + 1
    return float(record["time_s"][-1] - record["time_s"][begin])


def gain_off(record: WeldRecord) -> float | None:
    """How far the gain from touch-on is from 1 (-: the tag moves less than the tip); None where it was not measured."""
    gain = record["gain"]
    known = gain[np.isfinite(gain) & (gain != 1.0)]
    return float(known[-1] - 1.0) if len(known) else None
