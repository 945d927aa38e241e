"""Write the page of `tool check`: the tool from three sides, and what its finger camera sees; report a TCP."""

import io
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Polygon
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from scipy.spatial import ConvexHull, QhullError

from weldcal.calibration.geometry.robust import radius_95
from weldcal.calibration.geometry.se3 import exp_rotation
from weldcal.calibration.tool.wire import TouchedTcp, WireTouch
from weldcal.models.arms.urdf import Capsule
from weldcal.models.arrays import Array
from weldcal.models.flanges import flange_mesh
from weldcal.models.mesh import TriMesh, circle, revolve
from weldcal.models.robots import ROBOTS
from weldcal.models.tool import ToolShape
from weldcal.models.tools.enclosing import shape_mesh
from weldcal.models.tools.loading import LoadedTool
from weldcal.systems.drivers.simulated.rendered_finger_camera import TagView
from weldcal.tools.report.first_screen import (
    CARE,
    USE,
    Findings,
    FirstScreen,
    Next,
    ShownPose,
    expected_error,
    limit_tolerance,
)
from weldcal.tools.report.page import Shot, TableRows, page_html
from weldcal.tools.report.pictures import subplots
from weldcal.welding.servo.tool_axes import least_pipe_m

COLOURS = {"dark": "#4a525c", "steel": "#a5abb3", "copper": "#c47a3d", "soft": "#3d7aa6", "white": "#f4f4f4"}
KEEP, AXIS = "#b04a3a", "#20262c"
_SEGMENTS = 32
NAMES_APART_MM = 9.0
WALL_M = 0.1  # of pipe and plate beside the seam
FLANGE_M = 0.0315  # radius of the flange: ISO 9409-1-50 has 63 mm
GAP_M = 0.010  # a choice: a wider gap between bodies holds no washer or bracket that nobody draws
LONGEST_M = 0.040  # from nozzle to wire point, where the file does not state it: twice a usual stick-out
_SLOPPY_M = 5e-3  # a choice: an operator with a pointed tip misses by 1 to 3 mm (UR forum, topic 23542)


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
        """Return the JSON object: millimetres and degrees, poses in the flange frame."""
        t, camera = self.loaded.tool, self.loaded.camera
        far_mm = 1e3 * float(np.linalg.norm(t.X_KM_rest.translation()))
        side_px = float(np.linalg.norm(self.tag_px[1] - self.tag_px[0]))
        return {
            "state": "done",
            "verdict": USE if not self.contradictions else CARE,
            "contradictions": self.contradictions,
            "name": self.loaded.name,
            "file": str(self.loaded.file),
            "mass_kg": t.mass_kg,
            "centre_of_gravity_mm": _mm(t.centre_of_mass_m),
            "feature": "flange" if t.ring is None else "tool_ring",
            "ring": (
                None
                if t.ring is None
                else {"outer_mm": 1e3 * t.ring.outer_m, "bore_mm": 1e3 * t.ring.bore_m, **_pose(t.X_FR)}
            ),
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
            "least_pipe_mm": self.least_pipe_mm,
            "carried_by": self.carriers,
            "folder": None if self.folder is None else str(self.folder),
        }

    @property
    def torch_to_finger_deg(self) -> float:
        """Angle between wire and finger."""
        finger = -self.loaded.tool.X_FT.rotation().matrix()[:, 2]
        return float(np.rad2deg(np.arccos(np.clip(finger @ self.loaded.torch_axis, -1.0, 1.0))))

    @cached_property
    def least_pipe_mm(self) -> float:
        """Diameter of the least pipe whose outside the tool can weld onto a plate, both WALL_M wide beside the seam."""
        return round(1e3 * least_pipe_m(self.loaded.tool, WALL_M))

    @cached_property
    def contradictions(self) -> list[str]:
        """What of the file contradicts its own bodies: a body that nothing carries, a wire point beside the torch."""
        t, found = self.loaded.tool, list[str]()
        bodies = [(s.name, _shape_points(s)) for s in t.drawn()]
        rim = np.column_stack([circle(FLANGE_M, _SEGMENTS), np.zeros(_SEGMENTS)])
        carried, loose = [np.vstack([rim, rim - [0.0, 0.0, FLANGE_M]])], bodies
        while near := [b for b in loose if min(apart_m(b[1], c) for c in carried) <= GAP_M]:
            carried, loose = [*carried, *(p for _, p in near)], [b for b in loose if b not in near]
        if loose:
            gap = 1e3 * min(apart_m(points, c) for _, points in loose for c in carried)
            names = ("Body " if len(loose) == 1 else "Bodies ") + ", ".join(name for name, _ in loose)
            found.append(
                f"{names}: {gap:.0f} mm away from the flange and all that it carries. Correct xyz_mm, or draw what"
                " is between."
            )
        back = LONGEST_M if t.stick_out_m is None else t.stick_out_m
        off, name = min(
            [(self._off_torch(self.loaded.p_FW, points, back), name) for name, points in bodies] or [(0, "")]
        )
        if off > t.nozzle_radius_m:
            said = f"The wire point is not at a torch: {1e3 * back:.0f} mm up its wire the nearest body, {name}, is"
            found.append(f"{said} {1e3 * off:.0f} mm away. {self._other_sign(bodies, back)}")
        return found

    def _off_torch(self, p_FW: Array, points: Array, back_m: float) -> float:
        """Distance, m, at least, of the wire behind a wire point from a body's hull."""
        return apart_m(points, np.array([p_FW, p_FW - back_m * self.loaded.torch_axis]))

    def _other_sign(self, bodies: list[tuple[str, Array]], back_m: float) -> str:
        for k in range(3):
            other = self.loaded.p_FW * np.where(np.arange(3) == k, -1.0, 1.0)
            at = [n for n, p in bodies if self._off_torch(other, p, back_m) <= self.loaded.tool.nozzle_radius_m]
            if at:
                return f"With the other sign of its {'xyz'[k]} it is at {at[-1]}: correct torch.xyz_mm."
        return "Correct torch.xyz_mm or the body of the torch."

    @property
    def verdict(self) -> str:
        """The verdict and its reason, as a sentence."""
        words = f"in {self.loaded.file.name} contradicts its drawing"
        return f"{CARE}: a statement {words}" if self.contradictions else f"{USE}: nothing {words}"

    def rows(self) -> dict[str, str]:
        """What was understood, in lines."""
        t, camera = self.loaded.tool, self.loaded.camera
        s = self.summary()
        tag, ring = s["tag"], t.ring
        assert isinstance(tag, dict)
        return {
            "weight": (
                f"{t.mass_kg:g} kg at {_text(t.centre_of_mass_m)} mm; carried by {', '.join(self.carriers) or 'no arm'}"
            ),
            "measured by the scanner": (
                "the arm's bare flange"
                if ring is None
                else (
                    f"ring of {1e3 * ring.outer_m:g} mm, bore {1e3 * ring.bore_m:g} mm, at"
                    f" {_text(t.X_FR.translation())} mm"
                )
            ),
            "tip": (
                f"ball of {1e3 * t.tip_radius_m:g} mm radius at {_text(t.X_FT.translation())} mm,"
                f" {1e-3 * t.lateral_stiffness_N_per_m:g} N/mm across and {1e-3 * t.axial_stiffness_N_per_m:g} N/mm"
                " along"
            ),
            "torch": (
                f"wire point at {_text(self.loaded.p_FW)} mm, {1e3 * t.chord_m:.1f} mm behind the tip and "
                f"{abs(1e3 * t.torch_height_m):.1f} mm {'above' if t.torch_height_m > 0.0 else 'below'} it, "
                f"{self.torch_to_finger_deg:.0f} deg from the finger"
            ),
            "finger camera": (
                f"{camera.width} x {camera.height} px, focal length {camera.focal_px:g} px, at "
                f"{_text(t.X_FK.translation())} mm"
            ),
            "tag": (
                f"{t.tag_dictionary} number {t.tag_id}, {1e3 * t.tag_size_m:.2f} mm, {tag['from_camera_mm']:.1f} mm"
                f" from the camera: {tag['side_px']:.0f} px wide"
            ),
            "least pipe": f"{self.least_pipe_mm:g} mm across, welded onto a plate from outside",
            "bodies": f"{len(t.drawn())} drawn, {len(t.capsules())} capsules kept clear",
        }


