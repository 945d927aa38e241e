"""Welds of many parts as a new user gets them: `weldcal new --part FILE`, then `weldcal weld`, and the torch's error.

python -m tests.systems.thirty_welds [FILE ...] [--random N] [--first SEED] [--shipped] [--most MM] [--out FOLDER]
prints one line a weld, mm: length, mean and largest error over the whole length, largest error over the first and the
last 10 mm. Without arguments: the shipped parts and 18 random joints. A refused part has a line with the reason; where
the reason names the tool that fits, the part is tried with it. A butt is welded by `weldcal demo`: a seam that is not
felt needs a calibrated scanner. --most: of a longer seam weld so much, its start and its end by turns.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np

from tests.models.workpieces.random_joints import KINDS
from tests.worlds.parts.step_parts import PARTS, assembly, write_step
from weldcal.models.errors import WeldcalError
from weldcal.models.tools.loading import tool_file
from weldcal.models.workpieces.reading import read_shape
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.commands.cell.new import BASE, OwnPart, write_cell
from weldcal.tools.commands.cell.screen import PIPE_TOOL
from weldcal.tools.commands.weld import run_demo, run_weld
from weldcal.tools.report.run import RunOptions

END_M = 0.010  # issue 43, item 7
SHIPPED_MM, OTHERS_MM = 0.15, 0.3  # the same: the largest error that is wanted
RANDOM = 18


def made(folder: Path, shipped: bool, count: int, first: int) -> Iterator[Path]:
    """Write the shipped parts, then random joints of separate solids, each kind in turn; their files."""
    for name in PARTS if shipped else ():
        write_step(PARTS[name]().shape, folder / f"shipped_{name}.step")
        yield folder / f"shipped_{name}.step"
    for n in range(count):
        name, seed = list(KINDS)[n % len(KINDS)], first + n // len(KINDS)
        solids, _ = KINDS[name](np.random.default_rng([seed, list(KINDS).index(name)]))
        write_step(assembly(*solids), folder / f"{name}_{seed}.step")
        yield folder / f"{name}_{seed}.step"


def begin(file: Path, folder: Path) -> tuple[Path, str]:
    """Begin a cell with a part as `weldcal new` does, with the tool that it names where the shipped one does not fit.

    Returns:
        The scenario's path, and a note or why it cannot be welded.
    """
    cell, reason = write_cell(folder, BASE, OwnPart(file))
    if cell.name != "cell.yaml" and f"--tool-file {PIPE_TOOL}" in reason:
        return write_cell(folder, BASE, OwnPart(file), tool_file(Path(PIPE_TOOL)))
    return cell, reason


def shorter(cell: Path, most_mm: float, at_end: bool) -> None:
    """Leave the start or the end of each open seam of a cell out, so that at most so many mm of it are welded."""
    scenario = load_scenario(str(cell))
    assert scenario.workpiece is not None
    assert scenario.workpiece.file is not None
    shape = read_shape(Path(scenario.workpiece.file))
    for seam in scenario.workpiece.seams:
        rest = 1e3 * sum(shape.edge(id).length_m for id in seam.edges) - most_mm
        if rest > 0.0 and seam.start_mm == seam.end_mm == 0.0:
            cut = f"{{edges: {seam.edges}, {'start_mm' if at_end else 'end_mm'}: {rest:.1f}}}"
            cell.write_text(cell.read_text().replace(f"{{edges: {seam.edges}}}", cut))


def weld(file: Path, folder: Path, seed: int, most_mm: float) -> dict[str, Any]:
    """Begin a cell with a part, weld it, and compare the torch with the true seam."""
    row: dict[str, Any] = {"part": file.stem, "joint": "", "state": "refused", "reason": ""}
    try:
        cell, row["reason"] = begin(file, folder)
        if cell.name != "cell.yaml":
            return row
        shorter(cell, most_mm, seed % 2 == 0)
        workpiece = load_scenario(str(cell)).workpiece
        assert workpiece is not None
        edges = {id for seam in workpiece.seams for id in seam.edges}
        joints = [joint for joint in read_shape(file).joints if edges & set(joint.edges)]
        row |= {"edges": sorted(edges), "joint": ", ".join(f"{joint.type} {joint.side}".strip() for joint in joints)}
        run = run_demo if workpiece.joint == "butt" else run_weld
        result = run(RunOptions(scenario=str(cell), out=folder / "out", seed=seed, recording=False))
    except WeldcalError as error:
        return row | {"reason": str(error)}
    row |= {"state": result.state, "reason": row["reason"] or result.run.reason or ""}
    if result.weld is None or result.weld.error is None:
        return row
    ends = 1e3 * np.array([error.ends_m(END_M) for error in result.weld.seams])
    distance = 1e3 * result.weld.error.distance_m
    return row | {
        "welded_mm": 1e3 * sum(float(error.s[-1] - error.s[0]) for error in result.weld.seams),
        "mean_mm": float(distance.mean()),
        "max_mm": float(distance.max()),
        "first_mm": float(ends[:, 0].max()),
        "last_mm": float(ends[:, 1].max()),
        "plan_mm": 1e3 * result.weld.plan_error.max_m if result.weld.plan_error is not None else None,
        "felt": result.run.cell.job.planned_seam(result.run.root).felt,
    }


def line(row: dict[str, Any]) -> str:
    """One weld as a line of the table."""
    if "max_mm" not in row:
        return f"{row['part'][:28]:28}  {row['joint'][:22]:22}  {row['state']}: {row['reason']}"
    limit = SHIPPED_MM if row["part"].startswith("shipped_") else OTHERS_MM
    figures = "  ".join(f"{row[key]:6.3f}" for key in ("mean_mm", "max_mm", "first_mm", "last_mm"))
    verdict = ("" if row["max_mm"] <= limit else f"above {limit} mm  ") + ("" if row["felt"] else "not felt  ")
    words = f"{row['state']}  {verdict}{row['reason']}"
    return f"{row['part'][:28]:28}  {row['joint'][:22]:22}  {row['welded_mm']:6.1f}  {figures}  {words}".rstrip()


def main() -> None:
    """Weld the parts one after the other, and print the table; OUT/welds.jsonl has every figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path)
    parser.add_argument("--random", type=int)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--shipped", action="store_true")
    parser.add_argument("--most", type=float, default=math.inf)
    parser.add_argument("--out", type=Path)
    words = parser.parse_args()
    alone = not words.files and words.random is None and not words.shipped
    out = words.out or Path(mkdtemp(prefix="welds"))
    out.mkdir(parents=True, exist_ok=True)
    count = RANDOM if alone else words.random or 0
    print(f"{'part':28}  {'joint':22}  {'length':>6}  {'mean':>6}  {'max':>6}  {'first':>6}  {'last':>6}  {out}")
    pool = ProcessPoolExecutor(1, mp_context=get_context("spawn"))
    with (out / "welds.jsonl").open("a") as table:
        for k, file in enumerate([*words.files, *made(out, alone or words.shipped, count, words.first)]):
            try:
                folder = Path(mkdtemp(prefix=f"{file.stem}_", dir=out))
                row = pool.submit(weld, file, folder, k + 1, words.most).result()
            except BrokenProcessPool as error:
                row = {"part": file.stem, "joint": "", "state": "broken", "reason": str(error)}
                pool = ProcessPoolExecutor(1, mp_context=get_context("spawn"))
            print(line(row), flush=True)
            print(json.dumps(row), file=table, flush=True)
    pool.shutdown()


if __name__ == "__main__":
    main()
