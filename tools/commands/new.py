"""`weldcal new`: a cell of one's own, or an example of a calibration dataset, in a folder."""

from pathlib import Path

from weldcal.models.errors import InputError
from weldcal.models.result_files import write_atomic
from weldcal.systems.runner import Progress, no_progress
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.commands.run import run_job
from weldcal.tools.commands.run_files import write_scans
from weldcal.tools.outcomes.options import RunOptions
from weldcal.tools.scenarios.dataset_forms import FORMS, rewrite

EXAMPLE = "calibrate_only"
SMALL = "scanner: {width: 412, height: 308}"  # pixels of the example's scans: a few hundred kB each
README = """# An example of a calibration dataset

Scans of a robot's bare flange, taken in simulation. Calibrate with: weldcal calibrate {folder}

    dataset.yaml   the robot, its flange, the scanner, the units, and where the scanner stands roughly
    poses.csv      id, x, y, z (m), qw, qx, qy, qz, time (s): the flange in the robot's base, TCP zero, at each scan
    clouds/ID.npz  the scan of that pose in the camera's frame; ply and pcd are read too

Put your own scans and poses in their place. Eight to twelve poses, tilted and turned, spread over the working volume, are a good number.
"""


OTHER = """# An example of a calibration dataset: {form}

Scans of a robot's bare flange, taken in simulation. Calibrate with: weldcal calibrate {folder}

    dataset.yaml   the robot, its flange, the scanner, and where the scanner stands roughly
    {files}

docs/datasets.md lists the forms that are read. Put your own scans and poses in the place of these.
"""
FILES = {
    "ur": "poses.txt      p[x, y, z, rx, ry, rz] (m, rad) of the flange, TCP zero, one line a scan, in the order of clouds/",
    "matrices": "poses/ID.txt   X_BF, the flange in the robot's base, 4 x 4, row by row (m); clouds/ID.npz is its scan",
    "opencv": "robot_poses.yml OpenCV FileStorage with a node for each scan: X_BF, 4 x 4 (m); clouds/ID.npz is its scan",
    "zivid": "pos01.yaml     X_BF as PoseState, 4 x 4 (mm); img01.pcd is its scan (mm), in place of Zivid's closed .zdf",
    "ros": "tool_pose.csv  X_BF of each scan as 'rostopic echo -p' prints it, in the order of clouds/",
    "mcap": "recording/     a ROS 2 recording: PointCloud2 and PoseStamped",
}


def write_example(folder: Path, seed: int, progress: Progress = no_progress, form: str = "") -> Path:
    """Scan a flange in simulation and write the scans as a dataset, in weldcal's own form or another (ur, matrices, opencv ...).

    Raises:
        InputError: there is something in the folder already, or no such form.
    """
    if form and form not in FORMS:
        raise InputError(f"There is no form '{form}': use {', '.join(FORMS)}.")
    if folder.exists() and any(folder.iterdir()):
        raise InputError(f"'{folder}' is not empty: choose another folder.")
    scenario = load_scenario(EXAMPLE, SMALL)
    finished = run_job(scenario, RunOptions(scenario=EXAMPLE, out=folder, seed=seed, recording=False), progress, "")
    progress("write", 0.99)
    status = finished.cell.job.calibration_status(finished.run.root)
    written = write_scans(finished.run, status, folder)
    if written is None:
        raise InputError("No scan of the flange was taken: give another --seed.")
    text = OTHER.format(folder=folder, form=form, files=FILES[form]) if form else README.format(folder=folder)
    if form:
        rewrite(folder, form)
    write_atomic(folder / "README.md", text)
    return written
