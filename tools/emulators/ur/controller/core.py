"""The controller: runs programs and watchdogs, and moves the arm, one call of `step` every 2 ms."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from weldcal.models.arms.kinematics import ArmModel
from weldcal.tools.emulators.ur.controller.motions import STEP_S, MotionRefused
from weldcal.tools.emulators.ur.controller.registers import (
    ErrorCode,
    Registers,
    RobotMode,
    RuntimeState,
    SafetyMode,
    ScriptStopped,
    Started,
    Stopped,
)
from weldcal.tools.emulators.ur.controller.state import POWER_STEP_S, ControllerState
from weldcal.tools.emulators.ur.script.builtins import script_functions
from weldcal.tools.emulators.ur.script.program import Program
from weldcal.tools.emulators.ur.script.syntax import ScriptError
from weldcal.tools.emulators.ur.versions import Version

WORDS = ("stop program", "power on", "power off", "set robotmode run", "set unlock protective stop")


MOST_SIDEKICKS = 20  # [M]


class Controller(ControllerState):
    """Everything but the wire; the wire's faults live in the servers."""

    def __init__(self, model: ArmModel, q: NDArray[np.float64], version: Version) -> None:
        super().__init__(model, q, version)
        self.program: Program | None = None
        self.program_name = ""
        self.sidekicks: list[Program] = []
        self.script_count = 0

    # programs

    def submit(self, source: str) -> None:
        """Text of one program from a script port: runs it where the state allows, or drops it."""
        line = source.strip()
        words = line.rstrip("()").strip()
        if self.version.takes_scripts and words in WORDS:
            self._word(words)
            return
        if not line or line.startswith("#"):
            return
        if not self.version.takes_scripts:
            self.note("program ignored: PolyScope X takes scripts on its ports from 10.10 on; use External Control")
            return
        if not self.remote or self.refuse_upload:
            self.note("program ignored: " + ("uploads are refused" if self.remote else "local mode"))
            if not self.remote:
                self.tell(ErrorCode(210, 0, 3, "The socket is read-only while the robot is in local control."))
            return
        if self.start_delay_s > 0.0:
            self.later(self.start_delay_s, lambda: self.start(source))
        else:
            self.start(source)

    def _word(self, words: str) -> None:
        if not self.remote:
            self.note(f"ignored in local mode: {words}")
        elif words == "stop program":
            self.stop_program()
        elif words == "power off":
            self.power_off()
        elif words == "set unlock protective stop":
            self.unlock_protective_stop(at_once=True)
        else:
            self.power_on()
            if words == "set robotmode run":
                self.later(POWER_STEP_S + STEP_S, self.release_brakes)

    def start(self, source: str) -> bool:
        """Starts a program in place of the running one; a `sec` runs in parallel."""
        if not self.ready:
            self.note("program ignored: the robot is not running or a safety stop is active")
            return False
        try:
            program = Program(source, lambda made: script_functions(self, made))
        except ScriptError as error:
            self.note(f"compile error: {error}")
            self.tell(ScriptStopped(str(error), error.line, error.column))
            return False
        self.script_count += 1
        if program.kind == "sec":
            if taken := len(self.sidekicks) < MOST_SIDEKICKS:
                self.sidekicks.append(program)
            self.note(f"secondary program {'started' if taken else 'ignored, too many run'}: {program.name}")
            return taken
        self._drop_program()
        self.program, self.program_name = program, program.name
        self.runtime_state = RuntimeState.PLAYING
        self.note(f"program started: {program.name}")
        self.tell(Started(program.name))
        return True

    def stop_program(self) -> None:
        """Ends the program; the arm brakes."""
        if self.program is not None:
            self._drop_program()
            self.runtime_state = RuntimeState.STOPPING

    def _drop_program(self) -> None:
        if self.program is None:
            return
        self.program.close()
        self.terminals.program_ended()
        self.note(f"program stopped: {self.program.name}")
        self.tell(Stopped(self.program.name))
        self.program = None
        self.arm.motion = self.arm.compliance = None
        self.watchdogs.clear()

    def resume_program(self) -> bool:
        """Dashboard `play`, also after a protective stop: the program continues with the values in its registers."""
        if self.program is None or not self.ready or not self.remote:
            return False
        self.runtime_state = RuntimeState.PLAYING
        for watchdog in self.watchdogs.values():
            watchdog.fed_at = self.frame
        return True

    def power_off(self) -> None:
        """The brakes fall; the program ends."""
        self.stop_program()
        self.robot_mode = RobotMode.POWER_OFF

    def reboot(self) -> None:
        """Everything volatile is gone; the arm has no power and the clock starts again."""
        self._drop_program()
        self.sidekicks.clear()
        self.inputs, self.outputs = Registers(), Registers()
        self.terminals.digital_outputs = 0
        self.terminals.analog_outputs = [0.0, 0.0]
        t = self.terminals
        for kept in (t.runstate, t.analog_runstate, t.foreign, t.analog_foreign):
            kept.clear()
        self.robot_mode, self.safety_mode = RobotMode.POWER_OFF, SafetyMode.NORMAL
        self.runtime_state = RuntimeState.STOPPED
        self.timestamp = 0.0
        self.note("rebooted")

    # time

    def step(self) -> None:
        """One control frame: due actions, programs, watchdogs, arm."""
        self.frame += 1
        self.timestamp += STEP_S * self.clock_rate
        if self._later:
            due = [action for frame, action in self._later if frame <= self.frame]
            self._later = [(frame, action) for frame, action in self._later if frame > self.frame]
            for action in due:
                action()
        self._watch()
        for program in list(self.sidekicks):
            self._run(program)
        if self.program is not None and self.runtime_state == RuntimeState.PLAYING:
            self._run(self.program)
        self.terminals.write_foreign(self.frame)
        self._move()

    def _run(self, program: Program) -> None:
        try:
            program.step()
        except ScriptError as error:
            self.note(f"runtime error in line {error.line}: {error}")
            self.tell(ScriptStopped(str(error), error.line, error.column))
            program.close()
        if program.finished:
            if program is self.program:
                self.stop_program()
            elif program in self.sidekicks:
                self.sidekicks.remove(program)

    def _watch(self) -> None:
        if self.runtime_state != RuntimeState.PLAYING:
            return
        for name, watchdog in list(self.watchdogs.items()):
            if (self.frame - watchdog.fed_at) * STEP_S > watchdog.period_s:
                self.note(f"watchdog: {name} not written for {watchdog.period_s:.3f} s, {watchdog.action}")
                if watchdog.action == "stop":
                    self.stop_program()
                    return
                if watchdog.action == "pause":
                    self.pause_program()
                    return

    def _move(self) -> None:
        playing = self.runtime_state == RuntimeState.PLAYING and self.ready
        driven = playing and self.program is not None and self.program.owner is not None
        try:
            self.arm.step(driven, self.motion_scaling, playing)
        except MotionRefused as refused:
            self.protective_stop(str(refused), refused.code)
        if not driven and self.arm.at_rest:
            if self.runtime_state == RuntimeState.STOPPING:
                self.runtime_state = RuntimeState.STOPPED
            elif self.runtime_state == RuntimeState.PAUSING:
                self.runtime_state = RuntimeState.PAUSED

    def state(self) -> dict[str, Any]:
        """What a test may ask for, in JSON's own types."""
        motion = self.arm.motion
        return {
            "frame": self.frame,
            "timestamp": self.timestamp,
            "q": self.arm.q.tolist(),
            "qd": self.arm.qd.tolist(),
            "q_target": self.arm.q_target.tolist(),
            "qd_target": self.arm.qd_target.tolist(),
            "tcp_pose": self.arm.tool_pose(),
            "tcp_speed": self.arm.tool_speed(),
            "tcp_offset": self.tcp_offset,
            "payload_mass": self.payload.mass,
            "robot_mode": self.robot_mode.name,
            "safety_mode": self.safety_mode.name,
            "runtime_state": self.runtime_state.name,
            "remote": self.remote,
            "speed_slider": self.terminals.speed_slider,
            "program": self.program_name if self.program else None,
            "programs_started": self.script_count,
            "motion": type(motion).__name__ if motion is not None else None,
            "command": self.inputs.integers[0],
            "answer": self.outputs.integers[0],
            "digital_outputs": self.terminals.digital_outputs,
            "digital_inputs": self.terminals.digital_inputs,
            "analog_outputs": [self.terminals.analog_output(n) for n in range(2)],
            "script_line": self.program.line if self.program else 0,
            "watchdogs": sorted(self.watchdogs),
        }
