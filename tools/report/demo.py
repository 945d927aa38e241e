"""The result of a weld job, the JSON object of `demo` and `weld`, and its report."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from weldcal.calibration.data.results import RESULT_FILE, correction_hint, export_ros2, statistics
from weldcal.models.workpieces.part import Part
from weldcal.systems.drivers.simulated.rendered_scanner import RenderedScanner
from weldcal.systems.jobs.weld.iterative_calibrator import next_scan
from weldcal.systems.jobs.weld.job import WeldJob
from weldcal.systems.jobs.weld.seam_planning import UNFELT
from weldcal.systems.jobs.weld.settings import work_point
from weldcal.systems.messages import CalibrationStatus
from weldcal.systems.phase_words import phase_words
from weldcal.systems.runner import Run
from weldcal.tools.report import plots_weld
from weldcal.tools.report.first_screen import (
    SCANNER,
    ExpectedError,
    Findings,
    FirstScreen,
    Next,
    ShownPose,
    Tolerance,
    after_hold,
    refused_note,
    typed,
    upper,
    verify_next,
    work_point_error,
    work_point_expected,
)
from weldcal.tools.report.monitor import drift_document
from weldcal.tools.report.pictures import OURS, ROBOT, TRUTH, millimetres, plain, subplots, svg
from weldcal.tools.report.render import fixed, render, sigma_rows
from weldcal.tools.report.run import RunOptions, robot_timing, run_document
from weldcal.tools.report.weld import (
    CalibrationError,
    WeldOutcome,
    felt_seams,
    fit_up_document,
    ordered_weave,
    pass_documents,
)
from weldcal.tools.report.weld_record import PartRecord
from weldcal.welding.record.process import PathError
from weldcal.welding.record.weld_log import heat_summary

ARM_NOTE_M = 1e-4  # the torch's mean error that welds are to keep


@dataclass(frozen=True, kw_only=True, eq=False)
class DemoResult:
    """The result of a run; errors against the ground truth exist in simulation only."""

    options: RunOptions
    run: Run[WeldJob]
    status: CalibrationStatus
    calibration: CalibrationError | None
    weld: WeldOutcome | None
    record: PartRecord | None = None
    broken: bool = False  # a seam, or the seams after it, are not welded yet
    by_hand: str = ""  # why a broken weld could not go on
    robot: str = "simulated"

    @property
    def folder(self) -> Path:
        """The result folder."""
        return self.options.out

    @property
    def state(self) -> str:
        """`done`, or `held` with a reason."""
        return "held" if self.run.held else "done"

    @property
    def setting(self) -> str:
        """What was real, for an operator."""
        scenario = self.run.cell.scenario
        if self.robot == "simulated":
            return "Simulation"
        rendered = scenario.scanner.SIMULATED or scenario.finger_camera.SIMULATED
        return f"{'Rendered sensors; robot' if rendered else 'Robot'}: {self.robot}"

    @property
    def n_scans(self) -> int:
        """Number of scans of the feature, verification included."""
        return self.status.sequence

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the job warned of and did not hold for, and what is outside the order's limits."""
        sequencer = self.run.cell.job.sequencer
        warned = sequencer.state_in(sequencer.GetMyContextFromRoot(self.run.root)).warnings
        return warned if self.record is None else (*self.record.broke_off, *warned, *self.record.outside)

    @property
    def first(self) -> FirstScreen:
        """The first screen: of the calibration, by the job's required error; of a weld alone, whether it was welded."""
        scenario, status = self.run.cell.scenario, self.status
        estimate, c = status.estimate, self.run.cell.scenario.calibration
        against = [self.run.reason or "The job was held."] if self.state == "held" else []
        more = self._welded()
        if estimate is None:
            found = Findings(
                against=against,
                no_tolerance=(
                    "No scenario key states how far the torch may be off the true seam: compare the error below with"
                    " what your joint allows."
                ),
                concerns=self.warnings,
                notes=self.arm_note,
            )
            scanner = scenario.scanner
            if scenario.job.calibrate:
                more["pose"] = "none was found"
            elif (
                isinstance(scanner, RenderedScanner)
                and not scanner.mounting_translation_mm + scanner.mounting_rotation_deg
            ):
                more["pose"] = "the simulated scanner is exactly at its nominal pose"
            none = ExpectedError("error at the work point, 95 %", "not known", "there is no calibration")
            return FirstScreen(
                found, none if scenario.job.calibrate else self._torch(), self._next(), (), more, self._lead()
            )
        work = work_point_error(estimate, work_point(scenario))
        expected, _ = work_point_expected(work)
        for v in status.verifications:
            limit = f"limit {c.verification_limit_mm:g} mm, calibration.verification_limit_mm"
            backing = f"{expected.backing}; at '{v.label}', held out by the job: {1e3 * v.error_m:.3f} mm ({limit})"
            expected = ExpectedError(expected.what, expected.figure, backing)
        tolerance = Tolerance(
            "the expected error at the work point, one sigma,",
            1e3 * status.predicted_error_m,
            c.required_error_mm,
            "calibration.required_error_mm",
        )
        # what is not observable and matters to X_BC is among the warnings
        concerns = (*self.warnings, *estimate.warnings)
        notes = [*refused_note(status.refused, self.n_scans), *self.arm_note]
        if estimate.correction is not None:
            notes.insert(0, correction_hint("X_BC", self.folder / RESULT_FILE))
        found = Findings(against=against, tolerance=tolerance, unseen=work.unseen_poses, concerns=concerns, notes=notes)
        pose = ShownPose("X_BC", SCANNER["X_BC"], estimate.X_BC)
        return FirstScreen(found, expected, self._next(), (pose,), more, self._lead())

    @property
    def arm_note(self) -> tuple[str, ...]:
        """What errors of the arm may do between tip and torch, where that matters; or that the seam was not felt."""
        plan = self.run.cell.job.planned_seam(self.run.root)
        if self.weld is not None and not plan.felt:
            return (f"The seam was {UNFELT}. The plan's sigma across it is {1e3 * plan.sigma_m:.2f} mm.",)
        if self.weld is None or not plan.arm_sigma_m > ARM_NOTE_M:
            return ()
        refinement = self.status.refinement
        refined = refinement is not None and refinement.arm is not None
        arm = "What the refinement leaves of the arm's errors" if refined else "Errors of an arm as its maker leaves it"
        advice = "" if refined else " Calibrate with calibration.refine: links."
        turn_deg = f"{np.degrees(plan.arm_turn_rad):.0f}"
        turns = f"Along this seam the tool turns by up to {turn_deg} deg between the tip and the torch at one place. "
        put = f"{arm} put the torch {1e3 * plan.arm_sigma_m:.2f} mm (rms) off the seam that the tip felt.{advice}"
        return (turns * (turn_deg != "0") + put,)

    def _lead(self) -> str:
        if self.record is None or not self.record.seams or self.state != "done":
            return ""
        off = len(self.record.broke_off)
        over = f", in spite of {off} interruption{'' if off == 1 else 's'}" if off else ""
        return f"{self.record.welded_mm:.0f} mm of seam are welded{over}."

    def _welded(self) -> dict[str, str]:
        """The torch's error where a simulation knows it, as a row."""
        if self.weld is None or self.weld.error is None:
            return {}
        torch = self._torch()
        brief = torch.backing.partition(", in the first")[0]
        return {"torch": f"{torch.figure} ({brief})"} if self.status.estimate is not None else {}

    def _torch(self) -> ExpectedError:
        """The torch's distance from the true seam."""
        if self.weld is None or self.weld.error is None:
            return ExpectedError("torch off the seam", "not known", "the true seam is known in simulation only")
        distance = 1e3 * self.weld.error.distance_m
        ends = 1e3 * np.max([error.ends_m()[:2] for error in self.weld.seams], axis=0)
        backing = (
            f"95 % of the weld; mean {distance.mean():.3f}, at most {distance.max():.3f} mm, "
            f"in the first 5 mm {ends[0]:.3f}, in the last 5 mm {ends[1]:.3f} mm; known in simulation only"
        )
        return ExpectedError("torch off the seam", f"{np.percentile(distance, 95):.3f} mm", backing)

    def _next(self) -> Next:
        folder, robot = self.folder, self.robot != "simulated"
        if self.state == "held":
            if self.broken and self.by_hand:
                return Next(self.by_hand, typed("view", folder))
            if self.broken:
                return Next(
                    "Remove the cause that is named above, and move the arm home. Then go on from the crater.",
                    typed("weld --resume", folder),
                )
            if self.weld is None and not self.n_scans:
                return after_hold(self.run.ended_by_operator)
            return after_hold(
                self.run.ended_by_operator,
                "Look for the cause in scans and weld, remove it, then run the job again.",
                typed("doctor", folder),
            )
        if self.weld is not None and robot:
            return Next("Look at the weld and at its log, weld.csv.", typed("view", folder))
        if self.weld is not None:
            part = self.run.cell.scenario.workpiece
            own = part is not None and part.file is not None
            return Next(f"See it again{'' if own else '; then try your own part'}.", typed("view", folder))
        return verify_next(folder)

    def summary(self) -> dict[str, object]:
        """The JSON object of `demo` and `weld`."""
        found = run_document(self.run, self.options, self.robot)
        if self.warnings:
            found["warnings"] = list(self.warnings)
        if (watched := self.run.cell.job.drift(self.run.root)) is not None:
            found["drift_frames"] = watched.frames
            found["drift"] = [drift_document(e) for e in watched.events]
        if self.calibration is not None:
            found["X_BC_error_mm"] = 1e3 * self.calibration.translation_m
            found["X_BC_error_deg"] = float(np.degrees(self.calibration.rotation_rad))
            found["X_BC_error_at_work_mm"] = 1e3 * self.calibration.at_work_m
        if self.status.estimate is not None:
            found["X_BC"] = self.status.estimate.X_BC.GetAsMatrix4().tolist()
            found["work_point"] = work_point_error(self.status.estimate, work_point(self.run.cell.scenario)).document()
            found["expected_error_mm"] = 1e3 * self.status.predicted_error_m
            found["held_out_mm"] = live_errors(1e3 * self.status.estimate.held_out.position_m)
            if self.status.refinement is not None:
                refinement = self.status.refinement
                found["refinement"] = refinement.document or {
                    "kind": refinement.kind,
                    "accepted": False,
                    "sentence": refinement.sentence,
                }
            found["verification_mm"] = [1e3 * v.error_m for v in self.status.verifications]
        found["n_scans"] = self.n_scans
        found["refused"] = [{"id": id, "reason": reason} for id, reason in self.status.refused]
        if self.weld is not None and self.weld.error is not None:
            seams = [seam_document(error) for error in self.weld.seams]
            found["torch_mean_mm"] = 1e3 * float(self.weld.error.distance_m.mean())
            for key in seams[0]:
                if "max" in key:  # a short seam has no middle
                    found[key] = max((seam[key] for seam in seams if not math.isnan(seam[key])), default=math.nan)
            if passes := self.run.cell.scenario.welding.later_passes():
                found["passes"] = pass_documents(self.weld, passes, seams)
            elif len(seams) > 1:
                found["seams"] = seams
            found["torch_lateral_mean_mm"] = 1e3 * self.weld.error.mean_m
            found["torch_lateral_max_mm"] = 1e3 * self.weld.error.max_m
        if self.record is not None:
            heat = heat_summary(self.record.log)
            found |= self.record.summary() | {"heat_input_kJ_mm": None if heat is None else heat[0]}
        if self.record is not None and (order := self.run.cell.job.servo_config.weave).amplitude_m:
            found["weave"] = {"ordered": ordered_weave(order), "measured": self._weaves()}
        if self.weld is not None:
            if self.weld.plan_error is not None:
                found["plan_mean_mm"] = 1e3 * self.weld.plan_error.mean_m
                found["plan_max_mm"] = 1e3 * self.weld.plan_error.max_m
            plan = self.run.cell.job.planned_seam(self.run.root)
            if np.isfinite(plan.sigma_m):
                found["plan_sigma_mm"], found["plan_confidence"] = 1e3 * plan.sigma_m, plan.confidence
            found["plan_words"] = plan.summary
            travel = self.run.cell.job.travel
            if len(travel.order) > 1:
                found["seam_order"] = [k + 1 for k in travel.order]
                found["seam_travel_mm"], found["listed_travel_mm"] = 1e3 * travel.travel_m, 1e3 * travel.listed_m
            found["felt"] = felt_seams(self.run)
            if np.isfinite(plan.arm_sigma_m):
                found["plan_arm_sigma_mm"] = 1e3 * plan.arm_sigma_m
                found["plan_arm_turn_deg"] = float(np.degrees(plan.arm_turn_rad))
            found["peak_omega"] = float(np.nanmax(np.abs(self.weld.log.telemetry["omega"])))
        if records := self.run.cell.job.planned_seam(self.run.root).records:
            found["fit_up"] = [fit_up_document(r.fit_up) for r in records]
            found["left_out_mm"] = [
                [1e3 * a, 1e3 * b] for r in {r.seam: r for r in records}.values() for a, b in r.left_out
            ]
        found |= self.run.timing()
        return found

    def _weaves(self) -> list[dict[str, float | None]]:
        """The measured weave of each seam and pass; where a simulation knows it, how far its mean path is off."""
        errors = {} if self.weld is None else dict(zip(self.weld.plans, self.weld.seams, strict=True))
        found: list[dict[str, float | None]] = []
        for seam in () if self.record is None else self.record.seams:
            off = errors.get((seam.seam - 1, seam.weld_pass - 1))
            mean_mm = None if off is None else 1e3 * math.hypot(off.lateral.mean(), off.height.mean())
            if seam.weave is not None:
                found.append({"seam": seam.seam, "pass": seam.weld_pass, **seam.weave, "mean_path_mm": mean_mm})
        return found

    def calibration_summary(self) -> dict[str, object]:
        """The JSON object of a live `calibrate`: the keys of the offline command and those of the run."""
        found, estimate = self.summary(), self.status.estimate
        found["seconds"] = self.run.wall_seconds
        if estimate is not None:
            ids = [o.id for o in self.status.observations]
            found |= {
                "n_used": int(estimate.inliers.sum()),
                "covariance": estimate.covariance.tolist(),
                "scanner_correction": None if estimate.correction is None else estimate.correction.document(),
                "tilt_deg": live_errors(np.degrees(estimate.held_out.tilt_rad)),
                "outliers": [id for id, used in zip(ids, estimate.inliers, strict=True) if not used],
                "warnings": [*self.warnings, *estimate.warnings],
                "unobservable": list(estimate.unobservable),
            }
        advice = next_scan(self.status, self.run.cell.job.poses, work_point(self.run.cell.scenario))
        found["next_pose"] = None if advice is None else advice.sentence()
        return found


