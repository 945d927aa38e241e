"""Results of the motion study: errors of both modes as the paper's Table 1 lists them, the clock, tracking, quality, targets."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from weldcal.models.arrays import Array
from weldcal.tools.studies.targets import Target, all_met

COMPONENTS = ("roll", "pitch", "yaw", "x", "y", "z")


@dataclass(frozen=True)
class MotionStudyOptions:
    """What is run: ``quick`` takes a seventh of the pixels and few frames."""

    folder: Path
    seed: int = 0
    quick: bool = False
    frames: int | None = None


@dataclass(frozen=True, eq=False)
class Row:
    """A row of Table 1: ICP errors (N, 6) of the flange mesh at poses, degrees and mm in the flange's axes."""

    name: str
    errors: Array

    @property
    def mean(self) -> Array:
        """Mean (6,)."""
        return np.asarray(self.errors.mean(axis=0))

    @property
    def spread(self) -> Array:
        """Standard deviation (6,)."""
        return np.asarray(self.errors.std(axis=0))

    @property
    def rms_mm(self) -> float:
        """Rms length of the displacement, mm."""
        return float(np.sqrt(np.mean((self.errors[:, 3:] ** 2).sum(axis=1))))

    @property
    def largest_mm(self) -> float:
        """Largest displacement along one axis, mm."""
        return float(np.abs(self.errors[:, 3:]).max())


@dataclass(frozen=True, eq=False)
class Track:
    """Times (N,) s from the first frame; the flange's centre by the robot (N, 3) m at the capture and at the arrival, and by the
    scanner."""

    t: Array
    robot: Array
    robot_at_arrival: Array
    scanner: Array


@dataclass(frozen=True)
class Quality:
    """Fig. 9: points on the flat face, their rms about its plane and that of its outer edge, mm."""

    points: int
    plane_mm: float
    edge_mm: float


@dataclass(frozen=True, eq=False, kw_only=True)
class MotionStudy:
    """All that was found. Errors of X_BC: mm at the cube's centre and at the camera's origin, degrees.
    ``icp_share`` of a shift along x, y and z that point-to-point ICP reports."""

    options: MotionStudyOptions
    rows: tuple[Row, ...]
    icp_share: tuple[float, float, float]
    history_t: Array
    history_before: Array
    history_after: Array
    track: Track
    tracking_rms_mm: float
    tracking_before_mm: float
    offset_ms: float
    offset_sigma_ms: float | None
    offset_error_ms: float
    clock: str
    delay_ms: float
    arrival_offset_error_ms: float
    X_errors: dict[str, tuple[float, float, float]]
    compensation: dict[str, tuple[float, float]]
    quality: dict[str, Quality]
    faces: dict[str, Array]
    throughput: dict[str, float]
    n_frames: int
    n_seen: int
    wall_seconds: float

    @property
    def targets(self) -> tuple[Target, ...]:
        """The issue's figures and the paper's."""
        centre, origin, turn = self.X_errors["motion, synchronised"]
        decides = not self.options.quick
        return (
            Target("tracking while moving, rms", "mm", self.tracking_rms_mm, 0.15, decides=decides),
            Target("X_BC in motion, at the cube", "mm", centre, 0.10, decides=decides),
            Target("X_BC in motion, rotation", "deg", turn, 0.02, decides=decides),
            Target("X_BC in motion, at the camera's origin", "mm", origin, 0.10, decides=False),
            Target("clock offset, device stamps", "ms", abs(self.offset_error_ms), 0.5, decides=decides),
            Target("clock offset, arrivals only", "ms", abs(self.arrival_offset_error_ms), 1.5, decides=False),
            Target("static mode, ICP error (the paper: about 1 mm)", "mm", self.rows[0].rms_mm, 1.0, decides=decides),
        )  # fmt: skip

    @property
    def met(self) -> bool:
        """Whether every target that decides is met."""
        return all_met(self.targets)

    def summary(self) -> dict[str, object]:
        """The JSON object."""
        return {
            "state": "done",
            "met": self.met,
            "table_1": {
                r.name: {
                    "mean": dict(zip(COMPONENTS, r.mean.tolist(), strict=True)),
                    "sd": dict(zip(COMPONENTS, r.spread.tolist(), strict=True)),
                    "rms_mm": r.rms_mm, "poses": len(r.errors),
                }
                for r in self.rows
            },
            "icp_share": list(self.icp_share), "largest_unsynchronised_mm": self.rows[1].largest_mm,
            "X_BC_error": {
                n: {"at_the_cube_mm": v[0], "at_the_camera_mm": v[1], "deg": v[2]} for n, v in self.X_errors.items()
            },
            "clock_offset_ms": self.offset_ms, "clock_offset_sigma_ms": self.offset_sigma_ms,
            "clock_offset_error_ms": self.offset_error_ms, "clock": self.clock,
            "arrival_offset_error_ms": self.arrival_offset_error_ms, "delay_ms": self.delay_ms,
            "tracking_rms_mm": {"before": self.tracking_before_mm, "after": self.tracking_rms_mm},
            "compensation_rms_mm": {n: {"before": v[0], "after": v[1]} for n, v in self.compensation.items()},
            "quality": self.quality, "throughput": self.throughput,
            "frames": self.n_frames, "frames_seen": self.n_seen,
            "targets": [
                {"what": t.what, "reached": t.value, "wanted": t.wanted, "met": t.met} for t in self.targets
            ],
            "wall_seconds": self.wall_seconds,
            "written_to": self.options.folder,
        }  # fmt: skip
