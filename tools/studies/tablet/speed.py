"""Times each tablet calibration: closed form, PnP, the paper's stages, and the published search."""

from collections.abc import Mapping

from weldcal.calibration.tablet.planar_fit import PlanarConfig, fit_linear, fit_planar, solve_closed_form, touched_rays
from weldcal.calibration.tablet.published import PUBLISHED_EVALUATIONS, tablet_stage1, tablet_stage2
from weldcal.tools.cli.options import Call, command
from weldcal.tools.console import Progress
from weldcal.tools.report.files import write_json
from weldcal.tools.studies.tablet.study import evaluation_seconds, median_seconds
from weldcal.tools.worlds.tablet import published_touches, simulate_trial


@command("benchmark tablet", short_help="Time the tablet calibrations and the published search.")
def tablet(call: Call) -> Mapping[str, object]:
    """Time each tablet calibration and compare it with the published search."""
    folder = call.folder("benchmark", "tablet")
    found = times(call.seed, call.progress)
    write_json(folder / "benchmark.json", found)
    return found


def times(seed: int, progress: Progress) -> dict[str, object]:
    """Time every calibration on the published data (closed form also on a simulated trial)."""
    touches = published_touches()
    progress("closed form", 0.0)
    rays, hand, theta = touched_rays(touches).T.copy(), touches.hand_m.T.copy(), touches.theta_rad
    closed = median_seconds(lambda: solve_closed_form(rays, hand, theta), 5000)
    trial = simulate_trial((seed, 0)).touches
    other = touched_rays(trial).T.copy(), trial.hand_m.T.copy(), trial.theta_rad
    simulated = median_seconds(lambda: solve_closed_form(*other), 5000)
    checked = median_seconds(lambda: fit_linear(touches), 500)
    progress("PnP", 0.3)
    config = PlanarConfig(free_scale=True)
    planar = median_seconds(lambda: fit_planar(touches, config, leave_one_out=False), 100)
    progress("two stages", 0.5)
    stage1 = tablet_stage1(touches)
    two_stages = median_seconds(lambda: tablet_stage2(touches, tablet_stage1(touches).parameters), 3)
    alone, crowd = evaluation_seconds(touches)
    published = PUBLISHED_EVALUATIONS * alone
    return {
        "state": "done",
        "closed_form_us": 1e6 * closed,
        "closed_form_simulated_us": 1e6 * simulated,
        "closed_form_checked_us": 1e6 * checked,
        "pnp_us": 1e6 * planar,
        "two_stages_s": two_stages,
        "stage_1_evaluations": stage1.evaluations,
        "evaluation_us": 1e6 * alone,
        "evaluation_in_crowd_us": 1e6 * crowd,
        "published_search_extrapolated_s": published,
        "published_search_in_crowds_extrapolated_s": PUBLISHED_EVALUATIONS * crowd,
        "closed_form_times_faster": published / closed,
        "two_stages_times_faster": 2.0 * published / two_stages,
        "closed_form_in_evaluations": closed / alone,
    }
