"""Hold what is known of a profiler's own scale and shear before its pose is calibrated, and its file sensor.yaml."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.common.yaml import yaml_dump

from weldcal.calibration.data.results import software_version
from weldcal.calibration.profiler.motion import Floats
from weldcal.models.documents import DocumentSection, read_document
from weldcal.models.errors import InputError
from weldcal.models.files import require_whole, write_atomic

SENSOR_FILE = "sensor.yaml"
WIDER, FARTHER = 0.2, 1.0  # choices: beyond these shares of its width, points are not of the field that was calibrated


@dataclass(frozen=True, eq=False, kw_only=True)
class SensorCorrection:
    """Scale and shear of a profiler in its plane of light, as `corrected` applies them.

    Attributes:
        values: (3,) [x scale, z scale, shear], zero where the profiles are right; covariance: (3, 3) of them.
        field_m: (2, 2) least and largest [x, z] m of the profiles that showed it.
        figures: what the command reports; data_sha256: of the file it came from.
    """

    values: Floats
    covariance: Floats
    field_m: Floats
    figures: dict[str, Any] = field(default_factory=dict)
    data_sha256: str = ""

    @property
    def origin(self) -> Floats:
        """The middle of the field (2,) m, which a correction of single points leaves where it is."""
        return np.asarray(self.field_m.mean(axis=0))

    def require_same_sensor(self, profiles: Sequence[Floats]) -> None:
        """Refuse profiles (m, 2) m that this correction's sensor cannot have made.

        Raises:
            InputError: they reach far out of its field.
        """
        p = np.vstack([q[np.isfinite(q).all(axis=1)] for q in profiles])
        low, high = self.field_m
        room = (high[0] - low[0]) * np.array([WIDER, FARTHER])
        if len(p) and not ((p.min(axis=0) >= low - room).all() and (p.max(axis=0) <= high + room).all()):
            mine, theirs = (
                f"x {1e3 * a[0]:.0f} to {1e3 * b[0]:.0f}, z {1e3 * a[1]:.0f} to {1e3 * b[1]:.0f} mm"
                for a, b in ((p.min(axis=0), p.max(axis=0)), self.field_m)
            )
            raise InputError(
                f"The profiles cover {mine}, and the sensor correction {theirs}: it is another sensor's, or in another"
                " unit. Run 'weldcal profiler step' with this sensor."
            )


def save_correction(correction: SensorCorrection, folder: Path) -> Path:
    """Write sensor.yaml into a folder; its path."""
    document = {
        "schema": 1,
        "software": software_version(),
        "units": "m; factors less 1",
        "x_scale_z_scale_shear": correction.values.tolist(),
        "covariance": correction.covariance.tolist(),
        "field": correction.field_m.tolist(),
        "figures": correction.figures,
        "data_sha256": correction.data_sha256,
    }
    write_atomic(folder / SENSOR_FILE, yaml_dump(document))
    return folder / SENSOR_FILE


def load_correction(path: Path) -> SensorCorrection:
    """Read a sensor.yaml, or the folder that holds it.

    Raises:
        InputError: it is not there, or no correction of a profiler.
    """
    path = path / SENSOR_FILE if path.is_dir() else path
    require_whole(path)
    if not path.exists():
        raise InputError(
            f"There is no sensor correction at '{path}': give a folder written by 'weldcal profiler step'."
        )
    document = read_document(path)
    if not isinstance(document, dict) or document.get("schema") != 1 or "x_scale_z_scale_shear" not in document:
        raise InputError(f"'{path.name}' is no correction of a profiler: run 'weldcal profiler step' again.")
    d = DocumentSection.of(path.name, document)
    C = d.array("covariance", 3, 3)
    if not (np.allclose(C, C.T) and np.linalg.eigvalsh(C)[0] > 0.0):
        raise InputError(f"'{path.name}' was changed by hand: run 'weldcal profiler step' again.")
    return SensorCorrection(
        values=d.array("x_scale_z_scale_shear", 3),
        covariance=C,
        field_m=d.array("field", 2, 2),
        figures=dict(d.section("figures").values),
        data_sha256=d.text("data_sha256"),
    )