def apart_m(a: Array, b: Array) -> float:
    """Return how far the hulls of two sets of points (N, 3) m are apart, at least; 0 or less where they may meet.

    The widest gap along a normal of a face of either is taken: two hulls are apart by no less.
    """
    gaps = [-np.inf]
    for body, other in ((a, b), (b, a)):
        if len(body) > 3:
            equations = ConvexHull(body).equations
            gaps.append(float((other @ equations[:, :3].T + equations[:, 3]).min(axis=0).max()))
    return max(gaps)


def _mm(values: object) -> list[float]:
    return [round(1e3 * float(v), 6) + 0.0 for v in np.asarray(values, dtype=float)]


def _pose(X: RigidTransform) -> dict[str, list[float]]:
    rpy = np.rad2deg(RollPitchYaw(X.rotation()).vector())
    return {"xyz_mm": _mm(X.translation()), "rpy_deg": [round(float(v), 6) + 0.0 for v in rpy]}


def _text(values: object) -> str:
    return "(" + ", ".join(f"{v:g}" for v in _mm(values)) + ")"


matplotlib.use("Agg")


def tool_report(check: ToolCheck, picture: bytes) -> str:
    """Return the page of a tool as one self-contained HTML text."""
    name, notes = check.loaded.name, " ".join(check.contradictions)
    said = notes or "Compare the drawing with the tool on the bench: a wrong length shows here."
    rows = TableRows(list(check.rows().items()), ("part", "what was understood"), (0, 1))
    return page_html(
        check.verdict[:1].upper() + check.verdict[1:],
        f"Tool {name} as {check.loaded.file.name} describes it; millimetres and degrees in the flange frame, z out of"
        " the flange",
        [("", [Shot(picture, DRAWN, "Drawing of the tool"), rows])],
        verdict=("warn" if notes else "good", f"Tool {name}", said),
    )