def seam_document(error: PathError) -> dict[str, float]:
    """The torch's error on one seam, mm."""
    distance, ends = 1e3 * error.distance_m, 1e3 * np.array(error.ends_m())
    found = {"torch_mean_mm": float(distance.mean()), "torch_max_mm": float(distance.max())}
    return found | dict(
        zip(("torch_first_max_mm", "torch_last_max_mm", "torch_middle_max_mm"), ends.tolist(), strict=True)
    )


def live_errors(values: np.ndarray) -> dict[str, float]:
    """Median, mean and 95th percentile of the finite values, in their unit; empty where there are none."""
    found = statistics(values)
    return {name: found[name] for name in ("median", "mean", "p95") if np.isfinite(found[name])}


def demo_pictures(result: DemoResult) -> dict[str, bytes]:
    """The plots of a run by name, as SVG."""
    cell, status, weld = result.run.cell, result.status, result.weld
    pictures = {}
    if status.history:
        required = cell.scenario.calibration.required_error_mm * 1e-3
        pictures["convergence"] = convergence(status, required)
    if weld is not None:
        plan, part = cell.job.planned_seam(result.run.root), cell.station.cad
        if isinstance(part, Part) and plan.X_BP is not None and plan.points_B is not None:
            pictures["part"] = plots_weld.part_in_scan(plan.points_B, part.mesh, plan.X_BP)
        for name, trace in plots_weld.weld_traces(weld, cell, result.run.root).items():
            pictures[f"seam_{name}"] = plots_weld.paths(trace)
            pictures[f"along_{name}"] = plots_weld.along_the_weld(trace)
    return pictures


