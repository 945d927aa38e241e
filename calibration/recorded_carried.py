"""Calibrate a scanner that an arm carries from scans of a circle: scan by scan, for recorded and live scans alike."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.data.checks import unit_quaternion
from weldcal.calibration.data.clouds import CloudError
from weldcal.calibration.data.dataset import Dataset, load_dataset
from weldcal.calibration.data.header import DatasetHeader
from weldcal.calibration.data.results import ON_BASE
from weldcal.calibration.data.writing import JOINTS, SECOND_JOINTS
from weldcal.calibration.errors import FlangeNotFound, TooFewPoses
from weldcal.calibration.eye_on_base.validation import VerificationResult
from weldcal.calibration.planning.calibration_poses import NextBest
from weldcal.calibration.planning.mounting_estimate import (
    Circle,
    MountingResult,
    ObservedCircle,
    expected_after,
    expected_error,
    fewest,
    off_prediction,
    see_circle,
    solve_mounting,
)
from weldcal.calibration.planning.mounting_poses import MountingPose
from weldcal.calibration.planning.mounting_scene import BASE, FLANGE, FOOT, MountingScene
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import LINKS, ArmModel, known_arms, load_arm
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError, WeldcalError
from weldcal.models.flanges import get_flange
from weldcal.models.robots import base_circle
from weldcal.models.scanners import get_scanner

Joints = tuple[Array, Array | None]
"""Joint angles (6,) rad of the arm, and of a second arm where there is one."""

_HOME = np.radians([0.0, -90.0, 90.0, -90.0, -90.0, 0.0])  # joints that a dataset does not state are taken near these
_FOLDS = 5  # a choice: with the ten scans of a usual calibration each fold leaves two out
_WIDER_M = 0.25  # radius of the search about a guess that may be wrong
_TRIED_AGAIN = 3  # scans
SAME = 1e-4  # m, and as a matrix: what a controller rounds
"""Difference of a stated pose from that of its joint angles that is one of digits."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CarriedCalibration:
    """The calibration after its newest scan.

    Attributes:
        seen: the scans that are used; ``refused``: id and reason of those that are not.
        sigma_work_m, error_95_m: expected error (3-D, rms) of a point at the scanner's best distance, and the bound
            that it keeps with 95 %; ``history`` of that bound, by the number of scans.
        held_out: errors in scans that were taken to verify.
        message: why the newest scan gave no result.
    """

    seen: tuple[ObservedCircle, ...] = ()
    refused: tuple[tuple[str, str], ...] = ()
    result: MountingResult | None = None
    sigma_work_m: float = np.inf
    error_95_m: float = np.inf
    history: tuple[tuple[int, float], ...] = ()
    held_out: tuple[VerificationResult, ...] = ()
    next_best: NextBest | None = None
    message: str = ""

    @property
    def scans(self) -> int:
        """Number of scans."""
        return len(self.seen) + len(self.refused) + len(self.held_out)

    def refusing(self, id: str, reason: str) -> Self:
        """Return the calibration with a scan that cannot be used."""
        return replace(self, refused=tuple({**dict(self.refused), id: reason}.items()), message=reason)

    def with_scan(
        self, scene: MountingScene, circle: Circle, id: str, points_C: Array, joints: Joints, *, held_out: bool = False
    ) -> Self:
        """Return the calibration with one more scan; without the circle in it, the scan is refused with the reason.

        The circle is sought where the calibration so far expects it. ``held_out``: the scan only verifies.
        """
        belief = scene if self.result is None else scene.believing(self.result.poses)
        try:
            seen = see_circle(points_C, belief, id, *joints, circle)
        except FlangeNotFound as error:
            return self.refusing(id, str(error))
        if held_out:
            off = off_prediction(belief, seen, None if self.result is None else self.result.correction)
            return replace(self, held_out=(*self.held_out, VerificationResult(id, *off)))
        refused = tuple(row for row in self.refused if row[0] != id)
        found = replace(self, seen=(*self.seen, seen), refused=refused, message="")
        if len(found.seen) < fewest(scene):
            return found
        try:
            result = solve_mounting(scene, found.seen)
        except WeldcalError as error:
            return replace(found, message=str(error))
        sigma, within = expected_error(scene, result)
        history = (*found.history, (len(found.seen), within))
        return replace(found, result=result, sigma_work_m=sigma, error_95_m=within, history=history)

    def cross_validated(self, scene: MountingScene, folds: int = _FOLDS) -> Self:
        """Return the calibration with the held-out errors of its scans."""
        return replace(self, result=solve_mounting(scene, self.seen, folds=folds))

    def proposing(self, scene: MountingScene, plan: Sequence[MountingPose]) -> Self:
        """Return the calibration with the unvisited pose of a plan that reduces its expected error most.

        All are reachable, visible and clear. None is proposed where all were visited.
        """
        left = [p for p in plan if all(float(np.abs(p.q - s.pose.q).max()) > 1e-2 for s in self.seen)]
        if self.result is None or not left:
            return replace(self, next_best=None)
        belief = scene.believing(self.result.poses)
        after = expected_after(belief, self.result, self.seen, left)
        best, now = left[int(np.argmin(after))], expected_error(belief, self.result)[0]
        proposed = NextBest(best.q, belief.frames(best.q)[FLANGE], now, float(after.min()), best.q_2)
        return replace(self, next_best=proposed)