DRAWN = (
    "The tool from three sides, and the picture of its finger camera while the tip is free. Dashed: the capsules that"
    " are kept clear of the table, of the arm and of the scanner's line of sight."
)


def tool_picture(loaded: LoadedTool) -> bytes:
    """Draw the tool in F (mm) from the side, from behind and along the flange axis, and the camera's picture."""
    figure, axes = subplots(13.0, 9.5, 2, 2)
    for at, plane, names in ((axes[0, 0], (0, 2), "xz"), (axes[0, 1], (1, 2), "yz"), (axes[1, 0], (0, 1), "xy")):
        _view(at, loaded, plane)
        at.set(xlabel=f"{names[0]} of the flange, mm", ylabel=f"{names[1]} of the flange, mm")
        at.set_aspect("equal", adjustable="datalim")
        at.grid(alpha=0.25)
        if names[1] == "z":
            at.invert_yaxis()
    axes[0, 0].set_title("from the side; the flange is on top, the work below", fontsize=10, loc="left")
    axes[0, 1].set_title("from behind", fontsize=10, loc="left")
    axes[1, 0].set_title(
        "along the flange's axis; dashed: kept clear of table and line of sight", fontsize=10, loc="left"
    )
    _camera_view(axes[1, 1], loaded)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=110, facecolor="white", metadata={"Software": None})
    return stream.getvalue()


