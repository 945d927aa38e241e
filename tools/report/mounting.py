"""The result of a calibration in any mounting, live or from recorded scans, and its page."""

import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    LightParameter,
    MakeRenderEngineVtk,
    RenderCameraCore,
    RenderEngineVtkParams,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.sensors import CameraInfo

from weldcal.calibration.hand_eye.exports import RESULT_FILE
from weldcal.calibration.hand_eye.mountings import Mounting
from weldcal.calibration.hand_eye.solve import pose_difference
from weldcal.calibration.planning.mounting_estimate import MountingResult
from weldcal.calibration.planning.mounting_poses import work_point
from weldcal.calibration.planning.mounting_scene import BASE, FLANGE, FOOT, MountingScene
from weldcal.calibration.recorded_carried import CarriedCalibration
from weldcal.models.arms.kinematics import LINKS
from weldcal.models.arrays import Array
from weldcal.models.scanners import ScannerPreset
from weldcal.systems.jobs.mounting.job import AddedMounting
from weldcal.systems.runner import Run
from weldcal.tools.report.first_screen import (
    ExpectedError,
    Findings,
    FirstScreen,
    Next,
    Tolerance,
    after_hold,
    expected_error,
    refused_note,
)
from weldcal.tools.report.hand_eye import (
    HandEyeReport,
    held_out_error,
    held_out_used,
    shown_poses,
    undetermined,
    unknown_tables,
)
from weldcal.tools.report.pictures import OURS, error_bars, millimetres, subplots, svg
from weldcal.tools.report.render import fixed, render
from weldcal.tools.report.run import robot_timing


@dataclass(frozen=True)
class TruthError:
    """Error of a pose against the truth: mm, deg, squared error over its covariance, and the 99.7 % bound of that."""

    mm: float
    deg: float
    nees: float
    bound: float


