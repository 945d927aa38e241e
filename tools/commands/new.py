"""`weldcal new`: a cell of one's own, or an example of a calibration dataset, in a folder."""

from pathlib import Path

from weldcal.models.errors import InputError
from weldcal.systems.runner import Progress, no_progress
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.commands.run import run_job
from weldcal.tools.commands.run_files import write_scans
from weldcal.tools.outcomes.options import RunOptions

EXAMPLE = "calibrate_only"
SMALL = "scanner: {width: 412, height: 308}"  # pixels of the example's scans: a few hundred kB each
README = """# An example of a calibration dataset

Scans of a robot's bare flange, taken in simulation. Calibrate with: weldcal calibrate {folder}

    dataset.yaml   the robot, its flange, the scanner, the units, and where the scanner stands roughly
    poses.csv      id, x, y, z (m), qw, qx, qy, qz, time (s): the flange in the robot's base, TCP zero, at each scan
    clouds/ID.npz  the scan of that pose in the camera's frame; ply and pcd are read too

Put your own scans and poses in their place. Eight to twelve poses, tilted and turned, spread over the working volume, are a good number.
"""


def write_example(folder: Path, seed: int, progress: Progress = no_progress) -> Path:
    """Scan a flange in simulation and write the scans as a dataset.

    Raises:
        InputError: there is something in the folder already.
    """
    if folder.exists() and any(folder.iterdir()):
        raise InputError(f"'{folder}' is not empty: choose another folder.")
    scenario = load_scenario(EXAMPLE, SMALL)
    finished = run_job(scenario, RunOptions(EXAMPLE, folder, seed, recording=False), progress, "")
    progress("write", 0.99)
    status = finished.cell.job.calibration_status(finished.run.root)
    written = write_scans(finished.run, status, folder)
    if written is None:
        raise InputError("No scan of the flange was taken: give another --seed.")
    (folder / "README.md").write_text(README.format(folder=folder), encoding="utf-8")
    return written
