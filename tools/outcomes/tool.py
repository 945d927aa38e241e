"""What `weldcal tool check` understood of a tool file."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from weldcal.models.arrays import Array
from weldcal.models.robots import ROBOTS
from weldcal.models.tools.loading import LoadedTool


@dataclass(frozen=True, eq=False)
class ToolCheck:
    """A tool, the pixels (4, 2) of its resting tag in its camera, and the folder of the drawing (None: not drawn)."""

    loaded: LoadedTool
    tag_px: Array
    folder: Path | None

    @property
    def carriers(self) -> list[str]:
        """Universal Robots' arms whose payload is enough."""
        return [r.name for r in ROBOTS.values() if r.name.startswith("ur") and r.payload_kg >= self.loaded.tool.mass_kg]

    def summary(self) -> dict[str, object]:
        """The JSON object: millimetres and degrees, poses in the flange frame."""
        t, camera = self.loaded.tool, self.loaded.camera
        far_mm = 1e3 * float(np.linalg.norm(t.X_KM_rest.translation()))
        side_px = float(np.linalg.norm(self.tag_px[1] - self.tag_px[0]))
        return {
            "state": "done",
            "name": self.loaded.name,
            "file": str(self.loaded.file),
            "mass_kg": t.mass_kg,
            "centre_of_gravity_mm": _mm(t.centre_of_mass_m),
            "feature": "flange" if t.ring is None else "tool_ring",
            "ring": None
            if t.ring is None
            else {"outer_mm": 1e3 * t.ring.outer_m, "bore_mm": 1e3 * t.ring.bore_m, **_pose(t.X_FR)},
            "tip": {
                **_pose(t.X_FT),
                "radius_mm": 1e3 * t.tip_radius_m,
                "lateral_stiffness_N_per_mm": 1e-3 * t.lateral_stiffness_N_per_m,
                "axial_stiffness_N_per_mm": 1e-3 * t.axial_stiffness_N_per_m,
            },
            "torch": {
                "xyz_mm": _mm(self.loaded.p_FW),
                "behind_tip_mm": 1e3 * t.chord_m,
                "above_tip_mm": 1e3 * t.torch_height_m,
                "to_finger_deg": self.torch_to_finger_deg,
            },
            "finger_camera": {
                **_pose(t.X_FK),
                "width": camera.width,
                "height": camera.height,
                "focal_px": camera.focal_px,
            },
            "tag": {
                **_pose(t.X_FM_rest),
                "dictionary": t.tag_dictionary,
                "id": t.tag_id,
                "size_mm": 1e3 * t.tag_size_m,
                "from_camera_mm": far_mm,
                "side_px": side_px,
            },
            "shapes": len(t.drawn()),
            "keep_clear": len(t.capsules()),
            "carried_by": self.carriers,
            "folder": None if self.folder is None else str(self.folder),
        }

    @property
    def torch_to_finger_deg(self) -> float:
        """Angle between wire and finger."""
        finger = -self.loaded.tool.X_FT.rotation().matrix()[:, 2]
        return float(np.rad2deg(np.arccos(np.clip(finger @ self.loaded.torch_axis, -1.0, 1.0))))

    def rows(self) -> dict[str, str]:
        """What was understood, in lines."""
        t, camera = self.loaded.tool, self.loaded.camera
        s = self.summary()
        tag, ring = s["tag"], t.ring
        assert isinstance(tag, dict)
        return {
            "weight": f"{t.mass_kg:g} kg at {_text(t.centre_of_mass_m)} mm; carried by {', '.join(self.carriers) or 'no arm'}",
            "measured by the scanner": "the arm's bare flange"
            if ring is None
            else f"ring of {1e3 * ring.outer_m:g} mm, bore {1e3 * ring.bore_m:g} mm, at {_text(t.X_FR.translation())} mm",
            "tip": f"ball of {1e3 * t.tip_radius_m:g} mm radius at {_text(t.X_FT.translation())} mm, "
            f"{1e-3 * t.lateral_stiffness_N_per_m:g} N/mm across and {1e-3 * t.axial_stiffness_N_per_m:g} N/mm along",
            "torch": f"wire point at {_text(self.loaded.p_FW)} mm, {1e3 * t.chord_m:.1f} mm behind the tip and "
            f"{1e3 * t.torch_height_m:.1f} mm above it, {self.torch_to_finger_deg:.0f} deg from the finger",
            "finger camera": f"{camera.width} x {camera.height} px, focal length {camera.focal_px:g} px, at "
            f"{_text(t.X_FK.translation())} mm",
            "tag": f"{t.tag_dictionary} number {t.tag_id}, {1e3 * t.tag_size_m:.2f} mm, {tag['from_camera_mm']:.1f} mm from the camera: "
            f"{tag['side_px']:.0f} px wide",
            "bodies": f"{len(t.drawn())} drawn, {len(t.capsules())} capsules kept clear",
        }


def _mm(values: object) -> list[float]:
    return [round(1e3 * float(v), 6) + 0.0 for v in np.asarray(values, dtype=float)]


def _pose(X: RigidTransform) -> dict[str, list[float]]:
    rpy = np.rad2deg(RollPitchYaw(X.rotation()).vector())
    return {"xyz_mm": _mm(X.translation()), "rpy_deg": [round(float(v), 6) + 0.0 for v in rpy]}


def _text(values: object) -> str:
    return "(" + ", ".join(f"{v:g}" for v in _mm(values)) + ")"