@dataclass(frozen=True, eq=False, kw_only=True)
class MountingReport:
    """The result of a calibration, and its folder.

    Attributes:
        scene: as known before the first scan.
        limit: the error (mm, 95 %) that is allowed, and where that is stated.
        description: one sentence on the cell, or on the dataset.
        source: name of the file that states what was done, and its text.
        run: None where the scans were recorded.
    """

    scene: MountingScene
    status: CarriedCalibration
    folder: Path
    seconds: float
    limit: tuple[float | None, str]
    description: str
    source: tuple[str, str]
    robot: str = "recorded"
    run: Run[AddedMounting] | None = None

    @property
    def result(self) -> MountingResult | None:
        """The poses with their held-out errors."""
        return self.status.result

    @property
    def truth(self) -> Mapping[str, RigidTransform]:
        """The true poses by their letters; empty where they are not known."""
        return {} if self.run is None else self.run.cell.job.truth

    @property
    def device(self) -> ScannerPreset | None:
        """The simulated scanner with its own errors; None where it is not known."""
        true = None if self.run is None else self.run.cell.station.truth.scanner
        return None if true is None else true.device

    @property
    def mounting(self) -> Mounting:
        """The configuration."""
        return self.scene.mounting

    @property
    def state(self) -> str:
        """`done`, or `held` with a reason."""
        return "done" if self.result is not None and (self.run is None or not self.run.held) else "held"

    @property
    def reason(self) -> str:
        """The reason why the job was held; empty where it is done."""
        if self.state == "done":
            return ""
        return (self.run.reason if self.run is not None else "") or self.status.message

    @property
    def first(self) -> FirstScreen:
        """The first screen: the job's own tolerance on its expected error, at the scanner's best distance."""
        status, result = self.status, self.result
        against = [self.reason] if self.state != "done" else []
        aside = [1e3 * k.error_m for k in status.held_out]
        what = f"error of a scanned point {1e3 * self.scene.scanner.optimum_m:.0f} mm in front of the scanner, 95 %"
        if result is None:
            found = Findings(against=against or ["There is no result."], unseen=0)
            none = ExpectedError(what, "not known", "there is no calibration")
            held = after_hold(self.run is not None and self.run.ended_by_operator)
            return FirstScreen(found, none, held, more={"pose": "none was found"})
        _, p95, n = held_out_error(result)
        expected, figure = expected_error(what, 1e3 * status.error_95_m, p95, n, "poses")
        if aside:
            more = f"{expected.backing}; {len(aside)} held out by the job: at most {max(aside):.3f} mm"
            expected = ExpectedError(what, expected.figure, more)
        limit, source = self.limit
        tolerance = None if limit is None else Tolerance("the expected error, 95 %,", figure, limit, source)
        open_directions = undetermined(result)
        against += open_directions
        concerns = [
            *(f"Not observable: {text}" for text in result.unobservable if not open_directions),
            *result.warnings,
        ]
        notes = [self.scanner_sentence(), *refused_note(status.refused, status.scans)]
        found = Findings(against=against, tolerance=tolerance, unseen=n, concerns=concerns, notes=notes)
        after = Next("Use the pose; calibrate again after the scanner was moved.", uses=True)
        if status.next_best is not None:
            after = Next(f"To reduce the uncertainty, add the pose {status.next_best.sentence()}")
        elif tolerance is not None and not tolerance.met:
            after = Next("Add poses that are turned more and lie farther apart, and calibrate again.")
        return FirstScreen(found, expected, after, shown_poses(result, self.mounting))

    def scanner_sentence(self) -> str:
        """What was found of the scanner, and what the scans do not determine of it."""
        assert self.result is not None
        r = self.result
        m, f = len(r.joint_covariance), r.correction
        scale, along_x, along_y = np.sqrt(np.diag(r.with_factors)[m : m + 3])
        text = (
            f"The pose goes with the scanner's correction in {RESULT_FILE}: scale {100 * (f.scale - 1.0):+.3f} % (sigma"
            f" {100 * scale:.3f}), gradient {f.gradient_per_m[0]:+.4f} and {f.gradient_per_m[1]:+.4f} per m (sigma"
            f" {along_x:.4f} and {along_y:.4f})."
        )
        if r.undetermined:
            text += f" The scans do not determine its {', '.join(r.undetermined)}: the usual size is assumed."
        return text

    def truth_errors(self) -> dict[str, TruthError]:
        """Symbol (X_FC ...) -> error against the truth."""
        out = {}
        for letter, X in self.truth.items():
            if self.result is None or letter not in self.result.poses:
                continue
            e = pose_difference(self.result.poses[letter], X)
            out[self.mounting.unknowns[letter].symbol] = TruthError(
                1e3 * float(np.linalg.norm(e[3:])),
                float(np.degrees(np.linalg.norm(e[:3]))),
                self.result.normalised_error(letter, X),
                self.result.region(0.997),
            )
        return out

    def work_error_mm(self) -> float | None:
        """True error of a scanned point at the scanner's best distance, mm."""
        truth, device = self.truth.get("X"), self.device
        if self.result is None or truth is None or device is None:
            return None
        p = work_point(self.scene)
        return 1e3 * float(np.linalg.norm(self.result.place(device.measured(p)) - truth @ p))

    def summary(self) -> dict[str, object]:
        """Return the JSON object: the keys of hand-eye and those of the run."""
        status, result = self.status, self.result
        out: dict[str, object] = {"state": self.state, "configuration": self.mounting.name, "robot": self.robot}
        if self.reason:
            out["reason"] = self.reason
        out |= {
            "n_scans": status.scans,
            "n_used": len(status.seen),
            "refused": [{"id": id, "reason": why} for id, why in status.refused],
        }
        if result is not None:
            for k, X in result.poses.items():
                u = self.mounting.unknowns[k]
                out |= {k: X, u.symbol: X, f"{k}_is": u.sentence, f"covariance_{k}": result.covariance[k]}
            out |= {
                "held_out_deg": held_out_used(result).rms_deg,
                "held_out_mm": 1e3 * held_out_used(result).rms_translation,
                "kept_aside_mm": [1e3 * k.error_m for k in status.held_out],
                "kept_aside_deg": [float(np.degrees(k.tilt_rad)) for k in status.held_out],
                "expected_error_mm": 1e3 * status.sigma_work_m,
                "error_95_mm": 1e3 * status.error_95_m,
                "scanner_correction": result.correction.document(),
                "scanner_undetermined": list(result.undetermined),
                "arm_error_mm": 1e3 * result.arm_error_m,
                "outliers": [s.label for s, used in zip(status.seen, result.inliers, strict=True) if not used],
                "work_error_mm": self.work_error_mm(),
                "truth": {s: vars(e) for s, e in self.truth_errors().items()},
                "inliers": result.inliers,
                "unobservable": list(result.unobservable),
                "warnings": list(result.warnings),
                "method": result.method,
                "next_pose": None if status.next_best is None else status.next_best.sentence(),
            }
        return out | ({} if self.run is None else self.run.timing()) | {"seconds": self.seconds}

    def given(self) -> tuple[str, ...]:
        """Return the given data: the pose of the circle, and the link that carries the scanner."""
        scene = self.scene
        out = []
        for letter in scene.known:
            u = self.mounting.unknowns[letter]
            circle = "the circle of the base mounting" if scene.configuration in FOOT else "the flange itself"
            out.append(f"{u.symbol} is known: the target M is {circle}, at the pose of the robot's drawing.")
        if "arm" in scene.configuration:
            out.append(f"The arm link L is the {LINKS[scene.link - 1].replace('_', ' ')}.")
        return tuple(out)

    def text(self) -> str:
        """Return the printed result: directions, sketch, numbers, and the errors at held-out poses."""
        status = self.status
        if self.result is None:
            return f"{self.mounting.name}: {self.state}. {self.reason}"
        lines = [
            HandEyeReport(
                result=self.result,
                mounting=self.mounting,
                comparison=(),
                next_pose=None,
                files=(),
                seconds=self.seconds,
            ).text(),
            "",
        ]
        lines.append(f"poses        {self.result.diversity.sentence()}")
        lines += [f"given        {sentence}" for sentence in self.given()]
        aside = "  ".join(f"{1e3 * k.error_m:.3f}" for k in status.held_out)
        if aside:
            lines.append(f"verified     {aside} mm at held-out poses, which the calibration did not use")
        lines.append(
            f"expected     {1e3 * status.sigma_work_m:.3f} mm (1 sigma), {1e3 * status.error_95_m:.3f} mm (95 %) of a"
            " scanned point at the scanner's best distance"
        )
        lines.append(f"scanner      {self.scanner_sentence()}")
        for symbol, e in self.truth_errors().items():
            lines.append(
                f"truth        {symbol} is off by {e.mm:.3f} mm, {e.deg:.4f} deg (simulation; squared error in units of"
                f" its covariance {e.nees:.1f}, 99.7 % of the time below {e.bound:.1f})"
            )
        lines += [f"refused      {id}: {why}" for id, why in status.refused]
        return "\n".join(lines)