def _view(axes: Axes, loaded: LoadedTool, plane: tuple[int, int]) -> None:
    tool, i, j = loaded.tool, *plane
    towards = 3 - i - j
    drawn = [(_shape_points(s), COLOURS[s.colour]) for s in tool.drawn()]
    if tool.ring is not None:
        ring = flange_mesh(tool.ring, thickness_m=tool.ring_height_m).transformed(tool.X_FR)
        drawn.append((np.asarray(ring.vertices), COLOURS["steel"]))
    for points, colour in sorted(drawn, key=lambda d: -float(np.mean(d[0][:, towards]))):
        _hull(axes, points[:, (i, j)], facecolor=colour, edgecolor=AXIS, linewidth=0.6, alpha=0.85)
    axes.add_patch(Circle((0.0, 0.0), 2.0, color=AXIS, zorder=6))
    axes.annotate("flange", (0.0, 0.0), xytext=(4, 4), textcoords="offset points", fontsize=8, zorder=7)
    for capsule in tool.capsules():
        _capsule(axes, capsule, plane)
    tip, tag, camera, torch = (
        1e3 * np.asarray(p)
        for p in (tool.X_FT.translation(), tool.X_FM_rest.translation(), tool.X_FK.translation(), loaded.p_FW)
    )
    axes.plot(*np.array([tag, tip])[:, (i, j)].T, color=COLOURS["soft"], linewidth=2.0, zorder=5)
    axes.add_patch(Circle((tip[i], tip[j]), 1e3 * tool.tip_radius_m, color=COLOURS["soft"], zorder=6))
    axes.plot(tag[i], tag[j], "s", color=COLOURS["soft"], markersize=5, zorder=6)
    axes.plot(camera[i], camera[j], "D", color="#2f7d4f", markersize=5, zorder=6)
    axes.plot(*np.array([camera, tag])[:, (i, j)].T, ":", color="#2f7d4f", linewidth=1.2, zorder=5)
    wire = np.array([torch - 25.0 * loaded.torch_axis, torch])
    axes.plot(*wire[:, (i, j)].T, color=COLOURS["copper"], linewidth=2.5, zorder=5)
    axes.plot(torch[i], torch[j], "o", color=KEEP, markersize=5, zorder=6)
    middle = 1e3 * np.array(tool.centre_of_mass_m)
    axes.plot(middle[i], middle[j], "P", color="black", markersize=7, zorder=6)
    places = [(tip, "tip"), (tag, "tag"), (camera, "camera"), (torch, "wire point"), (middle, "weight")]
    if tool.ring is not None:
        ring_at, face = 1e3 * tool.X_FR.translation(), tool.X_FR.rotation().matrix()[:, 2]
        places.append((ring_at, "ring"))
        if np.hypot(face[i], face[j]) > 0.3:
            axes.annotate(
                "",
                ring_at[[i, j]] + 35.0 * face[[i, j]],
                xytext=ring_at[[i, j]],
                arrowprops={"arrowstyle": "->"},
                zorder=6,
            )
    named: list[Array] = []
    for place, name in places:
        if any(np.hypot(*(place - other)[[i, j]]) < NAMES_APART_MM for other in named):
            continue  # one behind the other
        named.append(place)
        axes.annotate(name, (place[i], place[j]), xytext=(6, -9), textcoords="offset points", fontsize=8, zorder=7)
    axes.margins(0.08)


def _shape_points(shape: ToolShape) -> Array:
    """Points (N, 3) whose hull is the shape's, in F, m."""
    size = shape.size
    if shape.kind == "mesh":
        body: TriMesh = shape_mesh(shape)
    elif shape.kind == "box":
        signs = np.array(np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [-0.5, 0.5])).reshape(3, 8).T
        return np.asarray((shape.place.pose @ (signs * np.array(size)).T).T)
    else:
        radius, half = size[0], 0.5 * size[1] if len(size) > 1 else 0.0
        if shape.kind == "cylinder":
            profile = np.array([(0.0, -half), (radius, -half), (radius, half), (0.0, half)])
        else:
            angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 17)
            profile = np.column_stack(
                [radius * np.cos(angle), radius * np.sin(angle) + np.where(angle > 0.0, half, -half)]
            )
            profile[[0, -1], 0] = 0.0
        body = revolve(profile, _SEGMENTS)
    return np.asarray(body.transformed(shape.place.pose).vertices)


def _hull(axes: Axes, points_m: Array, **style: object) -> None:
    try:
        hull = ConvexHull(points_m)
    except QhullError:
        return
    axes.add_patch(Polygon(1e3 * points_m[hull.vertices], closed=True, **style))
    axes.update_datalim(1e3 * points_m)


def _capsule(axes: Axes, capsule: Capsule, plane: tuple[int, int]) -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 48)
    circle = capsule.radius * np.column_stack([np.cos(angle), np.sin(angle)])
    ends = np.vstack([circle + end[list(plane)] for end in (capsule.p_start, capsule.p_end)])
    _hull(axes, ends, fill=False, edgecolor=KEEP, linewidth=0.9, linestyle="--", zorder=4)


def _camera_view(axes: Axes, loaded: LoadedTool) -> None:
    tool, camera = loaded.tool, loaded.camera
    axes.imshow(TagView(tool, camera).picture(tool.X_FM_rest), cmap="gray", vmin=0, vmax=255)
    # how far the tag moves in the picture for a deflection as in a weld
    X_KT = tool.X_FK.InvertAndCompose(tool.X_FT)
    start = camera.camera_matrix @ tool.X_KM_rest.translation()
    moved = tool.X_KM_rest.translation() + X_KT.rotation().matrix() @ np.array([0.0, 0.003, 0.0])
    end = camera.camera_matrix @ moved
    line = np.array([start[:2] / start[2], end[:2] / end[2]])
    axes.plot(*line.T, color="#ffd24d", linewidth=2.5, label="tip 3 mm to the left of the torch's way")
    axes.legend(fontsize=8, loc="lower right")
    axes.set_title(f"what the finger camera sees: tag {tool.tag_id} of {tool.tag_dictionary}", fontsize=10, loc="left")
    axes.set_xlabel("px")


