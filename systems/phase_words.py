"""The words for the phases of every job: one list, for the terminal, the dashboard, the 3D view and the report."""

TEXT = {
    "start": "ready",
    "move_home": "to home",
    "move_to_pose": "calibrate: to the next pose",
    "scan_pose": "calibrate: scan",
    "move_to_verify": "verify: to a held-out pose",
    "scan_verify": "verify: scan",
    "park": "park",
    "move_to_scan": "to the next scan pose",
    "scan_workpiece": "scan the workpiece",
    "leave_scan": "home",
    "confirm": "a question",
    "approach_above": "approach",
    "approach": "approach",
    "weld": "track the seam and weld",
    "retract": "retract",
    "interpass": "home, for the next pass",
    "plan_pass": "wait for the next pass",
    "plan_seam": "plan the next seam",
    "home": "home",
    "done": "done",
    "held": "HELD: see the report",
}
"""The phases of the weld job."""
OTHERS = {
    "to_start": "home",
    "to_look": "to the look",
    "look": "look at the tablet",
    "to_above": "to the next touch",
    "zero": "read the free tip",
    "descend": "touch down",
    "press": "read the pressed tip",
    "lift": "lift off",
    "to_home": "home",
    "go_home": "home",
    "rest": "come to rest",
    "move": "to the next pose",
    "scan": "scan",
    "collect": "stream scans in motion",
    "calibrate": "calibrate",
    "compute": "compute",
    "dwell": "come to rest",
    "await": "wait for the scan",
    "run": "move along the seam",
}
"""The phases of the other jobs that the weld job does not have."""

STEPS: tuple[tuple[str, str | None, tuple[str, ...]], ...] = (
    ("Calibrate", "calibrate", ("start", "move_home", "move_to_pose", "scan_pose")),
    ("Verify", "calibrate", ("move_to_verify", "scan_verify")),
    ("Park", None, ("start", "move_home", "park")),
    ("Scan the part", "weld", ("move_to_scan", "scan_workpiece", "leave_scan")),
    ("Approach", "weld", ("confirm", "approach_above", "approach")),
    ("Weld", "weld", ("weld",)),
    ("Go home", "weld", ("retract", "interpass", "plan_pass", "plan_seam", "home")),
)
"""Steps of the weld job: name, the part of the job that it belongs to (None: both), and its phases."""

Steps = tuple[tuple[str, tuple[str, ...]], ...]
MOUNTING_STEPS: Steps = (("Calibrate", ("start", "calibrate")), ("Verify", ("verify",)), ("Go home", ("home",)))
MOTION_STEPS: Steps = (
    ("Approach", ("start", "approach")),
    ("Collect frames", ("collect",)),
    ("Go home", ("home",)),
    ("Calibrate", ("calibrate",)),
)
WATCH_STEPS: Steps = (("Approach", ("start", "approach")), ("Watch", ("collect",)), ("Go home", ("home",)))
TABLET_STEPS: Steps = (
    ("Look", ("start", "to_start", "to_look", "look")),
    ("Touch", ("to_above", "descend", "lift")),
    ("Go home", ("to_home",)),
)
TOUCH_STEPS: Steps = (
    ("Scan the part", ("start", "to_home", "rest", "scan")),
    ("Touch", ("to_above", "zero", "descend", "press", "lift")),
    ("Go home", ("go_home",)),
)
TOOL_SCAN_STEPS: Steps = (("Scan the tool", ("start", "to_home", "move", "scan")), ("Go home", ("go_home",)))
PROFILER_STEPS = {
    "start": "Get ready",
    "edge": "Scan the edge",
    "sphere": "Scan the sphere",
    "touch": "Touch the sphere",
    "pass": "Scan the seam",
    "torch": "Move along the seam",
    "home": "Go home",
}
"""Steps of the other jobs: name, and the keys of the step (see the dashboard's `stage_of`)."""


def phase_words(phase: str, detail: str = "") -> str:
    """Return a phase in words, with a detail after a comma.

    A phase that is not listed (of an installed job) as it is written.
    """
    words = TEXT.get(phase) or OTHERS.get(phase) or phase.replace("_", " ")
    return f"{words}, {detail}" if detail else words
