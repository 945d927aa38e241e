"""weldcal tablet calibrate: camera and pen from the touches of one visit or of many."""

import time
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from weldcal.calibration.tablet.detection import Look
from weldcal.calibration.tablet.planar_files import hand_step_m, load_planar
from weldcal.calibration.tablet.published import AFFINE_NAMES, HTM_NAMES, Sign, tablet_stage1, tablet_stage2
from weldcal.calibration.tablet.result import TabletResult, load_tablet_result, save_tablet_result
from weldcal.calibration.tablet.touches import TabletTouches
from weldcal.calibration.tablet.wrist.diagnostics import check_wrist, wrist_diagnostics
from weldcal.calibration.tablet.wrist.files import file_hash, load_visit
from weldcal.calibration.tablet.wrist.fit import WristFit, fit_wrist
from weldcal.calibration.tablet.wrist.known_camera import KnownCamera, fit_pen, moved_camera
from weldcal.models.errors import InputError
from weldcal.tools.cli.options import Call, LimitOption, Outcome, command, option, switch
from weldcal.tools.commands.tablet.planar import NAMES, ManyVisits, best_model, error_figures, fit_many, fit_visit
from weldcal.tools.report.first_screen import NO_TOLERANCE, FirstScreen, check_limit
from weldcal.tools.report.render import write_atomic
from weldcal.tools.report.tablet import Shown, calibration_report, marked_picture, tablet_screen


@command("tablet calibrate", short_help="Calibrate a camera by touches of the tablet.")
def calibrate(
    call: Call,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The page's touches (CSV), or planar touches (npz).")],
    poses: Annotated[Path | None, option("--poses", "CSV", "Flange poses at each touch, and one row 'camera'.")] = None,
    camera: Annotated[Path | None, option("--camera", "YAML", "fx, fy, cx, cy and distortion of the camera.")] = None,
    image: Annotated[
        Path | None, option("--image", "PICTURE", "The camera's image; landmarks are detected in it.")
    ] = None,
    seen: Annotated[Path | None, option("--seen", "CSV", "Instead of --image: landmark,u,v in the image.")] = None,
    look: Annotated[str, option("--look", "LOOK", "Landmarks in the image: rings or dots.")] = "rings",
    known_camera: Annotated[
        Path | None,
        option("--known-camera", "RESULT", "A former calibration: the camera stays, and touches give another pen."),
    ] = None,
    pen_length_mm: Annotated[
        float | None, option("--pen-length-mm", "MM", "Distance of the pen tip from the flange, along its z axis.")
    ] = None,
    pen_radius_mm: Annotated[float, option("--pen-radius-mm", "MM", "Radius of the pen's round tip.", min=0.0)] = 0.0,
    hand_step_mm: Annotated[
        float | None,
        option(
            "--hand-step-mm",
            "MM",
            "npz: hand positions are rounded to this step; 0: not rounded.",
            min=0.0,
            show_default="detected",
        ),
    ] = None,
    two_stages: Annotated[bool, switch("--two-stages", "npz: also run the paper's two stages.")] = False,
    limit_mm: LimitOption = None,
) -> Outcome:
    """Calibrate camera and pen on the wrist from one image of the tablet and a touch of each landmark."""
    inputs = VisitFiles(
        file=file,
        poses=poses,
        camera=camera,
        image=image,
        seen=seen,
        look=look,
        known_camera=known_camera,
        pen_length_m=None if pen_length_mm is None else 1e-3 * pen_length_mm,
        pen_radius_m=1e-3 * pen_radius_mm,
        hand_step_m=None if hand_step_mm is None else 1e-3 * hand_step_mm,
        two_stages=two_stages,
        limit_mm=limit_mm,
    )
    made = calibrate_tablet(inputs, call.folder("tablet", file.stem))
    return Outcome(made.summary(), first=made.first)