@dataclass(frozen=True, eq=False)
class TcpReport:
    """A TCP from touches, with the turn (3,) rad that it keeps, and the folder of the result."""

    found: TouchedTcp
    touches: tuple[WireTouch, ...]
    read_as: str
    turn: list[float]
    limit_mm: float | None
    folder: Path

    @property
    def set_tcp(self) -> str:
        """The line of a UR program that sets it."""
        return "set_tcp(p[{}])".format(", ".join(f"{v:.6f}" for v in (*self.found.wire.p_FW, *self.turn)))

    @property
    def worst(self) -> int:
        """Number of the touch with the largest residual."""
        return int(np.argmax(self.found.residual_m))

    @property
    def first(self) -> FirstScreen:
        """The first screen; the error is the larger of the region's radius and that of left-out touches."""
        f, what = self.found, "error of the TCP, 95 %"
        used = np.array([t.id not in f.wire.left_out for t in self.touches])
        held = 1e3 * f.held_out_m[np.isfinite(f.held_out_m) & used]
        p95 = float(np.percentile(held, 95)) if len(held) else float("nan")
        expected, larger = expected_error(what, 1e3 * radius_95(f.wire.covariance), p95, len(held), "touches")
        out = ", ".join(f.wire.left_out)
        tolerance = limit_tolerance(what, larger, self.limit_mm)
        concerns = [f"Touch {out} contradicts the others and was left out: repeat it."] if out else []
        if (most := float(np.max(f.residual_m[used], initial=0.0))) > _SLOPPY_M:
            concerns.append(
                f"Touch {self.touches[self.worst].id} is {1e3 * most:.1f} mm from the point of the others: repeat the"
                " touches, or check the unit and the form of the poses."
            )
        pose = ShownPose("X_FT", "pose of the TCP in the robot's flange F", self.X_FT)
        after = Next(f"Set it at the robot: {self.set_tcp}. Touch the point again in a new orientation.", uses=True)
        findings = Findings(tolerance=tolerance, unseen=len(held), concerns=concerns)
        return FirstScreen(findings, expected, after, (pose,))

    @property
    def X_FT(self) -> RigidTransform:
        """The TCP as a pose."""
        return RigidTransform(RotationMatrix(exp_rotation(np.array(self.turn))), self.found.wire.p_FW)

    def summary(self) -> dict[str, Any]:
        """Return the JSON object."""
        f = self.found
        return {
            "state": "done",
            "X_FT": self.X_FT,
            "tcp_mm": (1e3 * f.wire.p_FW).tolist(),
            "covariance_mm2": (1e6 * f.wire.covariance).tolist(),
            "error_95_mm": 1e3 * radius_95(f.wire.covariance),
            "rms_mm": 1e3 * f.wire.rms_m,
            "touches": [t.id for t in self.touches],
            "residual_mm": [1e3 * float(v) for v in f.residual_m],
            "held_out_mm": [None if np.isnan(v) else 1e3 * float(v) for v in f.held_out_m],
            "worst_touch": self.touches[self.worst].id,
            "left_out": list(f.wire.left_out),
            "growth": f.growth,
            "read_as": self.read_as,
            "set_tcp": self.set_tcp,
            "folder": str(self.folder),
        }

    def rows(self) -> dict[str, str]:
        """What was found, in lines."""
        f = self.found
        sigma = 1e3 * np.sqrt(np.diag(f.wire.covariance))
        return {
            "TCP": "({:.2f}, {:.2f}, {:.2f}) mm".format(*(1e3 * f.wire.p_FW).tolist()),
            "one sigma": "({:.2f}, {:.2f}, {:.2f}) mm".format(*sigma),
            "touches off the point": ", ".join(
                f"{t.id}: {1e3 * v:.2f}" for t, v in zip(self.touches, f.residual_m, strict=True)
            )
            + " mm",
            "worst touch": f"{self.touches[self.worst].id}, {1e3 * f.residual_m[self.worst]:.2f} mm",
            "poses read as": self.read_as,
            "UR": self.set_tcp,
        }