def mounting_report(report: MountingReport, picture: bytes | None) -> str:
    """Return the whole report as one self-contained HTML text."""
    status, mounting, result = report.status, report.mounting, report.result
    aside = np.array([1e3 * k.error_m for k in status.held_out])
    off = {
        symbol: f" (off the truth by {fixed(e.mm, 3)} mm and {fixed(e.deg, 4)} deg; simulation)"
        for symbol, e in report.truth_errors().items()
    }
    unknowns = [] if result is None else unknown_tables(result, mounting, off)
    rows = []
    for i, s in enumerate(status.seen):
        used = result is None or bool(result.inliers[i])
        mm = "–" if result is None else fixed(1e3 * float(result.translation[i]), 3)
        deg = "–" if result is None else fixed(float(np.degrees(result.rotation_rad[i])), 4)
        rows.append((s.label, "used" if used else "left out", mm, deg, fixed(100 * s.coverage, 0)))
    rows += [
        (k.label, "held out", fixed(1e3 * k.error_m, 3), fixed(float(np.degrees(k.tilt_rad)), 4), "–")
        for k in status.held_out
    ]
    return render(
        "mounting.html.j2",
        **({} if report.run is None else robot_timing(report.run)),
        first=report.first,
        name=mounting.name,
        words=mounting.words,
        equation=mounting.equation,
        source=mounting.source,
        sketch=mounting.sketch,
        given=report.given(),
        description=report.description,
        picture=picture,
        unknowns=unknowns,
        aside_mm=float(np.median(aside)) if len(aside) else None,
        n_aside=len(aside),
        held_mm=None if result is None else 1e3 * held_out_used(result).rms_translation,
        expected_mm=1e3 * status.sigma_work_m,
        work_mm=report.work_error_mm(),
        distance_mm=1e3 * report.scene.scanner.optimum_m,
        n_used=len(status.seen),
        n_scans=status.scans,
        unobservable=() if result is None else result.unobservable,
        warnings=() if result is None else result.warnings,
        refused=status.refused,
        next_best=None if status.next_best is None else status.next_best.sentence(),
        growth=_growth(report) if len(status.history) > 1 else None,
        bars=(
            error_bars([k.label for k in status.held_out], aside, np.ones(len(aside), bool), "error, mm")
            if len(aside)
            else None
        ),
        rows=rows,
        scanner="" if result is None else report.scanner_sentence(),
        seconds=None if report.run is None else report.run.seconds,
    )