def demo_report(result: DemoResult, pictures: dict[str, bytes], *, recording: bool) -> str:
    """The whole report as one self-contained HTML text."""
    cell, status, weld = result.run.cell, result.status, result.weld
    estimate = status.estimate
    pose = []
    if estimate is not None:
        pose = [*sigma_rows(estimate.covariance), ("ROS 2", export_ros2(estimate.X_BC).strip())]
    return render(
        "demo.html.j2",
        result=result,
        first=result.first,
        summary=result.summary(),
        scenario=cell.scenario,
        scenario_name=Path(result.options.scenario).stem,
        status=status,
        weld=weld,
        pictures=pictures,
        welded=[name.removeprefix("seam_") for name in pictures if name.startswith("seam_")],
        planned=_planned(result),
        record=result.record,
        pose=pose,
        observations=_observations(result),
        timing=_timing(result),
        recording=recording,
        **robot_timing(result.run),
    )


def _observations(result: DemoResult) -> list[tuple[str, ...]]:
    status, estimate = result.status, result.status.estimate
    rows: list[tuple[str, ...]] = []
    for k, observation in enumerate(status.observations):
        if estimate is not None and k < len(estimate.inliers):
            rows.append(
                (
                    observation.id,
                    "used" if estimate.inliers[k] else "left out",
                    fixed(1e3 * float(estimate.held_out.position_m[k]), 3),
                    fixed(float(np.degrees(estimate.held_out.tilt_rad[k])), 4),
                )
            )
    rows += [
        (v.label, "verification, never used", fixed(1e3 * v.error_m, 3), fixed(float(np.degrees(v.tilt_rad)), 4))
        for v in status.verifications
    ]
    return rows + [(label, f"refused: {reason}", "", "") for label, reason in status.refused]


