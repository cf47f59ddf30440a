"""Do the 95 % intervals of an identification hold the truth 95 % of the time, and are its errors as small as can be?

    python -m benchmarks.interval_coverage [--campaigns N] [--processes N] [--duration S] [--records N]

Simulated campaigns of the AVIS (nonlinear table, ambient floor that is not measured, sensor noise, quantiser): each
has its own true parameters (5 % about the rig file's, damping 20 %), records, floor and noise; the fit starts from the
rig file. Printed: how often intervals hold the truth, with Wilson's intervals, for every determined direction and for
single combinations of parameters; and r.m.s. errors over the Cramer-Rao bound. The bound comes from the true spectra
(floor through the true table, sensor noise, rounding) and not from anything the fit estimated.

The level is low on purpose. At 0.3 V the best known direction has a standard deviation of 0.5 ppm, and the geometric
nonlinearity of the simulated table moves it by as much (found without noise; --level 0.3 shows it): errors of the
linear model, which no interval of the fit holds. This grows with the square of the level, in standard deviations.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context

import numpy as np
from scipy.stats import norm
from threadpoolctl import threadpool_limits

from avis_ctrl.identification.campaign_fit import campaign_blocks, fit_campaign
from avis_ctrl.identification.information import Information
from avis_ctrl.identification.maximum_likelihood import fit
from avis_ctrl.identification.parameter_sets import default_parameters
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.rigs import load_rig
from avis_ctrl.rigs.floor_spectrum import shipped_spectrum
from avis_ctrl.rigs.isolator_table import IsolatorTable
from avis_ctrl.simulation.campaign_data import simulate_campaign
from avis_ctrl.simulation.campaign_plan import CampaignPlan

QUANTILE = float(norm.ppf(0.975))


@dataclass(frozen=True)
class Settings:
    """Small campaigns, so that many of them can be identified."""

    records: int = 4
    duration_s: float = 20.0
    level_V: float = 0.1
    band_Hz: tuple[float, float] = (0.5, 40.0)

    def plan(self) -> CampaignPlan:
        return CampaignPlan.model_validate(
            {
                "duration_s": self.duration_s,
                "band_Hz": list(self.band_Hz),
                "floor_sensor": {"recorded": False},
                "multisine": {"period_s": 10.0, "low_crest": False},
                "record": [{"excitation": "multisine", "level_V": self.level_V, "records": self.records}],
            }
        )


@dataclass(frozen=True, eq=False)
class Trial:
    """One campaign: errors in standard deviations of the fit's own covariance, and of the true bound.

    directions, combinations : (n,) error over the fit's standard deviation. bound_directions, bound_combinations :
    (n,) the same over the bound's. rank : of the fit's information. chi2 : per degree of freedom, with measured noise.
    """

    directions: np.ndarray
    bound_directions: np.ndarray
    combinations: np.ndarray
    bound_combinations: np.ndarray
    rank: int
    chi2: float
    seconds: float


def combinations(rig: IsolatorTable, names: Sequence[str]) -> dict[str, np.ndarray]:
    """What payload motion determines, from the geometry alone: body, and sums of stiffness and damping over mounts."""
    found = {name: np.eye(len(names))[names.index(name)] for name in ("mass", "J1", "J2", "J3")}
    x, y = (np.array([one.position[k] for one in rig.isolators]) for k in (0, 1))
    sums = {
        "x": {"": 1 + 0 * x, "y ": y},
        "y": {"": 1 + 0 * x, "x ": x},
        "z": {"": 1 + 0 * x, "x ": x, "y ": y, "xy ": x * y},
    }
    for kind in "kc":
        for axis, weights in sums.items():
            for word, weight in weights.items():
                row = np.zeros(len(names))
                for i, value in enumerate(weight, 1):
                    row[names.index(f"isolator{i}.{kind}_{axis}")] = value
                found[f"sum {word}{kind}_{axis}"] = row
    return found


def truth_of(rig: IsolatorTable, names: Sequence[str], rng: np.random.Generator) -> IsolatorTable:
    """5 % about the file's values, damping 20 %."""
    known = rig.parameters()
    return rig.with_parameters(
        {name: known[name].value * (1 + (0.2 if ".c_" in name else 0.05) * rng.uniform(-1, 1)) for name in names}
    )


def true_noise(model: ResponseModel, omega: np.ndarray, plan: CampaignPlan) -> np.ndarray:
    """(n, n_y, n_y) covariance of a line of a transform over sqrt(samples): floor, sensors, rounding."""
    rig = model.rig
    assert rig.ambient is not None and rig.acquisition is not None
    floor = shipped_spectrum(plan.ambient.spectrum).scaled_to_rms(
        rig.ambient.floor_velocity_rms_m_per_s, *plan.ambient.band_Hz
    )
    G = model.response(omega)[:, :, len(model.actuators) :]
    line = floor.asd(omega / (2 * np.pi), "velocity") ** 2 * rig.sample_rate_Hz / 2
    lsb = 2 * rig.acquisition.adc_range_V / 2**rig.acquisition.adc_bits
    white = rig.ambient.sensor_noise_rms_V**2 + lsb**2 / 12
    return G @ np.conj(G.swapaxes(1, 2)) * line[:, None, None] + white * np.eye(G.shape[1])