def _growth(report: MountingReport) -> bytes:
    """Expected error of a point at the work distance after every scan."""
    n, sigma = np.array(report.status.history).T
    required = report.limit[0]
    figure, axes = subplots(8.2, 2.8)
    axes.plot(n, 1e3 * sigma, "o-", color=OURS, markersize=5)
    if required is not None:
        axes.axhline(required, color="#a8402f", linewidth=1, linestyle=":")
        axes.annotate(f"required {required:.2f}", (n[0], required), fontsize=9, va="bottom", color="#a8402f")
    axes.set_yscale("log")
    millimetres(axes)
    axes.set(xticks=n, xlabel="scans", ylabel="expected error, mm")
    return svg(figure, axes)


WIDTH, HEIGHT, FOCAL = 1000, 640, 900.0
AXES_M = 0.10
COLOURS = ("#d33d2f", "#2c9a45", "#2b5fc4")
_PLATE = {"facecolor": "white", "alpha": 0.85, "edgecolor": "none", "pad": 1.5}


def station_picture(report: MountingReport) -> bytes | None:
    """PNG of the station at the last calibration pose: arms, scanner, circle, and the frames by their letters.

    Seen from the side on which the frames lie farthest apart. It shows what truly is: None where nothing is simulated.
    """
    run = report.run
    if run is None or (world := run.cell.station.world) is None:
        return None
    pose = report.status.seen[-1].pose if report.status.seen else run.cell.job.plan[0]
    frames = true_frames(report, pose.q, pose.q_2)
    root = run.root.Clone()
    plant_context = world.plant.GetMyMutableContextFromRoot(root)
    world.plant.SetPositions(plant_context, world.arm, pose.q)
    if world.second is not None and pose.q_2 is not None:
        world.plant.SetPositions(plant_context, world.second, pose.q_2)
    light = LightParameter(type="directional", direction=(0.3, -0.2, 1.0), frame="camera", intensity=1.1)
    params = RenderEngineVtkParams(default_clear_color=np.array([0.94, 0.95, 0.97]), lights=[light])
    scene_graph, name = world.scene_graph, "picture"
    scene_graph.AddRenderer(scene_graph.GetMyMutableContextFromRoot(root), name, MakeRenderEngineVtk(params))
    X_WV = _best_view(frames)
    core = RenderCameraCore(
        name,
        CameraInfo(WIDTH, HEIGHT, FOCAL, FOCAL, 0.5 * WIDTH, 0.5 * HEIGHT),
        ClippingRange(0.05, 20.0),
        RigidTransform(),
    )
    query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(root))
    image = query.RenderColorImage(ColorRenderCamera(core, False), scene_graph.world_frame_id(), X_WV)
    return _annotated(np.array(image.data[:, :, :3]), frames, X_WV)


