"""Rows of the target table: welds, figures and limits."""

from dataclasses import dataclass

from weldcal.models.errors import InputError
from weldcal.tools.worlds.weld.case import Case


class UnknownRow(InputError):
    """No row of the study has this name."""


@dataclass(frozen=True)
class Target:
    """A bound on one figure of RunMetrics: `over` the seeds ("worst" or "mean") it is to be at most `limit`."""

    figure: str
    limit: float
    over: str = "worst"
    unit: str = "mm"


@dataclass(frozen=True)
class Row:
    """A line of the table: its welds and their targets; every weld has to be completed as well."""

    key: str
    label: str
    cases: tuple[Case, ...]
    targets: tuple[Target, ...]


_CHORDS = (0.040, 0.060, 0.080)
_EASY = ("straight", "s_r60", "l_r20_convex", "l_r20_concave")
_BOUNDED = (Target("omega_rad_s", 0.8, unit="rad/s"), Target("tip_speed_mm_s", 40.0, unit="mm/s"))
_GAP_10, _GAP_25 = ((0.145, 0.155),), ((0.1375, 0.1625),)

_WRONG = (Target("mean_mm", 0.10, "mean"), Target("max_mm", 0.30), Target("height_mm", 0.65))
_SINGLE = {
    "stamp_bias": "only: pictures stamped 10 ms early, poses 8 ms late",
    "stamp_jitter": "only: each stamp off by 2 ms (one sigma)",
    "wedge_open": "only: both walls 0.75 deg farther open",
    "wedge_side": "only: both walls turned by 0.75 deg to the left",
    "wear": "only: tip worn by 0.1 mm of radius",
    "seat": "only: tip sits 0.1 mm higher than believed",
    "lag_half": "only: robot's lag half of the believed 25 ms",
    "lag_1_5": "only: robot's lag 1.5 times as long",
    "lag_double": "only: robot's lag twice as long",
}

ROWS: tuple[Row, ...] = (
    Row(
        "imperfect",
        "imperfect world: straight, S R60, L R20",
        tuple(Case(seam, "imperfect") for seam in _EASY),
        (*_WRONG, *_BOUNDED),
    ),
    Row(
        "imperfect_corners",
        "imperfect world: R5 and R1 corners",
        tuple(Case(f"l_{r}_{side}", "imperfect") for r in ("r5", "r1") for side in ("convex", "concave")),
        (Target("mean_mm", 0.12, "mean"), Target("max_mm", 0.50), Target("height_mm", 0.65), *_BOUNDED),
    ),
    *(
        Row(name, f"S R60, L R20; {label}", tuple(Case(seam, name) for seam in ("s_r60", "l_r20_convex")), _WRONG)
        for name, label in _SINGLE.items()
    ),
    Row(
        "nominal",
        "perfectly known world: straight, S R60, L R20; chord 40, 60, 80 mm; nominal",
        tuple(Case(seam, chord_m=d) for seam in _EASY for d in _CHORDS),
        (
            Target("mean_mm", 0.04, "mean"),
            Target("max_mm", 0.15),
            Target("cv_percent", 1.0, unit="%"),
            Target("time_ratio", 1.02, unit="L/V"),
            *_BOUNDED,
        ),
    ),
    Row(
        "hard",
        "perfectly known world, hard budget, chord 60 mm",
        tuple(Case(seam, "hard") for seam in _EASY),
        (Target("mean_mm", 0.12, "mean"), Target("max_mm", 0.45), *_BOUNDED),
    ),
    Row(
        "hard_corners",
        "R5 and R1 corners, hard budget: completed",
        tuple(Case(f"l_{r}_{side}", "hard") for r in ("r5", "r1") for side in ("convex", "concave")),
        (Target("mean_mm", 0.12, "mean"), *_BOUNDED),
    ),
    Row("r5", "L R5, nominal", (Case("l_r5_convex"), Case("l_r5_concave")), (Target("max_mm", 0.35), *_BOUNDED)),
    Row("r1_concave", "L R1 concave, nominal", (Case("l_r1_concave"),), (Target("max_mm", 0.30), *_BOUNDED)),
    Row("r1_convex", "L R1 convex, nominal", (Case("l_r1_convex"),), (Target("max_mm", 0.50), *_BOUNDED)),
    Row(
        "end",
        "end of the seam: straight, on an R60 arc",
        (Case("straight"), Case("arc_r60_end")),
        (Target("end_mm", 0.12), Target("end_step_mm_s", 0.5, unit="mm/s")),
    ),
    Row("gap_10", "gap of 10 mm, straight and S", tuple(Case(s, gaps=_GAP_10) for s in _EASY[:2]), (Target("gap_mm", 0.12),)),
    Row("gap_25", "gap of 25 mm, straight and S", tuple(Case(s, gaps=_GAP_25) for s in _EASY[:2]), (Target("gap_mm", 0.60),)),
    Row("speed_16", "16 mm/s: S R60, L R20", tuple(Case(s, speed_m_s=0.016) for s in _EASY[1:]), (Target("max_mm", 0.20), *_BOUNDED)),
    Row("speed_24", "24 mm/s: S R60, L R20", tuple(Case(s, speed_m_s=0.024) for s in _EASY[1:]), (Target("max_mm", 0.35), *_BOUNDED)),
    Row(
        "space",
        "on cylinders of R 150 and 300 mm, kinematic budget",
        tuple(Case(f"{s}_on_{r}", "kinematic") for s in ("s_r60", "l_r20") for r in ("r150", "r300")),
        (
            Target("mean_mm", 0.03, "mean"),
            Target("space_mm", 0.03),
            Target("work_deg", 3.0, unit="deg"),
            Target("travel_error_deg", 0.1, unit="deg"),
        ),
    ),
    *(
        Row(
            f"space_{um}um",
            f"the same L on R 300 mm, tag noise {um} um: what of the error is noise",
            (Case("l_r20_on_r300", f"kinematic_{um}um"),),
            (Target("space_mm", 0.03),),
        )
        for um in (0, 5, 10)
    ),
)  # fmt: skip

_LAWS = ("printed", "literal", "open", "fixed", "dls", "guarded")
COMPARED: tuple[Case, ...] = tuple(
    Case(seam, law=law)
    for seam in ("straight", "s_r60", "l_r20_convex", "l_r5_convex", "l_r1_convex", "l_r1_concave")
    for law in _LAWS
) + tuple(
    Case(seam, gaps=gaps, law=law)
    for seam, gaps in (("straight", _GAP_25), ("s_r60", _GAP_10), ("arc_r60_end", ()))
    for law in ("fixed", "fixed_zeroed", "guarded")
)


def get_rows(names: tuple[str, ...]) -> tuple[Row, ...]:
    """The rows of those names, all when none is given.

    Raises:
        UnknownRow: naming the known ones.
    """
    known = {row.key: row for row in ROWS}
    for name in names:
        if name not in (*known, "turns", "laws"):
            raise UnknownRow(f"Unknown row '{name}'; use some of {', '.join((*known, 'turns', 'laws'))}.")
    return tuple(known[name] for name in names if name in known) if names else ROWS