@dataclass(frozen=True, eq=False, kw_only=True)
class RecordedCarried:
    """The calibration of a dataset, the scene as dataset.yaml describes it, and the digests of the files as text."""

    found: CarriedCalibration
    scene: MountingScene
    hashes: str


def calibrate_carried(
    folder: Path,
    *,
    robot: str | None = None,
    flange: str | None = None,
    poses: str | None = None,
    tell: Callable[[str, float], None] = lambda step, fraction: None,
    known: dict[tuple[str, ...], CarriedCalibration] | None = None,
) -> RecordedCarried:
    """Calibrate from scans at rest as the live job does, scan by scan.

    ``robot``, ``flange`` override dataset.yaml; ``poses``: see FlangeOptions. ``known``: the calibration by the ids of
    the scans that were looked at, which grows: a session that adds a scan looks at that one only. What it found about
    the home of fewer scans differs in the last digits.

    Raises:
        InputError: the data cannot be used; TooFewPoses: too few scans can be used.
    """
    data = load_dataset(folder, robot=robot or "", carried=True)
    data = data if poses is None else data.between(poses)
    scene, circle = recorded_scene(data, robot or data.header.robot, flange or data.header.flange)
    joints = recorded_joints(data, scene)
    found, left = CarriedCalibration(refused=data.refused), list(data.clouds)
    known, looked = {} if known is None else known, tuple[str, ...]()
    for _ in range(2):  # what is not found about the guess may be found about the result
        for k, id in enumerate(left):
            tell("finding circles", 0.8 * k / len(left))
            looked = (*looked, id)
            try:
                found = known.get(looked) or found.with_scan(scene, circle, id, data.cloud(id), joints[id])
            except CloudError as problem:
                found = found.refusing(id, str(problem))
            known[looked] = found
        left = [id for id in left if id in dict(found.refused)]
        if found.result is None:
            break
    if len(found.seen) < fewest(scene):
        raise TooFewPoses(_too_few(data, scene, joints, circle, found))
    tell("cross-validating", 0.8)
    return RecordedCarried(
        found=found.cross_validated(scene), scene=scene, hashes=json.dumps(data.hashes, sort_keys=True)
    )


def _too_few(
    data: Dataset, scene: MountingScene, joints: Mapping[str, Joints], circle: Circle, found: CarriedCalibration
) -> str:
    """Return the sentence where too few scans show the circle; a wider search says how far off the guess is."""
    n, refused = len(found.seen), found.refused
    begin = f"{n} scan{' shows' if n == 1 else 's show'} the circle, and {fewest(scene)} are needed."
    for id, _ in refused[:_TRIED_AGAIN]:
        with contextlib.suppress(FlangeNotFound, CloudError):
            wide = see_circle(data.cloud(id), scene, id, *joints[id], replace(circle, guess_radius_m=_WIDER_M))
            off, turn = off_prediction(scene, wide, None)
            return (
                f"{begin} In '{id}' a circle lies {1e3 * off:.0f} mm and {np.degrees(turn):.0f} degrees from where"
                f" dataset.yaml expects it. Correct scanner_guess or configuration, or write radius_m: {_WIDER_M} in"
                " scanner_guess."
            )
    why = "; ".join(f"{id}: {text}" for id, text in refused[:3])
    return (
        f"{begin} {f'Refused: {why}' if why else ''} Record more scans that show the whole circle, or check"
        " configuration and scanner_guess in dataset.yaml."
    )


