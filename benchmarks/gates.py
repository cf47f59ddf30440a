"""How often do the gates stop a sound campaign, and how often do they find a fault that is there?

    python -m benchmarks.gates [--count N] [--first SEED] [--processes N] [--list]

Campaigns of tables that are not as their rig file says: parameters 5 % off, damping 20 %, tolerances drawn, and in most
of them one or two hidden effects, of the library or outside of it, at any strength. Four in five come from the
simulator in tests/truth, which shares no dynamics with the package; the rest (the Halcyonics, too) from the package's
own. Voltages are multisines, noise, swept sines, six logical axes, or one drive after the other; records last 6 to 16
seconds.

Each campaign is judged twice: as it is, where any stop is false, that of the check of units and levels before the gates
included; and with one fault put into it. Printed: false stops and warnings by gate, with the 95 % bound of Clopper and
Pearson, and detections by fault. A hidden converter that clips and samples that were dropped are faults that the gates
are to stop at: such campaigns are counted apart.
"""

from __future__ import annotations

import argparse
import pickle
import sys
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.signal import chirp
from scipy.stats import beta
from threadpoolctl import threadpool_limits

from avis_ctrl.errors import InputError
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.measurement.campaign import FLOOR_NAMES, Campaign, Record, RecordHeader
from avis_ctrl.measurement.gates import Finding, examine
from avis_ctrl.rigs import load_rig
from avis_ctrl.simulation.campaign_data import simulate_campaign
from avis_ctrl.simulation.campaign_plan import CampaignPlan
from avis_ctrl.simulation.perturbed_campaign import perturbed_truth
from avis_ctrl.study.identification import IdentifyOptions, start_model
from avis_ctrl.study.plausible_records import check_records
from avis_ctrl.study.record_checks import expectation

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from truth import cases, table
from truth.effect import Draw, Hidden
from truth.signals import floor_motion, multisine, noise

FORMS = {"multisine": 0.25, "noise": 0.25, "swept": 0.15, "logical axes": 0.2, "single drives": 0.15}
OWN_SHARE = 0.2  # of the campaigns that come from the package's simulator
SETTLE_S = 3.0
# The largest sample by the converter's range, so that a sound campaign does not clip.
LARGEST = 0.8


@dataclass(frozen=True)
class Outcome:
    """of : form, table, effects. faulty : what is hidden is a fault. sound, said : (severity, gate, sentence) of stops
    and warnings, before and after the fault was put in. found : whether its gate named it."""

    seed: int
    of: str
    faulty: bool
    sound: tuple[tuple[str, str, str], ...]
    fault: str
    found: bool
    said: tuple[tuple[str, str, str], ...]


def with_tolerances(plant: table.Plant, rng: np.random.Generator) -> None:
    """One draw of every tolerance of ../shared/contracts/gap.md that the truth has a number for."""
    normal = rng.standard_normal
    plant.points = plant.points + 1e-3 * normal(plant.points.shape)
    tilted = plant.sensor_n + 0.005 * normal(plant.sensor_n.shape)
    plant.sensor_n = tilted / np.linalg.norm(tilted, axis=1)[:, None]
    plant.motor, plant.S = plant.motor * (1 + 0.01 * normal(8)), plant.S * (1 + 0.01 * normal(6))
    plant.wn, plant.zn = plant.wn * (1 + 0.01 * normal(6)), plant.zn * (1 + 0.03 * normal(6))
    plant.com = plant.com + 1e-3 * normal(3)
    products = 0.2 * normal(3)
    plant.J = plant.J - np.array([[0, products[0], products[1]], [products[0], 0, products[2]], [*products[1:], 0]])


def hidden_effects(
    plant: table.Plant, rng: np.random.Generator, band: tuple[float, float], level: float, span_s: float
) -> tuple[Hidden, ...]:
    """None, one, two, or one from outside the library."""
    kind = str(rng.choice(["none", "one", "two", "outside"], p=[0.25, 0.4, 0.15, 0.2]))
    library = cases.OUTSIDE_LIBRARY if kind == "outside" else cases.LIBRARY
    names = rng.permutation(list(library))[: {"none": 0, "one": 1, "two": 2, "outside": 1}[kind]]
    found = []
    for name in map(str, names):
        strength = str(rng.choice(["faint", "clear", "gross"], p=[0.25, 0.45, 0.3]))
        pilot = table.pilot(plant, band, level)
        draw = Draw(rng, plant, pilot, pilot, strength, span_s, band)
        location, parameters, details = library[name].draw(draw)
        found.append(Hidden(name, location, parameters, strength, details))
    return tuple(found)


