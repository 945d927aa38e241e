"""Process of the emulator: opens every port and runs 500 control frames a second."""

import argparse
import dataclasses
import gc
import inspect
import math
import os
import signal
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from weldcal.models.arms.kinematics import ArmModel, load_arm
from weldcal.models.errors import InputError, WeldcalError
from weldcal.systems.addresses import loopback_address
from weldcal.tools.emulators.ur.checker import Checker
from weldcal.tools.emulators.ur.controller.core import Controller
from weldcal.tools.emulators.ur.controller.motions import STEP_S
from weldcal.tools.emulators.ur.controller.registers import OPERATIONAL_MODES
from weldcal.tools.emulators.ur.lockstep import AHEAD_FRAMES, Lockstep
from weldcal.tools.emulators.ur.process import (
    CONTROL_PORT,
    DASHBOARD_PORT,
    DEFAULT,
    HTTP_PORT,
    PRIMARY_PORT,
    READY,
    REAL_TIME_PORT,
    ROBOT_API_PORT,
    RTDE_PORT,
    SECONDARY_PORT,
)
from weldcal.tools.emulators.ur.versions import parse_version
from weldcal.tools.emulators.ur.wire.control_channel import ControlServer, LoopWorld, Request
from weldcal.tools.emulators.ur.wire.dashboard import DashboardServer
from weldcal.tools.emulators.ur.wire.net import Connection, Network
from weldcal.tools.emulators.ur.wire.robot_api import RobotApiServer
from weldcal.tools.emulators.ur.wire.rtde_server import RtdeServer
from weldcal.tools.emulators.ur.wire.script_ports import ExternalControl, PrimaryServer, RealTimeServer

# the elbow up, the tool down, away from every singularity
HOME = (0.0, -1.5707963267948966, 1.5707963267948966, -1.5707963267948966, -1.5707963267948966, 0.0)
# beyond this (of the controller's time) the loop gives up on catching up and skips frames, and says so in its state
LATE_S = 0.05
SLOWEST, FASTEST = 0.05, 1.0
PARENT_CHECK_S = 0.2
WAIT_S = 0.01
KEEP_ALIVE_S = 0.5
WORLD_AHEAD_FRAMES = 3  # with a world: 6 ms, so that no velocity is 8 ms late with the time on the wire
LONGEST_WAIT_S = 60.0


def run_emulator(
    *,
    host: str = DEFAULT,
    control_port: int = CONTROL_PORT,
    polyscope: str = "5.21",
    robot: str = "ur10e",
    kinematics: Path | None = None,
    q: tuple[float, ...] = HOME,
    safety_limits: str = "",
    operational_mode: str = "none",
    pace: float = 1.0,
    lockstep: float = 0.0,
    seed: int = 0,
    parent: int | None = None,
    ready: Callable[[str], None] | None = None,
) -> None:
    """Runs until it is asked to quit, by signal or on the control channel, or until process `parent` is gone.

    Args:
        host: the loopback address to listen on.
        control_port: port of the JSON-lines control channel.
        polyscope: controller version, such as 5.12, 5.21 or 10.7.
        robot: name of the arm.
        kinematics: a robot's factory calibration; nominal where None.
        q: joint angles at the start (rad).
        safety_limits: six joint ranges "LOWER:UPPER,..." (deg) in place of the arm's own; the arm's own where "".
        operational_mode: none, manual or automatic, as the dashboard and the primary port report it.
        pace: controller seconds per host second, 0.05 to 1; below 1 every frame of 2 ms takes longer.
        lockstep: for so long (s of the host) time waits for a client that streams and is late; 0: never.
        seed: everything random follows from it.
        parent: process whose end ends the emulator.
        ready: called once with a sentence when every port listens.

    Raises:
        InputError: unknown arm or version, a pace, bound or address that is not allowed, or a port that is taken.
    """
    host = loopback_address(host)
    if len(q) != 6 or not np.isfinite(q).all():
        raise InputError("Give six joint angles, in radians.")
    if max(map(abs, q)) > 2.0 * math.pi:  # a joint's range in UR's manuals
        raise InputError(
            f"Give the joint angles in radians, from -6.28 to 6.28: {max(q, key=abs):g} looks like degrees."
        )
    if not SLOWEST <= pace <= FASTEST:
        raise InputError(f"Give a pace from {SLOWEST} to {FASTEST:.0f}, not {pace}.")
    if not 0.0 <= lockstep <= LONGEST_WAIT_S:
        raise InputError(f"Give a lockstep bound from 0 to {LONGEST_WAIT_S:.0f} s, not {lockstep}.")
    if (mode := operational_mode.upper()) not in OPERATIONAL_MODES:
        raise InputError(f"Give none, manual or automatic as operational mode, not {operational_mode!r}.")
    model = narrowed(load_arm(robot, kinematics), safety_limits)
    controller = Controller(model, np.array(q, dtype=np.float64), parse_version(polyscope))
    controller.operational_mode = mode
    Emulation(controller, host, control_port, pace, lockstep, seed).run(parent, ready)