def true_frames(report: MountingReport, q: Array, q_2: Array | None) -> dict[str, RigidTransform]:
    """Letter -> pose in the base B of every frame in the mounting's sketch, as it truly is."""
    scene = report.scene.believing(dict(report.truth))
    links = scene.frames(q)
    found = {"B": RigidTransform(), "F": links[FLANGE], "C": links[scene.link] @ scene.X_LC}
    if scene.link not in (BASE, FLANGE):
        found["L"] = links[scene.link]
    if scene.two and scene.X_BD is not None and q_2 is not None:
        found |= {"D": scene.X_BD, "E": scene.frames_2(q_2)[FLANGE]}
    found["M"] = scene.circle(links, q_2)
    return found


def _best_view(frames: dict[str, RigidTransform]) -> RigidTransform:
    """Return a view from above of all frames, in which the nearest two of them are farthest apart."""
    points = np.array([X.translation() for X in frames.values()])
    distinct = points[[all(np.linalg.norm(p - o) > 0.03 for o in points[:i]) for i, p in enumerate(points)]]
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0)) + np.array([0.0, 0.0, 0.05])
    distance = 0.9 + 1.9 * float(np.linalg.norm(points - middle, axis=1).max())
    best, widest = RigidTransform(), -1.0
    for azimuth in np.radians(np.arange(0.0, 360.0, 15.0)):
        away = np.array([np.cos(azimuth) * 0.88, np.sin(azimuth) * 0.88, 0.47])
        z = -away / np.linalg.norm(away)
        x = np.cross(z, [0.0, 0.0, 1.0])
        x /= np.linalg.norm(x)
        X_WV = RigidTransform(RotationMatrix(np.column_stack([x, np.cross(z, x), z])), middle - distance * z)
        seen = _project(points, X_WV)
        # centre the picture on the frames, and leave room for an arm's elbow above them
        shift = 0.5 * (seen.min(axis=0) + seen.max(axis=0)) - [0.5 * WIDTH, 0.5 * HEIGHT + 0.06 * HEIGHT]
        X_WV = X_WV @ RigidTransform([*(shift * distance / FOCAL), 0.0])
        uv = _project(distinct, X_WV)
        gaps = np.linalg.norm(uv[:, None] - uv[None], axis=2) + 1e9 * np.eye(len(uv))
        if float(gaps.min()) > widest:
            best, widest = X_WV, float(gaps.min())
    return best


def _project(points: Array, X_WV: RigidTransform) -> Array:
    p = np.asarray(X_WV.inverse() @ np.atleast_2d(points).T).reshape(3, -1).T
    return np.asarray(FOCAL * p[:, :2] / p[:, 2:] + [0.5 * WIDTH, 0.5 * HEIGHT])


def _annotated(image: NDArray[np.uint8], frames: dict[str, RigidTransform], X_WV: RigidTransform) -> bytes:
    figure = Figure(figsize=(WIDTH / 100.0, HEIGHT / 100.0), dpi=120)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.imshow(image)
    axes.set_axis_off()
    sight = _project(np.array([frames["C"].translation(), frames["M"].translation()]), X_WV)
    axes.plot(*sight.T, linestyle="--", color="#333", linewidth=1.2)
    placed: list[Array] = []
    for letter, X in frames.items():
        _draw_frame(axes, letter, X, X_WV, placed)
    axes.set(xlim=(0, WIDTH), ylim=(HEIGHT, 0))
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()


def _draw_frame(axes: Axes, letter: str, X: RigidTransform, X_WV: RigidTransform, placed: list[Array]) -> None:
    tips = X.translation() + AXES_M * X.rotation().matrix().T
    uv = _project(np.vstack([X.translation(), tips]), X_WV)
    for tip, colour in zip(uv[1:], COLOURS, strict=True):
        axes.plot(*np.array([uv[0], tip]).T, color=colour, linewidth=2.2, solid_capstyle="round")
    at = uv[0] + np.array([14.0, -16.0])
    while any(np.linalg.norm(at - other) < 24.0 for other in placed):
        at = at + np.array([26.0, 0.0])
    placed.append(at)
    axes.annotate(letter, at, fontsize=12, fontweight="bold", ha="center", va="center", bbox=_PLATE)
