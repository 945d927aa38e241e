"""Read where any arm is: a UR by RTDE, a file, a program, a line over TCP, a driver, or typed numbers."""

from __future__ import annotations

import json
import re
import shlex
import socket
import subprocess
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Protocol

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.capture.session import ArmPose
from weldcal.calibration.geometry.se3 import exp_rotation
from weldcal.models.errors import InputError, WeldcalError
from weldcal.models.files import read_text
from weldcal.systems.drivers.discovery import plugins
from weldcal.systems.drivers.ur.wire.rtde_client import RtdeProbe

KINDS = "ur:HOST, file:PATH, tcp:PORT, command:PROGRAM or driver:NAME"
COMMAND_S = 5.0  # a choice: a program that prints a pose answers within a second; a person waits no longer
LONGEST_LINE = 4096
_LOOPBACK = "127.0.0.1"
_FAR_M = 10.0  # no arm on a base reaches farther: larger numbers are millimetres
_ORTHOGONAL = 1e-3  # of a printed rotation matrix: three decimals
_NUMBER = re.compile(r"(?<![A-Za-z_\d.])[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")


_COMMAS = re.compile(r"\d,\d+\s+[-+]?\d+,\d")
_FARTHEST = 1e5  # of a position: 100 m in millimetres, beyond any arm


class NoPose(WeldcalError):
    """A source of poses gives none; the sentence says what to do."""


class ArmSource(Protocol):
    """Where the arm's pose comes from. It sends the arm nothing that could move it."""

    words: str

    def pose(self) -> ArmPose:
        """Return where the arm is now. Raises NoPose."""

    def close(self) -> None:
        """Let the source go; a second call has no effect."""


def arm_source(text: str) -> ArmSource:
    """Return the source of poses that an option names; "": typed numbers.

    Raises:
        InputError: it is none of KINDS.
    """
    kind, _, rest = text.partition(":")
    if not text:
        return TypedPose()
    if kind == "ur" and rest:
        return UrPose(rest)
    if kind == "file" and rest:
        return FilePose(Path(rest))
    if kind == "tcp" and rest.isdigit() and 0 < int(rest) < 65536:
        return LinePose(int(rest))
    if kind == "command" and rest:
        return CommandPose(rest)
    if kind == "driver" and rest:
        return DriverPose(rest)
    raise InputError(f"--poses must be {KINDS}, not '{text[:60]}'; without it the pose is typed into the page.")


def pose_of_text(text: str) -> ArmPose:
    """Return the pose whose numbers a text holds, in any notation: 6, 7, or a matrix of 12 or 16.

    Raises:
        NoPose: it holds another number of numbers, or a matrix that is no pose.
    """
    if ";" in text or ("." not in text and _COMMAS.search(text)):  # decimal commas, as in German exports
        text = re.sub(r"(\d),(\d)", r"\1.\2", text)
    numbers = tuple(float(found) for found in _NUMBER.findall(text))
    if len(numbers) in (12, 16):
        return ArmPose(X_BF=_of_matrix(np.array(numbers).reshape(-1, 4)))
    if len(numbers) not in (6, 7):
        raise NoPose(
            f"A pose has 6 numbers (position and three angles), 7 (with a quaternion), or 12 or 16 (a matrix), and"
            f" '{' '.join(text.split())[:60]}' holds {len(numbers)}."
        )
    if max(map(abs, numbers)) > _FARTHEST:
        raise NoPose(f"'{max(numbers, key=abs):g}' is beyond any arm: copy the pose again.")
    return ArmPose(numbers=numbers)


def _of_matrix(M: np.ndarray) -> RigidTransform:
    if len(M) == 4 and np.allclose(M[:3, 3], 0.0) and not np.allclose(M[3, :3], 0.0):
        M = M.T
    R, p = M[:3, :3], M[:3, 3]
    if not np.allclose(R @ R.T, np.eye(3), atol=_ORTHOGONAL) or np.linalg.det(R) < 0.0:
        raise NoPose("The matrix is no pose: its rotation is not orthonormal. Copy all of its numbers, row by row.")
    far = float(np.linalg.norm(p))
    return RigidTransform(RotationMatrix.ProjectToRotationMatrix(R), p if far < _FAR_M else 1e-3 * p)


class TypedPose:
    """The numbers that were typed last."""

    words = "typed into the page"

    def __init__(self) -> None:
        self.typed = ""

    def pose(self) -> ArmPose:
        """See ArmSource."""
        if not self.typed.strip():
            raise NoPose("No pose is typed: copy that of the flange from the robot's screen into the field.")
        return pose_of_text(self.typed)

    def close(self) -> None:
        """See ArmSource."""


class UrPose:
    """The flange of a Universal Robots arm by RTDE, with a TCP that is set taken out; nothing can move."""

    def __init__(self, host: str) -> None:
        self.words, self._host = f"UR at {host}, read only", host
        self._probe: RtdeProbe | None = None

    def pose(self) -> ArmPose:
        """See ArmSource."""
        try:
            if self._probe is None:
                self._probe = RtdeProbe(self._host)
            read = self._probe.read(("actual_TCP_pose", "actual_q", "tcp_offset"))
        except WeldcalError as error:
            self.close()
            raise NoPose(str(error)) from error
        if "tcp_offset" not in read:
            raise NoPose("This controller does not state its TCP: set the TCP to zero and type the pose, or update it.")
        X_BT, X_FT = (_of_vector(np.array(read[name])) for name in ("actual_TCP_pose", "tcp_offset"))
        return ArmPose(X_BF=X_BT @ X_FT.inverse(), q=np.array(read["actual_q"]))

    def close(self) -> None:
        """See ArmSource."""
        if self._probe is not None:
            self._probe.close()
            self._probe = None


