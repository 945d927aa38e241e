"""Configuration of a job in motion: the cube that the flange moves through, how many frames are wanted, and what for."""

import dataclasses as dc

import numpy as np

from weldcal.models.errors import InputError

LEAST_FRAMES, MOST_FRAMES = 40, 5000


@dc.dataclass(kw_only=True)
class MotionJob:
    """The flange moves between corners of a cube while the scanner streams."""

    centre_m: list[float] = dc.field(default_factory=lambda: [0.65, 0.0, 0.30])  # of the cube, in the base
    edge_mm: float = 200.0
    lean_deg: float = (
        15.0  # largest lean of the flange from the scanner's direction, drawn from the seed for each corner
    )
    frames: int = 400  # frames with the flange that are wanted
    speed_m_s: float = 0.25  # largest speed of the flange
    queue: int = 2  # frames that wait for the fit
    record: bool = False  # write what streams as a recording in motion, to `recording` in the result folder
    recording_folder: str = ""  # set by the command
    watch: str = ""  # a calibration that is watched for drift instead of calibrating; set by `weldcal monitor`
    false_alarms_per_hour: float = 1e-3  # that are accepted of the drift test


def check_motion(job: MotionJob) -> None:
    """Check the part's numbers. Raises InputError: one sentence that says what to change."""
    if len(job.centre_m) != 3 or not np.isfinite(job.centre_m).all():
        raise InputError("motion.centre_m must be three numbers, in metres.")
    if not 20.0 <= job.edge_mm <= 1000.0:
        raise InputError(f"motion.edge_mm must be from 20 to 1000, and it is {job.edge_mm:g}.")
    if not 0.0 <= job.lean_deg <= 30.0:
        raise InputError(f"motion.lean_deg must be from 0 to 30, and it is {job.lean_deg:g}.")
    if not LEAST_FRAMES <= job.frames <= MOST_FRAMES:
        raise InputError(f"motion.frames must be from {LEAST_FRAMES} to {MOST_FRAMES}, and it is {job.frames}.")
    if not 0.01 <= job.speed_m_s <= 1.0:
        raise InputError(f"motion.speed_m_s must be from 0.01 to 1, and it is {job.speed_m_s:g}.")
    if not 1 <= job.queue <= 8:
        raise InputError(f"motion.queue must be from 1 to 8, and it is {job.queue}.")
