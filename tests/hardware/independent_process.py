"""The independent controller as a process, and a session of the robot link with it."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from tests.places import ROOT
from weldcal.models.arms.kinematics import load_arm
from weldcal.systems.drivers.ur.link import UrLink
from weldcal.systems.drivers.ur.readiness.preflight import preflight, require_ready
from weldcal.systems.drivers.ur.rtde import UrRtde

CONTROL_PORT = 30095
REST_RAD_S = 1e-3
JOINT, SPEED = 5, 0.3  # that a session moves, rad/s
STARTS_S = 20.0


@dataclass
class Controller:
    """A running controller and its control channel."""

    process: subprocess.Popen[str]
    host: str

    def do(self, name: str, /, **settings: Any) -> dict[str, Any]:
        """Ask for a fault or an operator's action; returns the answer."""
        with socket.create_connection((self.host, CONTROL_PORT), timeout=5.0) as line:
            line.sendall(json.dumps({"do": name, **settings}).encode() + b"\n")
            with line.makefile("r") as answers:
                found: dict[str, Any] = json.loads(answers.readline())
        assert found.get("ok", True), found
        return found

    def state(self) -> dict[str, Any]:
        """What the controller knows of itself."""
        return self.do("state")

    def speed(self) -> float:
        """The fastest joint, rad/s."""
        return float(np.abs(self.state()["qd"]).max())

    def rests(self, seconds: float) -> dict[str, Any]:
        """The state once the arm is at rest. Raises where it moves for longer, on the controller's clock."""
        began = float(self.state()["time"])
        while (state := self.state())["time"] - began < seconds:
            if np.abs(state["qd"]).max() < REST_RAD_S:
                return state
            time.sleep(0.005)
        raise AssertionError(f"the arm moves {seconds} s after the fault: {state}")


@contextmanager
def independent_controller(
    host: str | None = None, q: Sequence[float] | None = None, *, own_computer: bool = True
) -> Iterator[Controller]:
    """A controller at a loopback address of this process's own; `own_computer`: with real-time priority, where that is
    allowed."""
    host = host or f"127.40.{os.getpid() // 250 % 250}.{1 + os.getpid() % 250}"
    command = [sys.executable, "-m", "tests.hardware.independent", "--host", host]
    command += [] if q is None else ["--q", *(f"{x:.6f}" for x in q)]
    command += ["--own-computer"] if own_computer else []
    bare = {
        name: value for name, value in os.environ.items() if name != "PYTHONPATH"
    }  # where the product would be found
    process = subprocess.Popen(command, cwd=ROOT, env=bare, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("ready")
        yield Controller(process, host)
    finally:
        process.kill()
        process.wait()


@contextmanager
def session(controller: Controller, **settings: Any) -> Iterator[UrLink]:
    """The robot link of a job with this controller: pre-flight, guard script, payload."""
    config = UrRtde(host=controller.host)
    report = preflight(controller.host, nominal=load_arm("ur10e"), load=config.load())
    require_ready(report)
    assert report.arm is not None
    x, y, z = config.payload_cog_m
    link = UrLink.start(
        controller.host,
        report.arm,
        config.limits(report.arm),
        payload_kg=config.payload_kg,
        payload_cog_m=(x, y, z),
        **settings,
    )
    try:
        yield link
    finally:
        with suppress(Exception):
            link.close()


def move(link: UrLink, seconds: float, *, process: bool = False) -> str | None:
    """Command a velocity of one joint, turning back each 0.8 s, until this time or a fault; returns the fault's
    sentence."""
    began, velocity = time.monotonic(), np.zeros(6)
    while (t := time.monotonic() - began) < seconds:
        velocity[JOINT] = SPEED * np.sin(2.0 * np.pi * t / 1.6)
        link.command(velocity, process)
        if (fault := link.state().status.fault) is not None:
            return fault
        time.sleep(0.004)
    return None