def voltages(
    form: str, rng: np.random.Generator, rate: float, band: tuple[float, float], inputs: np.ndarray
) -> tuple[list[np.ndarray], str, float | None]:
    """Voltages of each record (samples, 8) of r.m.s. about 1, the excitation's name, its period [s].

    inputs : (6, 8) forces and moments of one volt, by which the logical axes are dealt to the drives.
    """
    few = form in ("multisine", "noise")  # records
    periodic, period_s = form == "multisine" if few else bool(rng.random() < 0.6), 4.0 if few else 2.0
    periods = int(rng.integers(3, 5))
    samples = round(rate * (periods * period_s if periodic else rng.uniform(10, 16) if few else rng.uniform(6, 9)))
    shapes = np.eye(8) if form == "single drives" else np.linalg.pinv(inputs).T
    shapes = shapes / np.abs(shapes).max(axis=1)[:, None]

    def drawn(channels: int) -> np.ndarray:
        if periodic:
            return multisine(rng, samples, channels, round(period_s * rate), band, rate, 1.0)
        return noise(rng, samples, channels, band, rate, 1.0)

    if few:
        records = [drawn(8) for _ in range(3)]
    elif form == "logical axes" and rng.random() < 0.5:  # all axes at once
        records = [drawn(6) @ shapes for _ in range(3)]
    elif form == "swept":
        shapes = shapes if rng.random() < 0.5 else np.eye(8)
        one = round(period_s * rate) if periodic else samples
        sweep = chirp(np.arange(one) / rate, band[0], one / rate, band[1], "linear" if periodic else "logarithmic")
        records = [np.sqrt(2) * np.resize(sweep, samples)[:, None] * shape for shape in shapes]
    else:
        records = [drawn(1) * shape for shape in shapes]
    return records, "multisine" if periodic else "noise", period_s if periodic else None


def truth_campaign(seed: int) -> tuple[Campaign, str, bool]:
    """From tests/truth: campaign, what it is in words, whether what is hidden is a fault."""
    rng = np.random.default_rng((seed, 1))
    rig = cases.rig()
    rate, form = rig.sample_rate_Hz, str(rng.choice(list(FORMS), p=list(FORMS.values())))
    band = (0.5, 60.0) if rng.random() < 0.5 else (float(rng.uniform(0.3, 2)), float(rng.uniform(30, 100)))
    plant = table.draw_plant(rig, rng)
    cluttered = bool(rng.random() < 0.7)
    if cluttered:
        with_tolerances(plant, rng)
    shapes, excitation, period_s = voltages(form, rng, rate, band, table.matrices(plant)[3])
    levels = np.resize(rng.uniform(0.5, 1.2) * np.array([0.5, 0.2, 0.5]), len(shapes))
    if rng.random() < 0.5:
        levels[:] = levels[0]
    effects = hidden_effects(plant, rng, band, float(levels.max()), 400.0)
    for effect in effects:
        (cases.LIBRARY | cases.OUTSIDE_LIBRARY)[effect.name].apply(plant, effect)
    faulty = any(
        "range_V" in effect.parameters or effect.name in ("dropped_samples", "clock_rate_error") for effect in effects
    )
    slope, measured, before = float(rng.uniform(0, 1)), bool(rng.random() < 0.5), round(SETTLE_S * rate)
    records, start = [], 0.0
    for k, (shape, level) in enumerate(zip(shapes, levels, strict=True)):
        floor = floor_motion(
            np.random.default_rng((seed, 2, k)),
            before + len(shape) + 1,
            rate,
            rig.ambient.floor_velocity_rms_m_per_s,
            slope,
        ) * np.tile(np.broadcast_to(plant.floor_factor, 3), 3)
        while True:
            u, draw = level * shape, np.random.default_rng((seed, 3, k))
            y = cases.run(plant, u, floor, before, start, draw)[0]
            if np.abs(y).max() < LARGEST * rig.acquisition.adc_range_V:
                break
            level *= 0.6
        rms = float(np.sqrt(np.mean(u[:, u.any(axis=0)] ** 2)))
        header = RecordHeader(
            f"{k:02d}",
            rate,
            len(u),
            plant.motors,
            plant.sensors,
            excitation,
            rms,
            start,
            period_s,
            floor_names=FLOOR_NAMES if measured else (),
        )
        y = cases.convert(plant, y, start, draw)
        records.append(Record(header, u, y, floor[before:-1, 3:6] if measured else None))
        start += len(u) / rate + float(round(rng.uniform(10, 300)))
    said = ", ".join(f"{e.name} {e.strength}" for e in effects) or "nothing hidden"
    return Campaign("avis", tuple(records)), f"{form}{', cluttered' if cluttered else ''}: {said}", faulty


