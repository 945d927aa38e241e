"""Results of the flange study and its JSON object."""

from dataclasses import dataclass

import numpy as np

from weldcal.models.arrays import Array
from weldcal.tools.studies.flange.published.clouds import CloudsOutcome
from weldcal.tools.studies.flange.published.pairs import PAPER_E_RPY_DEG, PAPER_E_XYZ_MM, KinectOutcome, PairsOutcome
from weldcal.tools.studies.flange.published.simulation import Errors, Simulation
from weldcal.tools.studies.harness import statistics

TABLE1: dict[str, tuple[float, ...]] = {
    "UR5 & PhoXi M": (11.60, 2.81, 5.55, 0.49, -0.89, -0.47),
    "UR10e & PhoXi M": (0.60, 1.75, -0.41, 0.10, -0.04, -0.23),
    "Franka Emika & PhoXi M": (4.34, -4.06, -0.13, -0.30, -0.34, -0.07),
    "AUBO i5 & PhoXi S": (-0.26, -0.27, -0.35, 0.14, 0.04, 0.01),
}
"""Table 1 of the paper: x, y, z in mm, roll, pitch, yaw in degrees."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PublishedResults:
    """All outcomes; ``notes`` are sentences about data that were missing or not usable."""

    simulation: Simulation
    pairs: tuple[PairsOutcome, ...]
    clouds: tuple[CloudsOutcome, ...]
    kinect: tuple[KinectOutcome, ...]
    notes: tuple[str, ...]

    def summary(self) -> dict[str, object]:
        """The result for JSON: millimetres and degrees where the key says so."""
        sim, axes = self.simulation, ("roll", "pitch", "yaw", "x", "y", "z")
        return {
            "notes": self.notes,
            "simulation": {
                "std_ratio_all_over_algorithm1": dict(zip(axes, sim.ratio, strict=True)),
                "std_ratio_best_of_three": dict(zip(axes, sim.best_ratio, strict=True)),
                "at_1mm": {name: _errors(e) for name, e in sim.costs.items()},
            },
            "paper_table1": {name: {"xyz_mm": v[:3], "rpy_deg": v[3:]} for name, v in TABLE1.items()},
            "pairs": {p.name: _pairs(p) for p in self.pairs},
            "clouds": {c.name: _clouds(c) for c in self.clouds},
            "kinect": {
                k.name: {
                    "n": k.n,
                    "paper_e": {"xyz_mm": PAPER_E_XYZ_MM, "rpy_deg": PAPER_E_RPY_DEG},
                    "residual_mm": in_mm(k.residual),
                    "held_out_mm": in_mm(k.held_out),
                    "weldcal_held_out_mm": in_mm(k.ours),
                    "compensated_mm": in_mm(k.compensated),
                    "e_at_camera_mm": 1e3 * k.at_camera_m,
                    "e_at_work_mm": 1e3 * k.shift_m,
                }
                for k in self.kinect
            },
        }


def in_mm(errors_m: Array) -> dict[str, float]:
    """Median, mean and 95 % in mm, NaN left out."""
    return statistics(1e3 * errors_m, "median", "mean", "p95")


def _errors(e: Errors) -> dict[str, object]:
    at_tcp = 1e3 * e.at_tcp
    return {
        "std_xyz_mm": 1e3 * e.e[:, 3:].std(axis=0, ddof=1),
        "std_rpy_deg": np.degrees(e.e[:, :3].std(axis=0, ddof=1)),
        "true_mm": {"mean": at_tcp.mean(), "worst_run": at_tcp.mean(axis=1).max(), "max": at_tcp.max()},
    }


def _pairs(p: PairsOutcome) -> dict[str, object]:
    return {
        "n": p.n,
        "outliers": p.outliers,
        "table1_xyz_mm": None if p.table1 is None else 1e3 * p.table1[3:],
        "table1_rpy_deg": None if p.table1 is None else np.degrees(p.table1[:3]),
        "algorithm1_reports_mm": None if p.runs is None else p.reported_mm,
        "algorithm1_own_four_mm": in_mm(p.own_pool),
        "algorithm1_true_mm": in_mm(p.true),
        "svd_held_out_mm": in_mm(p.svd),
        "weldcal_held_out_mm": in_mm(p.ours),
    }


def _clouds(c: CloudsOutcome) -> dict[str, object]:
    return {
        "n": c.n,
        "verification": c.verification,
        "n_fit": c.n_fit,
        "circle_repeat_mm": c.circle_repeat_mm,
        "circle_bias_R_mm": c.circle_bias_R_mm,
        "circle_halves_mm": c.halves_mm("published"),
        "edges_halves_mm": c.halves_mm("ours"),
        "held_out_mm": {s.name: in_mm(s.held_out) for s in c.splits},
        "reported_mm": {s.name: 1e3 * s.reported for s in c.splits},
        "sight": {r.title: {"share": r.share, "value": r.value, "blind": r.blind} for r in c.sights},
    }