def bound(true: ResponseModel, campaign: Campaign, settings: Settings) -> Information:
    """The information that the records hold at the truth."""
    blocks, _ = campaign_blocks(campaign, true, settings.band_Hz)
    noisy = [block.with_noise(true_noise(true, block.omega, settings.plan())) for block in blocks]
    return fit(true, noisy, max_iterations=0).information


def trial(settings: Settings, seed: int) -> Trial:
    """One campaign from its seed to its errors."""
    with threadpool_limits(1):
        rig = load_rig("avis")
        assert isinstance(rig, IsolatorTable)
        names = default_parameters(rig)
        true_rig = truth_of(rig, names, np.random.default_rng([seed, 77]))
        campaign = simulate_campaign(rig, settings.plan(), seed, truth=true_rig)
        began = time.process_time()
        start = ResponseModel.of(rig, names)
        found = fit_campaign(campaign, start, settings.band_Hz, seed=seed)
        seconds = time.process_time() - began
        true = ResponseModel.of(true_rig, names)
        information, best = found.fit.information, bound(true, campaign, settings)
        error = found.fit.values - true.values
        rows = combinations(rig, names).values()
        return Trial(
            _directions(information, error),
            _directions(best, error),
            np.array([row @ error / information.of(row)[1] for row in rows]),
            np.array([row @ error / best.of(row)[1] for row in rows]),
            information.rank,
            found.first.chi2_per_dof,
            seconds,
        )


def _directions(information: Information, error: np.ndarray) -> np.ndarray:
    """Errors along the determined directions, over their standard deviations; best known first."""
    sigma, V = information.directions
    return ((V.T @ (error / information.scale)) / sigma)[information.determined]


def wilson(hits: int, trials: int, level: float = 0.95) -> tuple[float, float]:
    """Wilson's interval of a share (JASA 22, 1927, p. 209)."""
    z, p = float(norm.ppf((1 + level) / 2)), hits / trials
    middle, half = p + z**2 / (2 * trials), z * np.sqrt(p * (1 - p) / trials + z**2 / (4 * trials**2))
    return float((middle - half) / (1 + z**2 / trials)), float((middle + half) / (1 + z**2 / trials))


def run(settings: Settings, seeds: Sequence[int], processes: int = 2) -> list[Trial]:
    if processes == 1:
        return [trial(settings, seed) for seed in seeds]
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:
        return list(pool.map(partial(trial, settings), seeds))


def print_report(trials: Sequence[Trial], names: Sequence[str]) -> None:
    ranks = sorted({one.rank for one in trials})
    print(
        f"{len(trials)} campaigns; determined directions: {', '.join(map(str, ranks))}; chi-square per degree of "
        f"freedom with measured noise {np.mean([one.chi2 for one in trials]):.3f}; "
        f"{np.mean([one.seconds for one in trials]):.2f} s of processor time a fit"
    )
    n = min(ranks)
    z = {
        "direction": np.array([one.directions[:n] for one in trials]),
        "combination": np.array([one.combinations for one in trials]),
    }
    b = {
        "direction": np.array([one.bound_directions[:n] for one in trials]),
        "combination": np.array([one.bound_combinations for one in trials]),
    }
    labels = {"direction": [f"direction {k + 1}" for k in range(n)], "combination": list(names)}
    for kind in z:
        inside = np.abs(z[kind]) <= QUANTILE
        low, high = wilson(int(inside.sum()), inside.size)
        print(
            f"\nall {kind}s: {100 * inside.mean():.1f} % inside (Wilson {100 * low:.1f} to {100 * high:.1f} %), "
            f"r.m.s. error {np.sqrt(np.mean(z[kind] ** 2)):.3f} of the claimed and "
            f"{np.sqrt(np.mean(b[kind] ** 2)):.3f} of the Cramer-Rao bound"
        )
        for k, label in enumerate(labels[kind]):
            hits = int(inside[:, k].sum())
            low, high = wilson(hits, len(trials))
            print(
                f"  {label:>14s}: {100 * hits / len(trials):5.1f} % inside ({100 * low:5.1f} to {100 * high:5.1f} "
                f"%), r.m.s. error {np.sqrt(np.mean(z[kind][:, k] ** 2)):.3f} of the claimed, "
                f"{np.sqrt(np.mean(b[kind][:, k] ** 2)):.3f} of the bound, mean {np.mean(z[kind][:, k]):+.2f}"
            )


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--campaigns", type=int, default=200)
    options.add_argument("--processes", type=int, default=2)
    options.add_argument("--records", type=int, default=Settings.records)
    options.add_argument("--duration", type=float, default=Settings.duration_s)
    options.add_argument("--level", type=float, default=Settings.level_V)
    options.add_argument("--band", type=float, nargs=2, default=Settings.band_Hz)
    options.add_argument("--seed", type=int, default=1)
    given = options.parse_args()
    settings = Settings(given.records, given.duration, given.level, tuple(given.band))
    began = time.monotonic()
    trials = run(settings, range(given.seed, given.seed + given.campaigns), given.processes)
    rig = load_rig("avis")
    assert isinstance(rig, IsolatorTable)
    print_report(trials, list(combinations(rig, default_parameters(rig))))
    print(f"\n{time.monotonic() - began:.0f} s")


if __name__ == "__main__":
    main()