@dataclass(frozen=True, kw_only=True)
class VisitFiles:
    """The files of one visit, and the known quantities."""

    file: Path
    poses: Path | None = None
    camera: Path | None = None
    image: Path | None = None
    seen: Path | None = None
    look: str = "rings"
    known_camera: Path | None = None
    pen_length_m: float | None = None
    pen_radius_m: float = 0.0
    hand_step_m: float | None = None  # None: detected
    two_stages: bool = False
    limit_mm: float | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class TabletCalibration:
    """The result, its report's data, and the duration.

    The fit with full poses where it is one; else the rounding step of the hand and the errors at the file's
    queries.
    """

    result: TabletResult
    shown: Shown
    wrist: WristFit | None = None
    step_m: float = 0.0
    held_out_mm: np.ndarray = field(default_factory=lambda: np.zeros(0))
    seconds: float = 0.0
    limit_mm: float | None = None
    no_tolerance: str = NO_TOLERANCE

    @property
    def first(self) -> FirstScreen:
        """The first screen."""
        return tablet_screen(self.result, self.held_out_mm, self.limit_mm, self.no_tolerance)

    def summary(self) -> dict[str, object]:
        """Return the JSON object of `tablet calibrate`."""
        result = self.result
        stages = result.two_stages or {}
        left_out = [v for v in result.leave_one_out_mm if v is not None]
        return {
            "state": "done",
            "model": result.model,
            "n_landmarks": len(self.shown.names),
            "F1": stages.get("F1"),
            "F2": stages.get("F2"),
            "parameters": result.parameters,
            "leave_one_out_mm": float(np.mean(left_out)) if left_out else None,
            "leave_one_out_of_other_models_mm": result.other_models,
            "held_out_mm": error_figures(self.held_out_mm),
            "hand_step_mm": 1e3 * self.step_m,
            "X_FC": result.X_FC,
            "p_FP_mm": None if result.p_FP_m is None else [1e3 * v for v in result.p_FP_m],
            "warnings": result.warnings,
            "unobservable": result.unobservable,
            "seconds": self.seconds,
        }

    def write(self, folder: Path) -> None:
        """Write the result folder, its report included."""
        save_tablet_result(self.result, folder)
        page = calibration_report(self.result, self.shown, self.first, self.seconds, error_figures(self.held_out_mm))
        write_atomic(folder / "report.html", page)


def calibrate_tablet(inputs: VisitFiles, folder: Path) -> TabletCalibration | ManyVisits:
    """Calibrate from the files and write the result folder; a file of many visits gives each of them, and all together.

    Raises:
        InputError and other WeldcalErrors: the files cannot be used; nothing is written.
    """
    check_limit(inputs.limit_mm)
    if not inputs.file.is_file():
        raise InputError(f"There is no file '{inputs.file}'. Give the page's CSV, or an npz of planar touches.")
    if inputs.file.suffix.lower() not in (".npz", ".csv"):
        raise InputError(
            f"'{inputs.file.name}' is neither .csv nor .npz. Give the page's CSV, or an npz of planar touches."
        )
    start = time.perf_counter()
    made = _planar(inputs) if inputs.file.suffix.lower() == ".npz" else _wrist(inputs)
    made = replace(made, seconds=time.perf_counter() - start, limit_mm=inputs.limit_mm)
    made.write(folder)
    return made


def _planar(inputs: VisitFiles) -> TabletCalibration | ManyVisits:
    extra = (inputs.poses, inputs.camera, inputs.image, inputs.seen, inputs.known_camera)
    if any(path is not None for path in extra):
        raise InputError(
            "An npz file is complete. Omit --poses, --camera, --image, --seen and --known-camera, or give the CSV."
        )
    read = load_planar(inputs.file)
    visits = read.visits
    step_m = hand_step_m(visits) if inputs.hand_step_m is None else inputs.hand_step_m
    if len(visits) + len(read.refused) > 1:
        if inputs.two_stages:
            raise InputError(
                f"'{inputs.file.name}' holds {len(visits) + len(read.refused)} visits. --two-stages needs a file with"
                " one."
            )
        return fit_many(inputs.file, read, step_m)
    found = fit_visit(visits[0], step_m)
    best, errors = best_model([found])
    fit, touches = found.fits[best], visits[0].touches
    shown = Shown(touches.landmark_m, found.in_page(fit.residuals_m), tuple(map(str, visits[0].rows)))
    result = TabletResult(
        model=best,
        parameters=dict(zip(NAMES[best], fit.parameters.tolist(), strict=True)),
        covariance=fit.covariance.tolist(),
        residual_mm=_lengths_mm(fit.residuals_m),
        leave_one_out_mm=_finite(found.left_out_mm(best).tolist()),
        two_stages=_two_stages(touches) if inputs.two_stages else None,
        other_models={name: e for name, e in errors.items() if name != best and np.isfinite(e)},
        warnings=found.warnings,
        data_sha256={inputs.file.name: file_hash(inputs.file)},
    )
    return TabletCalibration(result=result, shown=shown, step_m=step_m, held_out_mm=found.held_out_mm(best))