def _planned(result: DemoResult) -> list[tuple[str, str]]:
    """What the planner found in the scan, and how well it says that it knows the root."""
    plan = result.run.cell.job.planned_seam(result.run.root)
    if plan.seam is None:
        return []
    rows = [("planned", upper(plan.summary))] if plan.summary else []
    if np.isfinite(plan.sigma_m):
        rows.append(
            ("sigma of the planned root, sideways", f"{fixed(1e3 * plan.sigma_m, 3)} mm, as the planner states it")
        )
        rows.append(("confidence (0 to 1)", fixed(plan.confidence, 2)))
    if not plan.felt:
        rows.append(("seam", UNFELT))
    for record in plan.records:
        k = record.seam + 1
        rows += [
            (f"not welded, seam {k}", f"{1e3 * a:.0f} to {1e3 * b:.0f} mm: something is in the way")
            for a, b in record.left_out
        ]
        for name, row in fit_up_document(record.fit_up).items():
            what, unit = name.rsplit("_", 1)
            figures = (
                f"{row['least']:.2f} to {row['most']:.2f} {unit}, mean {row['mean']:.2f} (sigma {row['sigma']:.2f})"
            )
            rows.append((f"fit-up of seam {k}: {what}", figures))
    return rows


def _timing(result: DemoResult) -> list[tuple[str, ...]]:
    """Simulated and wall seconds per phase, phases of one name added up."""
    phases = result.run.phases
    # a run that is ended before its first phase has none
    ends = [*phases, ("", float(result.run.root.get_time()), result.run.wall_seconds)][1:]
    total: dict[str, list[float]] = {}
    for (name, t0, w0), (_, t1, w1) in zip(phases, ends, strict=True):
        spent = total.setdefault(phase_words(name), [0.0, 0.0])
        spent[0] += t1 - t0
        spent[1] += w1 - w0
    rows = [(name, fixed(s, 1), fixed(w, 1)) for name, (s, w) in total.items() if s > 0.0 or w > 0.05]
    return [*rows, ("all", fixed(float(result.run.root.get_time()), 1), fixed(result.run.wall_seconds, 1))]


def convergence(status: CalibrationStatus, required_m: float) -> bytes:
    """Draw the errors of the estimate in use against the scans taken."""
    n, expected, held_out = (np.array(c, dtype=float) for c in zip(*status.history, strict=True))
    picture, axes = subplots(7.2, 3.4)
    axes.semilogy(n, 1e3 * expected, "o-", color=OURS, label="expected at the work point (one sigma, 3-D)")
    axes.semilogy(n, 1e3 * held_out, "s--", color=ROBOT, label="held out, at the ring (median)")
    axes.axhline(1e3 * required_m, color=TRUTH, lw=1.0, label="required")
    millimetres(axes)
    axes.set_xticks(n)
    plain(axes, "scans used", "error, mm")
    picture.legend(loc="outside upper center", ncols=2, frameon=False, fontsize=8)
    return svg(picture)