def _of_vector(v: np.ndarray) -> RigidTransform:
    return RigidTransform(RotationMatrix(exp_rotation(v[3:])), v[:3])


class FilePose:
    """The last line of a file that another program appends to, or of the newest file of a folder."""

    def __init__(self, path: Path) -> None:
        self.words, self._path = f"last line of '{path.name}'", path

    def pose(self) -> ArmPose:
        """See ArmSource."""
        try:
            files = [p for p in self._path.iterdir() if p.is_file()] if self._path.is_dir() else [self._path]
            newest = max(files, key=lambda p: p.stat().st_mtime_ns)
            lines = [line for line in read_text(newest).splitlines() if line.strip()]
        except (OSError, ValueError, InputError) as error:
            raise NoPose(f"There is no pose in '{self._path}' yet: let the robot's program write one.") from error
        if not lines:
            raise NoPose(f"'{newest.name}' is empty: let the robot's program write a pose.")
        return pose_of_text(lines[-1])

    def close(self) -> None:
        """See ArmSource."""


class CommandPose:
    """What a program prints."""

    def __init__(self, command: str) -> None:
        self.words, self._command = f"printed by {shlex.split(command)[0]}", shlex.split(command)

    def pose(self) -> ArmPose:
        """See ArmSource."""
        try:
            done = subprocess.run(self._command, capture_output=True, text=True, timeout=COMMAND_S, check=False)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise NoPose(f"{self._command[0]} cannot be run, or prints nothing within {COMMAND_S:g} s.") from error
        if done.returncode:
            last = (done.stderr.strip().splitlines() or ["no message"])[-1]
            raise NoPose(f"{self._command[0]} ended with an error: {last[:120]}")
        return pose_of_text(done.stdout)

    def close(self) -> None:
        """See ArmSource."""


class LinePose:
    """The newest line that a program on this computer sent to a port: JSON or plain numbers."""

    def __init__(self, port: int) -> None:
        self.words, self._line = f"lines at {_LOOPBACK}:{port}", ""
        try:
            self._server = socket.create_server((_LOOPBACK, port))
        except OSError as error:
            raise InputError(f"Port {port} cannot be used ({error.strerror}): name another one.") from error
        threading.Thread(target=self._listen, daemon=True, name="poses").start()

    def pose(self) -> ArmPose:
        """See ArmSource."""
        if not self._line:
            raise NoPose(f"No pose has come to {self.words.split()[-1]} yet: let the robot's program send a line.")
        with suppress(json.JSONDecodeError):
            found = json.loads(self._line)
            if isinstance(found, dict):
                return _of_keys(found)
        return pose_of_text(self._line)

    def close(self) -> None:
        """See ArmSource."""
        self._server.close()

    def _listen(self) -> None:
        with suppress(OSError):
            while True:
                line, _ = self._server.accept()
                threading.Thread(target=self._read, args=(line,), daemon=True).start()

    def _read(self, line: socket.socket) -> None:
        with line, suppress(OSError), line.makefile("r", encoding="utf-8", errors="replace") as text:
            while one := text.readline(LONGEST_LINE):
                if one.endswith("\n") and one.strip():
                    self._line = one


def _of_keys(found: dict[str, object]) -> ArmPose:
    """The pose of a JSON object: a list under any key, or x, y, z with qx, qy, qz, qw or with three angles."""
    values = {str(key).lower(): value for key, value in found.items()}
    for value in values.values():
        if isinstance(value, list):
            return pose_of_text(json.dumps(value))
    names = (("x", "y", "z", "qx", "qy", "qz", "qw"), ("x", "y", "z", "rx", "ry", "rz"), ("x", "y", "z", "a", "b", "c"))
    for keys in names:
        if all(isinstance(values.get(key), int | float) for key in keys):
            return pose_of_text(" ".join(repr(values[key]) for key in keys))
    raise NoPose(f"The line has the keys {', '.join(values)[:80]}, and no pose: send a list of its numbers.")


class DriverPose:
    """The function `pose()` of an installed driver: a RigidTransform X_BF, a 4 x 4 matrix (m), or numbers."""

    def __init__(self, name: str) -> None:
        known: dict[str, Callable[[], object]] = {
            module.__name__.rpartition(".")[2]: module.pose for module in plugins() if hasattr(module, "pose")
        }
        if name not in known:
            raise InputError(
                f"No installed driver is named '{name}': there is {', '.join(known) or 'none with pose()'}."
            )
        self.words, self._pose = f"driver {name}", known[name]

    def pose(self) -> ArmPose:
        """See ArmSource."""
        try:
            found = self._pose()
        except Exception as error:  # a third-party function may raise anything
            raise NoPose(f"The {self.words} gives no pose: {error}") from error
        if isinstance(found, RigidTransform):
            return ArmPose(X_BF=found)
        values = np.asarray(found, dtype=float).ravel()
        return pose_of_text(" ".join(map(repr, values.tolist())))

    def close(self) -> None:
        """See ArmSource."""