def narrowed(model: ArmModel, ranges: str) -> ArmModel:
    """Return the arm with the joint ranges "LOWER:UPPER,..." (deg); the arm as it is where there are none.

    Raises:
        InputError: these are not six ranges inside the arm's own.
    """
    if not ranges:
        return model
    with suppress(ValueError):
        lower, upper = np.deg2rad([[float(v) for v in pair.split(":")] for pair in ranges.split(",")]).T
        inside = (model.position_lower - 1e-9 <= lower) & (lower < upper) & (upper <= model.position_upper + 1e-9)
        if inside.all() and len(lower) == 6:
            return dataclasses.replace(model, position_lower=lower, position_upper=upper)
    most = np.rad2deg(model.position_upper).round().astype(int).tolist()
    raise InputError(
        f"Give six joint ranges LOWER:UPPER in degrees, commas between, LOWER < UPPER, inside +-{most}, not {ranges!r}."
    )


class Emulation:
    """A controller's ports and its loop.

    `after_step` is called with the host's time (s) after every step of the controller, before its frame is sent: what
    it does belongs to the same time, and the controller waits for it. `while_waiting` is called while the controller's
    time waits for its client. `more_faults` are those of what stands around the controller.
    """

    def __init__(
        self,
        controller: Controller,
        host: str,
        control_port: int,
        pace: float,
        lockstep: float,
        seed: int,
        after_step: Callable[[float], None] | None = None,
        while_waiting: Callable[[], None] | None = None,
        more_faults: Mapping[str, Callable[[Request, float], None]] | None = None,
    ) -> None:
        self._controller = controller
        self._after_step, self._while_waiting = after_step, while_waiting
        self._pace = pace
        self._checker = Checker(controller)
        self._lockstep = Lockstep(controller, lockstep, AHEAD_FRAMES if after_step is None else WORLD_AHEAD_FRAMES)
        self._world = LoopWorld()
        self._sent_at = 0.0
        self._network = Network(host, seed)
        self._rng = np.random.default_rng([seed, 1])
        heard = self._checker.heard
        self._rtde = RtdeServer(controller, self._input)
        self._primary = PrimaryServer(controller, heard, primary=True)
        secondary = PrimaryServer(controller, heard, primary=False)
        real_time = RealTimeServer(controller, heard)
        external = ExternalControl(controller)
        dashboard = DashboardServer(controller)
        api = RobotApiServer(controller, dashboard)
        control = ControlServer(
            controller=controller,
            network=self._network,
            rtde=self._rtde,
            api=api,
            external=external,
            checker=self._checker,
            lockstep=self._lockstep,
            world=self._world,
            more_faults=more_faults,
        )
        self._servers = (self._rtde, self._primary, secondary, real_time, external, api)
        ports = [(self._rtde, RTDE_PORT), (self._primary, PRIMARY_PORT), (secondary, SECONDARY_PORT)]
        ports += [(real_time, REAL_TIME_PORT), (control, control_port)]
        if controller.version.has_dashboard:
            ports.append((dashboard, DASHBOARD_PORT))
        if controller.version.has_robot_api:
            ports.append((api, ROBOT_API_PORT))
            with suppress(OSError):  # not every user may open it; clients of the controller's own makers expect it
                self._network.listen(api, HTTP_PORT)
        for server, port in ports:
            try:
                self._network.listen(server, port)
            except OSError as error:
                self._network.close()
                raise InputError(
                    f"Port {port} on {host} is taken ({error.strerror}); stop the other emulator or robot program."
                ) from error
        self._sentence = f"A UR controller answers on {host}; its control channel is port {control_port}."

    def _input(self, connection: Connection, recipe: int, now: float) -> None:
        self._checker.heard()
        self._lockstep.heard(connection, recipe, now)

    def run(self, parent: int | None, ready: Callable[[str], None] | None) -> None:
        """Run until it is asked to quit, by signal or on the control channel, or until process `parent` is gone."""

        def stop(*_: object) -> None:
            self._world.quit = True

        signal.signal(signal.SIGTERM, stop)
        signal.signal(signal.SIGINT, stop)
        if ready is not None:
            ready(self._sentence)
        gc.freeze()
        if self._after_step is None:  # one that carries a world would keep everything else from the processors
            with suppress(OSError):  # a controller has a computer of its own: run first, where that is allowed
                os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(3))
        try:
            self._loop(parent)
        finally:
            self._network.close()

    def _loop(self, parent: int | None) -> None:
        clock = time.monotonic
        world, network = self._world, self._network
        period, late = STEP_S / self._pace, LATE_S / self._pace
        deadline, parent_check = clock() + period, 0.0
        while not world.quit:
            now = clock()
            if parent is not None and now >= parent_check:
                parent_check = now + PARENT_CHECK_S
                if not _alive(parent):
                    return
            if now < deadline:
                network.poll(deadline - now, clock)
                continue
            if now < world.frozen_until:
                time.sleep(min(world.frozen_until - now, 0.01))
                deadline = clock()
                continue
            if self._lockstep.waits(now):
                if now - self._sent_at > KEEP_ALIVE_S:  # clients close a connection on which nothing comes for seconds
                    self._sent_at = now
                    self._rtde.frame(now)
                if self._while_waiting is not None:
                    self._while_waiting()
                network.flush(now)
                network.poll(WAIT_S, clock)
                deadline = max(deadline, clock())  # what was waited is not made up for
                continue
            if now - deadline > late:
                world.overruns += 1
                deadline = now
            self._frame(now)
            deadline += period
            if world.jitter_s > 0.0 and now - deadline < 0.0:
                # a frame that is on time is followed by one that comes late; those after it catch up in a burst
                time.sleep(period + float(self._rng.uniform(0.0, world.jitter_s)))
            elif now - deadline > 0.0:
                network.poll(0.0, clock)

    def _frame(self, now: float) -> None:
        world, network, controller = self._world, self._network, self._controller
        self._sent_at = now
        if world.unplugged_until is not None and now >= world.unplugged_until:
            world.unplugged_until = None
            network.plug()
        controller.step()
        if self._after_step is not None:
            self._after_step(now)
        self._checker.frame(now)
        if world.unplugged_until is None:
            for server in self._servers:
                server.frame(now)
            while controller.events:
                self._primary.announce(controller.events.popleft(), now)
        network.flush(now)


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True


def main() -> None:
    """Entry point of `python -m weldcal.tools.emulators.ur`."""
    parser = argparse.ArgumentParser(
        prog="python -m weldcal.tools.emulators.ur",
        description=run_emulator.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    kinds: dict[str, dict[str, Any]] = {
        "q": {"type": float, "nargs": 6},
        "kinematics": {"type": Path},
        "parent": {"type": int},
    }
    for name, known in inspect.signature(run_emulator).parameters.items():
        if name != "ready":
            kind = kinds.get(name, {"type": type(known.default)})
            parser.add_argument(f"--{name.replace('_', '-')}", default=known.default, **kind)
    options = parser.parse_args()

    def ready(sentence: str) -> None:
        sys.stdout.write(f"{READY}: {sentence}\n")
        sys.stdout.flush()

    try:
        run_emulator(**vars(options) | {"q": tuple(options.q)}, ready=ready)
    except WeldcalError as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(1)