def recorded_scene(data: Dataset, robot: str, flange: str) -> tuple[MountingScene, Circle]:
    """Return the scene and the circle that a dataset describes. Raises InputError for what dataset.yaml lacks."""
    header, guess = data.header, data.X_BC_guess
    if robot not in known_arms():
        raise InputError(
            f"The arm '{robot}' is not known. Name one of {', '.join(known_arms())} as robot in dataset.yaml, or with"
            " --robot."
        )
    if guess is None or header.scanner_guess is None:
        raise InputError(
            "dataset.yaml has no scanner_guess: measure the scanner's pose on what carries it, to 15 mm and 2 degrees,"
            " and add it."
        )
    on_arm = header.configuration.startswith("eye_on_arm")
    if on_arm and header.scanner_link not in LINKS[:-1]:
        raise InputError(
            f"dataset.yaml must name the link that carries the scanner: scanner_link, one of {', '.join(LINKS[:-1])}."
        )
    if header.scanner_link and not on_arm:
        raise InputError(
            f"dataset.yaml has scanner_link: {header.scanner_link}, but with the configuration {header.configuration}"
            " the flange carries the scanner. Remove scanner_link, or write a configuration that begins with"
            " eye_on_arm."
        )
    second = header.second_robot
    if (second is not None) != (header.configuration == "co_manipulation"):
        raise InputError("co_manipulation, and it alone, has second_robot in dataset.yaml: its robot, xyz and wxyz.")
    first = data.joints()
    q_home = np.median(list(first.values()), axis=0) if first else _HOME
    named = replace(header, robot=robot, flange=flange)
    known: dict[str, Any] = {"X_HR": data.X_FR}
    if second is not None:
        X_BD = RigidTransform(unit_quaternion(second.wxyz, "second_robot"), second.xyz)
        known |= {"X_BD": X_BD, "q_home_2": _HOME}
    return described_scene(named, load_arm(robot), guess, q_home, **known)


def described_scene(
    header: DatasetHeader, arm: ArmModel, X_LC: RigidTransform, q_home: Array, **more: Any
) -> tuple[MountingScene, Circle]:
    """Return the scene as a dataset's header describes it, and its circle.

    ``X_LC``: the scanner on its carrier; ``more``: other fields of the scene, such as those of a second arm.
    """
    foot = base_circle(header.robot) if header.configuration in FOOT else None
    standard = get_flange(header.flange) if foot is None else foot.standard
    link = 1 + LINKS.index(header.scanner_link) if header.scanner_link else FLANGE
    known = {
        "X_HR": RigidTransform(),
        "scanner": get_scanner(header.scanner or "phoxi_m"),
        "arm_error_m": 1e-3 * header.arm_error_mm,
        **more,
        **({} if foot is None else {"X_HR": foot.X_BR}),
    }
    if header.second_robot is not None:
        known["arm_2"] = load_arm(header.second_robot.robot)
    scene = MountingScene(
        configuration=header.configuration,
        arm=arm,
        link=BASE if header.configuration == ON_BASE else link,
        X_LC=X_LC,
        radius_m=0.5 * standard.outer_m,
        q_home=q_home,
        **known,
    )
    radius_m = 0.0 if header.scanner_guess is None else header.scanner_guess.radius_m
    return scene, Circle(standard, radius_m, foot is not None)


def recorded_joints(data: Dataset, scene: MountingScene) -> dict[str, Joints]:
    """Joint angles of both arms by id: they lead the arm as drawn to the stated poses.

    Raises InputError where that is not possible.
    """
    given, second, found = data.joints(), data.joints(SECOND_JOINTS) if scene.two else {}, {}
    on_arm = scene.link not in (BASE, FLANGE)
    if (on_arm and not given) or (scene.two and not second):
        names = SECOND_JOINTS if scene.two else JOINTS
        raise InputError(
            f"poses.csv needs the joint angles {names[0]} to {names[-1]} (rad): the pose of the flange alone does not"
            " say where the scanner is."
        )
    near = scene.q_home
    for id, X_BF in data.poses.items():
        q = given.get(id)
        reached = None if q is None else scene.frames(q)[FLANGE]
        if q is None or reached is None or not reached.IsNearlyEqualTo(X_BF, SAME):
            if on_arm:
                raise InputError(
                    f"The joint angles of '{id}' do not lead the {scene.arm.name} to its stated pose. Check the robot's"
                    " name, radians, and that the TCP is zero."
                )
            q = nearest_solution(scene.arm, X_BF, near if q is None else q)
        if q is None:
            raise InputError(
                f"The {scene.arm.name} does not reach the stated pose of '{id}'. Check the robot's name, the unit, and"
                " that the TCP is zero."
            )
        near = q
        found[id] = (q, second.get(id))
    return found