def _two_stages(touches: TabletTouches) -> dict[str, object]:
    """Return the paper's scheme in its search ranges (Table 5), for a setup like the paper's."""
    first = tablet_stage1(touches, sign=Sign.CORRECTED)
    second = tablet_stage2(touches, first.parameters, sign=Sign.CORRECTED)
    return {
        "F1": first.fitness.F,
        "F2": second.fitness.F,
        "stage_1": {**asdict(first.fitness), **dict(zip(HTM_NAMES, first.parameters.tolist(), strict=True))},
        "stage_2": {**asdict(second.fitness), **dict(zip(AFFINE_NAMES, second.parameters.tolist(), strict=True))},
    }


def _wrist(inputs: VisitFiles) -> TabletCalibration:
    known = None if inputs.known_camera is None else _camera_of(inputs.known_camera)
    pictured = known is None or inputs.image is not None or inputs.seen is not None
    if inputs.poses is None or (inputs.camera is None and pictured):
        need = " and the camera's intrinsics (--camera FILE)" if pictured else ""
        raise InputError(f"Touches in a CSV need the robot's poses (--poses FILE){need}.")
    if inputs.two_stages or inputs.hand_step_m:
        raise InputError("--two-stages and --hand-step-mm belong to planar touches in an npz file.")
    if inputs.look not in ("rings", "dots"):
        raise InputError(f"--look must be rings or dots, not '{inputs.look}'.")
    look: Look = "dots" if inputs.look == "dots" else "rings"
    visit = load_visit(
        inputs.file,
        inputs.poses,
        inputs.camera,
        image=inputs.image,
        seen=inputs.seen,
        look=look,
        tip_radius_m=inputs.pen_radius_m,
    )
    data = visit.data
    moved: tuple[str, ...] = ()
    if known is not None and data.views:
        free = fit_wrist(data, inputs.pen_length_m, leave_one_out=False)
        check_wrist(data, free, visit.names)
        moved = moved_camera(free, known)
        data = replace(data, views=()) if moved else data
    fit = fit_wrist(data, inputs.pen_length_m) if known is None else fit_pen(data, known, inputs.pen_length_m)
    check_wrist(data, fit, visit.names)
    files = (inputs.file, inputs.poses, inputs.camera, inputs.image, inputs.seen)
    in_page = fit.touch_residuals_m @ fit.X_BT.rotation().matrix()[:, :2]
    picture = None if visit.picture is None else marked_picture(visit.picture, visit.found_px)
    shown = Shown(visit.data.landmark_m, in_page, visit.names, picture)
    result = TabletResult(
        model="wrist" if known is None else "pen_and_picture" if data.views else "pen",
        parameters=_wrist_parameters(fit),
        covariance=fit.covariance.tolist(),
        residual_mm=_lengths_mm(fit.touch_residuals_m),
        leave_one_out_mm=_finite([1e3 * v for v in fit.leave_one_out_m.tolist()]),
        X_FC=fit.X_FC,
        X_FC_covariance=fit.covariance.tolist(),
        p_FP_m=fit.p_FP.tolist(),
        p_FP_covariance=fit.pen_covariance.tolist(),
        unobservable=fit.unobservable,
        warnings=(*visit.warnings, *moved, *wrist_diagnostics(data, fit, visit.names)),
        data_sha256={path.name: file_hash(path) for path in files if path is not None},
    )
    return TabletCalibration(result=result, shown=shown, wrist=fit)


def _camera_of(path: Path) -> KnownCamera:
    """Read a calibration by touches with full poses: its camera."""
    result = load_tablet_result(path)
    if result.X_FC is None or result.X_FC_covariance is None:
        raise InputError(
            f"'{path}' does not hold the camera's pose: it is of an npz. Give --known-camera a calibration of a CSV."
        )
    return KnownCamera(result.X_FC, np.array(result.X_FC_covariance), str(path))


def _wrist_parameters(fit: WristFit) -> dict[str, float]:
    rpy = fit.X_FC.rotation().ToRollPitchYaw().vector()
    names = ("x", "y", "z", "roll", "pitch", "yaw", "pen_x", "pen_y", "pen_z")
    values = [*fit.X_FC.translation(), *rpy, *fit.p_FP]
    return {name: float(value) for name, value in zip(names, values, strict=True)}


def _lengths_mm(errors_m: np.ndarray) -> list[float]:
    return [float(v) for v in 1e3 * np.linalg.norm(errors_m, axis=1)]


def _finite(values: list[float]) -> list[float | None]:
    """Return the values, None where a landmark could not be held out; empty where none could."""
    return [v if np.isfinite(v) else None for v in values] if np.isfinite(values).any() else []
