"""The result of a live calibration in any mounting, with errors against the ground truth of a simulation."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from weldcal.calibration.hand_eye.mountings import Mounting
from weldcal.calibration.hand_eye.solve import HandEyeResult, pose_difference
from weldcal.calibration.planning.mounting_poses import work_point
from weldcal.systems.jobs.mounting.job import FOOT, AddedMounting
from weldcal.systems.jobs.mounting.messages import MountingStatus
from weldcal.systems.runner import Run
from weldcal.tools.outcomes.first_screen import (
    Expected,
    Findings,
    FirstScreen,
    Next,
    Tolerance,
    after_hold,
    expected_error,
    point_covariance,
    refused_note,
)
from weldcal.tools.outcomes.hand_eye import HandEyeReport, held_out_error, shown_poses
from weldcal.tools.outcomes.poses import radius_95


@dataclass(frozen=True)
class TruthError:
    """Error of an estimated pose against the ground truth: mm, deg, squared error in units of its covariance, and the bound
    that it does not exceed with a probability of 99.7 %."""

    mm: float
    deg: float
    nees: float
    bound: float


@dataclass(frozen=True, eq=False)
class MountingReport:
    """The result of a live calibration, and its folder."""

    run: Run[AddedMounting]
    result: HandEyeResult | None
    folder: Path
    seconds: float
    robot: str = "simulated"

    @property
    def job(self) -> AddedMounting:
        """The job that ran."""
        return self.run.cell.job

    @property
    def status(self) -> MountingStatus:
        """The calibration's last status in the run."""
        return self.job.status(self.run.root)

    @property
    def mounting(self) -> Mounting:
        """The configuration."""
        return self.job.scene.mounting

    @property
    def state(self) -> str:
        """`done`, or `held` with a reason."""
        return "done" if not self.run.held and self.result is not None else "held"

    @property
    def reason(self) -> str:
        """The reason why the job was held; empty where it is done."""
        if self.state == "done":
            return ""
        return self.run.reason or self.status.message

    @property
    def first(self) -> FirstScreen:
        """The first screen: the job's own tolerance on its expected error, at the scanner's best distance."""
        status, result, scenario = self.status, self.result, self.run.cell.scenario
        against = [self.reason] if self.state != "done" else []
        aside = [1e3 * k.error_m for k in status.held_out]
        what = f"error {1e3 * self.job.scene.scanner.optimum_m:.0f} mm in front of the scanner, 95 %"
        if result is None:
            found = Findings(against=against or ["There is no result."], unseen=0)
            after = after_hold(self.run.ended_by_operator)
            return FirstScreen(
                found, Expected(what, "not known", "there is no calibration"), after, more={"pose": "none was found"}
            )
        X = result.X
        p = np.asarray(X @ work_point(self.job.scene))
        own = 1e3 * radius_95(point_covariance(X, result.covariance["X"], p))
        _, p95, n = held_out_error(result)
        expected, _ = expected_error(what, own, p95, n, "poses")
        if aside:
            more = f"{expected.backing}; {len(aside)} held out by the job: at most {max(aside):.3f} mm"
            expected = Expected(what, expected.figure, more)
        tolerance = Tolerance(
            "the expected error, one sigma,", 1e3 * status.sigma_work_m, scenario.calibration.required_error_mm,
            "calibration.required_error_mm",
        )  # fmt: skip
        concerns = [*(f"Not observable: {text}" for text in result.unobservable), *result.warnings]
        notes = refused_note(status.refused, status.sequence)
        found = Findings(against=against, tolerance=tolerance, unseen=n, concerns=concerns, notes=notes)
        if status.next_best is not None:
            after = Next(f"To know it better, add the pose {status.next_best.sentence()}")
        else:
            after = Next("Use the pose; calibrate again after any knock.")
        return FirstScreen(
            found,
            expected,
            after,
            shown_poses(result, self.mounting),
        )

    def truth_errors(self) -> dict[str, TruthError]:
        """Symbol (X_FC ...) -> error against the truth."""
        out = {}
        for letter, X in self.job.truth.items():
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
        """True error of a point at the scanner's best distance, mm."""
        truth = self.job.truth.get("X")
        if self.result is None or truth is None:
            return None
        p = work_point(self.job.scene)
        return 1e3 * float(np.linalg.norm(self.result.X @ p - truth @ p))

    def summary(self) -> dict[str, object]:
        """The JSON object: the keys of hand-eye and those of the run."""
        status, result = self.status, self.result
        out: dict[str, object] = {"state": self.state, "configuration": self.mounting.name, "robot": self.robot}
        if self.reason:
            out["reason"] = self.reason
        out |= {
            "n_scans": status.sequence,
            "n_used": len(status.seen),
            "refused": [{"id": id, "reason": why} for id, why in status.refused],
        }
        if result is not None:
            for k, X in result.poses.items():
                out |= {k: X, f"{k}_is": self.mounting.unknowns[k].sentence, f"covariance_{k}": result.covariance[k]}
            out |= {
                "held_out_deg": result.held_out.rms_deg,
                "held_out_mm": 1e3 * result.held_out.rms_translation,
                "kept_aside_mm": [1e3 * k.error_m for k in status.held_out],
                "kept_aside_deg": [float(np.degrees(k.tilt_rad)) for k in status.held_out],
                "expected_error_mm": 1e3 * status.sigma_work_m,
                "work_error_mm": self.work_error_mm(),
                "truth": {s: vars(e) for s, e in self.truth_errors().items()},
                "inliers": result.inliers,
                "unobservable": list(result.unobservable),
                "warnings": list(result.warnings),
                "method": result.method,
                "next_pose": None if status.next_best is None else status.next_best.sentence(),
            }
        return out | self.run.timing() | {"seconds": self.seconds}

    def given(self) -> tuple[str, ...]:
        """The given data: the pose of the circle, and the link that carries the scanner."""
        scene, scenario = self.job.scene, self.run.cell.scenario
        out = []
        for letter in scene.known:
            u = self.mounting.unknowns[letter]
            circle = (
                "the circle of the base mounting" if scenario.calibration.configuration in FOOT else "the flange itself"
            )
            out.append(f"{u.symbol} is known: the target M is {circle}, at the pose of the robot's drawing.")
        if "arm" in scene.configuration and (scanner := scenario.scanner_config()) is not None:
            out.append(f"The arm link L is the {scanner.mounted_on.replace('_', ' ')}.")
        return tuple(out)

    def text(self) -> str:
        """The printed result: directions, sketch, numbers, and the errors at held-out poses."""
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
            f"expected     {1e3 * status.sigma_work_m:.3f} mm (1 sigma) of a point at the scanner's best distance"
        )
        for symbol, e in self.truth_errors().items():
            lines.append(
                f"truth        {symbol} is off by {e.mm:.3f} mm, {e.deg:.4f} deg (simulation; squared error in units of its "
                f"covariance {e.nees:.1f}, 99.7 % of the time below {e.bound:.1f})"
            )
        lines += [f"refused      {id}: {why}" for id, why in status.refused]
        return "\n".join(lines)