def own_campaign(seed: int) -> tuple[Campaign, str, bool]:
    """From the package's simulator, perturbed, with amplifiers that lag in some."""
    rng = np.random.default_rng((seed, 1))
    name = str(rng.choice(["avis", "halcyonics", "halcyonics_loaded"]))
    rig, kind = load_rig(name), str(rng.choice(["multisine", "noise"]))
    scheme = str(rng.choice(["zippered", "orthogonal"]))
    lag = float(rng.uniform(30, 300)) if rng.random() < 0.5 else None
    short = kind == "multisine" and scheme == "orthogonal"
    plan = CampaignPlan.model_validate(
        {
            "duration_s": 6.0 if short else 12.0,
            "settle_s": 3.0,
            "amplifier_corner_Hz": lag,
            "band_Hz": [0.5, 60.0],
            "ambient": {"velocity_rms_m_per_s": 2e-6},
            "multisine": {"period_s": 2.0, "scheme": scheme, "low_crest": False},
            "floor_sensor": {"recorded": bool(rng.random() < 0.5)},
            "record": [
                {"excitation": kind, "level_percent": percent, "records": 1 if short else 2}
                for percent in ((50.0,) if short else (40.0, 15.0))
            ],
        }
    )
    campaign = simulate_campaign(rig, plan, seed, truth=perturbed_truth(rig, seed=seed))
    return replace(campaign, rig=name), f"{name}, {kind} {scheme if kind == 'multisine' else ''}: lag {lag}", False


# Faults change records [u, y] in place and return the names of the channels that are to be named.
Signals = list[list[np.ndarray]]
Fault = Callable[[Signals, np.random.Generator, tuple[str, ...], tuple[str, ...]], set[str]]


def _pair(of: Signals, which: int, rng: np.random.Generator, names: tuple[str, ...]) -> set[str]:
    i, k = rng.permutation(len(names))[:2]
    for one in of:
        one[which][:, [i, k]] = one[which][:, [k, i]]
    return {names[i], names[k]}


def _each(
    of: Signals,
    which: int,
    rng: np.random.Generator,
    names: tuple[str, ...],
    change: Callable[[np.ndarray], np.ndarray],
) -> set[str]:
    j = int(rng.integers(len(names)))
    for one in of:
        one[which][:, j] = change(one[which][:, j])
    return {names[j]}


def _lost(of: Signals, rng: np.random.Generator) -> set[str]:
    one, count = of[int(rng.integers(len(of)))], int(rng.integers(3, 40))
    at = int(rng.uniform(0.3, 0.7) * len(one[1]))
    one[1] = np.delete(one[1], np.arange(at, at + count), axis=0)
    return set()


def _repeated(of: Signals, rng: np.random.Generator) -> set[str]:
    one, rows = of[int(rng.integers(len(of)))], 256
    at = int(rng.uniform(0.3, 0.7) * len(one[1]))
    one[1][at : at + rows] = one[1][at - rows : at]
    return set()


def _hum(x: np.ndarray) -> np.ndarray:
    return x + 0.05 * x.std() * np.sin(2 * np.pi * 50.02 * np.arange(len(x)) / 1000.0)


