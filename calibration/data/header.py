"""Schema of dataset.yaml: the contents of a calibration dataset and its units."""

# no `from __future__ import annotations` here: pydrake's YAML reader needs the field types themselves, not their names

from dataclasses import dataclass, field


@dataclass
class Units:
    """Length units of the files: ``m`` or ``mm``. Flange poses and clouds must then lie 10 mm to 10 m away (median)."""

    clouds: str = "m"
    poses: str = "m"


@dataclass
class Feature:
    """Pose of the flange-like feature in the flange frame: position m and quaternion wxyz; identity for a
    bare flange."""

    xyz: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    wxyz: list[float] = field(default_factory=lambda: [1.0, 0.0, 0.0, 0.0])


@dataclass
class ScannerGuess:
    """Approximate pose X_BC of the scanner: position m, quaternion wxyz, and the largest error of the feature it causes, m."""

    xyz: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    wxyz: list[float] = field(default_factory=lambda: [1.0, 0.0, 0.0, 0.0])
    radius_m: float = 0.06


@dataclass
class DatasetHeader:
    """Contents of dataset.yaml. ``mode``: static (a scan at each pose) or motion (scans while the arm moves)."""

    schema: int = 0
    robot: str = ""
    flange: str = ""
    scanner: str = ""
    configuration: str = ""
    units: Units = field(default_factory=Units)
    note: str = ""
    feature_in_flange: Feature = field(default_factory=Feature)
    scanner_guess: ScannerGuess | None = None
    mode: str = "static"