def _drift(of: Signals) -> set[str]:
    for one in of:
        one[1] = one[1] * np.linspace(1, 1.15, len(one[1]))[:, None]
    return set()


def _spike(of: Signals, rng: np.random.Generator, names: tuple[str, ...]) -> set[str]:
    j, y = int(rng.integers(len(names))), of[0][1]
    y[len(y) // 3, j] += 3 * y[:, j].std() + 1.0
    return {names[j]}


def _two_clocks(of: Signals, rng: np.random.Generator) -> set[str]:
    rate = float(rng.choice([-1, 1]) * np.exp(rng.uniform(np.log(2e-5), np.log(1e-3))))
    for one in of:
        t = np.arange(len(one[1]))
        one[1] = make_interp_spline(t, one[1], k=5)(np.clip(t * (1 - rate), 0, t[-1]))
    return set()


def _noise(x: np.ndarray) -> np.ndarray:
    return 1e-3 * np.random.default_rng(int(1e6 * abs(x[1])) + 1).standard_normal(len(x))


# Name: (gates of which one is to speak, fault).
FAULTS: dict[str, tuple[tuple[str, ...], Fault]] = {
    "sensors exchanged": (("channel order",), lambda of, rng, u, y: _pair(of, 1, rng, y)),
    "drives exchanged": (("channel order",), lambda of, rng, u, y: _pair(of, 0, rng, u)),
    "sensor reversed": (("polarity",), lambda of, rng, u, y: _each(of, 1, rng, y, lambda x: -x)),
    "drive reversed": (("polarity",), lambda of, rng, u, y: _each(of, 0, rng, u, lambda x: -x)),
    "sensor constant": (("dead channel",), lambda of, rng, u, y: _each(of, 1, rng, y, lambda x: 0.3 + 0 * x)),
    "sensor noise alone": (("dead channel",), lambda of, rng, u, y: _each(of, 1, rng, y, _noise)),
    "sensor clipped": (
        ("clipping",),
        lambda of, rng, u, y: _each(of, 1, rng, y, lambda x: np.clip(x, -0.6 * np.abs(x).max(), 0.6 * np.abs(x).max())),
    ),
    "samples lost": (("missing samples",), lambda of, rng, u, y: _lost(of, rng)),
    "two clocks": (("sample clock",), lambda of, rng, u, y: _two_clocks(of, rng)),
    "block repeated": (("missing samples",), lambda of, rng, u, y: _repeated(of, rng)),
    "hum": (("hum",), lambda of, rng, u, y: _each(of, 1, rng, y, _hum)),
    "drift within records": (("periodicity",), lambda of, rng, u, y: _drift(of)),
    "spike": (("spikes",), lambda of, rng, u, y: _spike(of, rng, y)),
    "one sensor 30 ms late": (
        ("missing samples", "channel order", "polarity"),
        lambda of, rng, u, y: _each(of, 1, rng, y, lambda x: np.concatenate([np.zeros(30), x[:-30]])),
    ),
}


def with_fault(campaign: Campaign, name: str, seed: int) -> tuple[Campaign, set[str]]:
    """The campaign with the fault in it, and the channels that are to be named (none where it concerns all)."""
    loaded = [record.load() for record in campaign.records]
    signals: Signals = [[one.u.copy(), one.y.copy()] for one in loaded]
    channels = FAULTS[name][1](signals, np.random.default_rng((seed, 4)), campaign.u_names, campaign.y_names)
    records = []
    for one, (u, y) in zip(loaded, signals, strict=True):
        n = min(len(u), len(y))
        records.append(
            Record(replace(one.header, samples=n), u[:n], y[:n], None if one.floor is None else one.floor[:n])
        )
    return replace(campaign, records=tuple(records)), channels


def grave(findings: tuple[Finding, ...]) -> tuple[tuple[str, str, str], ...]:
    return tuple((f.severity, f.gate, f.sentence) for f in findings if f.severity in ("warning", "stop"))


def made(seed: int, keep: Path | None) -> tuple[Campaign, str, bool]:
    """The campaign of a seed, simulated or as it was kept."""
    if keep is not None and (path := keep / f"{seed}.pickle").exists():
        found: tuple[Campaign, str, bool] = pickle.loads(path.read_bytes())
        return found
    own = np.random.default_rng((seed, 0)).random() < OWN_SHARE
    found = (own_campaign if own else truth_campaign)(seed)
    if keep is not None:
        path.write_bytes(pickle.dumps(found))
    return found


def judge(seed: int, faults: tuple[str, ...], keep: Path | None) -> Outcome | None:
    """One campaign, as it is and with a fault; None where the hidden effect makes the table unstable."""
    with threadpool_limits(1):
        try:
            campaign, words, faulty = made(seed, keep)
        except ArithmeticError:
            return None
        model = start_model(campaign, load_rig(campaign.rig), IdentifyOptions())
        known: Any = expectation(model)
        sound = (*implausible(campaign, model), *grave(examine(campaign, known)))
        fault = faults[seed % len(faults)]
        broken, channels = with_fault(campaign, fault, seed)
        findings = examine(broken, known)
        found = any(
            f.gate in FAULTS[fault][0] and f.severity in ("warning", "stop") and channels <= set(f.channels)
            for f in findings
        )
        return Outcome(seed, words, faulty, sound, fault, found, grave(findings))


def implausible(campaign: Campaign, model: ResponseModel) -> tuple[tuple[str, str, str], ...]:
    """The error that the check of units and levels before the gates raises, as a stop; empty where it raises none."""
    try:
        check_records(campaign, model)
    except InputError as error:
        return (("stop", "units", str(error)),)
    return ()


def bound(k: int, n: int) -> float:
    """Upper 95 % bound of a share of which k of n were seen (Clopper and Pearson, one-sided)."""
    return float(beta.ppf(0.95, k + 1, n - k)) if k < n else 1.0


def report(outcomes: list[Outcome]) -> str:
    """False alarms by gate, detections by fault."""
    n = len(outcomes)
    lines = [f"{n} campaigns; false stops of those without a fault:"]
    plain = [o for o in outcomes if not o.faulty]
    stopped = [o for o in plain if any(s == "stop" for s, _, _ in o.sound)]
    share, most = len(stopped) / max(len(plain), 1), bound(len(stopped), len(plain))
    lines.append(
        f"  any gate          {len(stopped):4d} of {len(plain)} = {100 * share:.2f} %,"
        f" surely (95 %) below {100 * most:.2f} %"
    )
    for severity in ("stop", "warning"):
        count = Counter(gate for o in plain for gate in {g for s, g, _ in o.sound if s == severity})
        lines += [f"  {severity:8s} {gate:18s} {k:4d}" for gate, k in sorted(count.items())]
    broken = [o for o in outcomes if o.faulty]
    told = sum(any(g in ("clipping", "missing samples") for _, g, _ in o.sound) for o in broken)
    lines.append(f"hidden faults (clipping, dropped samples): {len(broken)} campaigns, named in {told}")
    lines.append("fault                    found of")
    for fault in FAULTS:
        of = [o for o in outcomes if o.fault == fault]
        if of:
            lines.append(f"  {fault:22s} {sum(o.found for o in of):4d} {len(of):4d}")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--first", type=int, default=1, help="seed of the first campaign")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--faults", default=",".join(FAULTS), help="put in by turns")
    parser.add_argument("--keep", type=Path, help="folder of campaigns that were simulated before (5 MB each)")
    parser.add_argument("--list", action="store_true", help="every false stop and every fault that was missed")
    given = parser.parse_args()
    faults = tuple(given.faults.split(","))
    with ProcessPoolExecutor(given.processes, mp_context=get_context("spawn")) as pool:
        outcomes = []
        for o in pool.map(
            partial(judge, faults=faults, keep=given.keep), range(given.first, given.first + given.count)
        ):
            if o is None:
                print("one campaign is left out: its table is unstable", flush=True)
                continue
            outcomes.append(o)
            if given.list:
                for s, gate, sentence in o.sound:
                    print(f"seed {o.seed} ({o.of}): false {s} {gate}: {sentence}", flush=True)
                if not o.found:
                    print(f"seed {o.seed} ({o.of}): missed {o.fault}; said {o.said}", flush=True)
    print(report(outcomes))


if __name__ == "__main__":
    main()
