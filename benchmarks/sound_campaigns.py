"""Sound campaigns in the usual forms on every rig: is each identified, and how well does it predict another record?

    python -m benchmarks.sound_campaigns [--rigs avis ..] [--forms NAME ..] [--floor measured unmeasured] [--seed N]
                                         [--duration S] [--level PERCENT] [--folder DIR] [--out FILE.jsonl]

Each case draws a table (stiffness, mass and inertia 5 % about the rig file's, damping 20 %), plays a campaign of one
form on the nonlinear table with ambient floor, sensor noise and converter, runs `avis identify` on the file as a user
would, and `avis predict` on a record of noise that was not in the file. Printed for each: the exit code, words of
refusal, and the error of the prediction over what noise leaves, by sensor: r.m.s. of what was measured less what was
predicted, over that of what was measured less what the true table reads from rest of the same voltages and the same
measured floor. A floor that is not measured is noise. The predicted record begins at rest, as predictions do.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import h5py
import numpy as np

from avis_ctrl.errors import AvisError
from avis_ctrl.measurement.campaign import FLOOR_NAMES, Campaign, Record, RecordHeader
from avis_ctrl.measurement.excitation.design import band_limited
from avis_ctrl.measurement.formats.hdf5 import write_campaign
from avis_ctrl.rigs import load_rig
from avis_ctrl.rigs.floor_spectrum import realise, shipped_spectrum
from avis_ctrl.rigs.logical_axes import actuator_axes
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.rigs.rigid_body import COORDINATES
from avis_ctrl.simulation.campaign_data import SETTINGS as CAMPAIGN
from avis_ctrl.simulation.campaign_data import open_loop
from avis_ctrl.simulation.loop import SimulationRecord, simulate
from avis_ctrl.simulation.perturbed_campaign import perturbed_truth
from avis_ctrl.simulation.sampled_loop import SampledLoop
from avis_ctrl.study.plan_file import plan_from_table

BAND_Hz, PERIOD_s, SETTLE_s = (0.5, 80.0), 10.0, 10.0
# Words in what `avis identify` prints that a sound campaign gives no reason for.
REFUSALS = ("stop:", "warning:", "cannot be distinguished", "no measured noise", "no uncertainty.json", "not excited")


@dataclass(frozen=True)
class Form:
    """A way to record a campaign.

    signal : "multisine", "noise" or "chirp". directions : of `_directions`. apart : one record a direction, in the
    place of records that drive all of them. records : of each.
    """

    signal: str
    directions: str
    apart: bool
    records: int


FORMS = {
    "multisine": Form("multisine", "drives", False, 5),
    "noise": Form("noise", "drives", False, 4),
    "chirp": Form("chirp", "drives", True, 2),
    "single multisine": Form("multisine", "drives", True, 1),
    "single noise": Form("noise", "drives", True, 1),
    "logical multisine": Form("multisine", "axes", False, 5),
    "logical noise": Form("noise", "axes", False, 4),
    "axis multisine": Form("multisine", "axes", True, 1),
    "axis chirp": Form("chirp", "axes", True, 1),
}


@dataclass(frozen=True)
class Result:
    """One case. ratio : error over noise by sensor; relative : error over the sensor's own r.m.s. said : refusals."""

    rig: str
    form: str
    floor: str
    code: int
    seconds: float
    ratio: dict[str, float]
    relative: dict[str, float]
    said: list[str]


def _directions(rig: Rig, kind: str) -> np.ndarray:
    """(k, n_u) voltages that are played together, largest 1: each drive, or what pushes along one logical axis."""
    if kind == "drives":
        return np.eye(len(rig.equations_of_motion().actuators))
    wanted = [name for name in COORDINATES if _reached(rig, name)]
    rows = actuator_axes(rig, wanted).allocation.T
    return rows / np.max(np.abs(rows), axis=1, keepdims=True)


def _reached(rig: Rig, axis: str) -> bool:
    try:
        actuator_axes(rig, (axis,))
    except AvisError:
        return False
    return True


def _signal(kind: str, samples: int, channels: int, fs: float, rng: np.random.Generator) -> np.ndarray:
    """(samples, channels) of unit r.m.s."""
    if kind == "noise":
        return band_limited(samples, fs, BAND_Hz, channels, rng)
    if kind == "multisine":
        one = band_limited(round(PERIOD_s * fs), fs, BAND_Hz, channels, rng)
        f = np.fft.rfftfreq(len(one), 1 / fs)
        inside = (f >= BAND_Hz[0]) & (f <= BAND_Hz[1])
        flat = np.zeros((len(f), channels), complex)
        flat[inside] = np.exp(2j * np.pi * rng.random((np.count_nonzero(inside), channels)))
        one = np.fft.irfft(flat, len(one), axis=0)
        return np.resize(one / one.std(axis=0), (samples, channels))
    # Logarithmic sweep over nearly the whole record, silence behind it.
    swept = round(0.9 * samples)
    t, ratio = np.arange(swept) / fs, np.log(BAND_Hz[1] / BAND_Hz[0])
    length = swept / fs
    phase = 2 * np.pi * BAND_Hz[0] * length / ratio * (np.exp(ratio * t / length) - 1)
    fade = np.clip(np.minimum(t, length - t) / 0.5, 0, 1)
    u = np.zeros((samples, channels))
    u[:swept] = (np.sqrt(2) * np.sin(phase) * np.sin(np.pi / 2 * fade) ** 2)[:, None]
    return u * np.where(np.arange(channels) % 2, -1, 1)


def _voltages(rig: Rig, form: Form, samples: int, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """u (samples, n_u) of each record, of no particular level."""
    V, fs = _directions(rig, form.directions), rig.sample_rate_Hz
    for one in np.split(V, len(V)) if form.apart else [V]:
        for _ in range(form.records):
            u = _signal(form.signal, samples, len(one), fs, rng) @ one
            yield u / np.sqrt(np.mean(u**2, axis=0).max())


class _Bench:
    """A table that moves, its rig file, and the floor under it."""

    def __init__(self, rig: Rig, truth: Rig, measured: bool):
        ambient = {} if rig.ambient is not None else {"velocity_rms_m_per_s": 2e-6}
        plan = plan_from_table({"ambient": ambient, "record": [{"excitation": "rest"}]})
        self.rig, self.measured, self.fs = rig, measured, rig.sample_rate_Hz
        self.loop = open_loop(rig, plan).with_plant("truth", truth)
        rms = rig.ambient.floor_velocity_rms_m_per_s if rig.ambient else 2e-6
        self.ambient = shipped_spectrum("kamioka_quiet").scaled_to_rms(rms, 0.5, 60.0)

    def level(self, u: np.ndarray, percent: float) -> np.ndarray:
        """u at a share of the largest level at which neither drives nor converter clip on the rig's file."""
        converter = self.loop.sensors.converter
        limit = converter.limits_V[1] if converter else CAMPAIGN.assumed_range_V
        u = u * (self.loop.limit_V / np.max(np.abs(u)))
        quiet = replace(self.loop, plant=self.rig)
        seen = np.max(np.abs(self._run(quiet, u, 0, np.zeros((len(u) + 1, 6)), 0, False, False).sensed))
        return u * percent / 100 * min(1.0, CAMPAIGN.range_share * limit / seen)

    def record(
        self, name: str, kind: str, u: np.ndarray, start_s: float, seed: tuple[int, ...], from_rest: bool = False
    ) -> tuple[Record, np.ndarray]:
        """A record, and (samples, n_y) what the true table reads from rest of what was recorded of it.

        from_rest : the floor lies still until the record begins.
        """
        rng, settle = np.random.default_rng((*seed, 11)), round(SETTLE_s * self.fs)
        n = settle + len(u)
        floor = np.zeros((n + 1, 6))
        for axis in range(3):
            floor[:-1, axis] = realise(self.ambient, n / self.fs, 1 / self.fs, rng)
        floor[-1] = floor[-2]
        if from_rest:
            floor[:settle] = 0
        run = self._run(self.loop, u, settle, floor, int(rng.integers(2**31)), True, True)
        assert not run.diverged
        converter = self.loop.sensors.converter
        y = converter.convert(run.sensed) if converter else run.sensed
        known = floor[settle:] if self.measured else np.zeros((len(u) + 1, 6))
        ideal = self._run(self.loop, u, 0, known, 0, True, False).sensed
        h = RecordHeader(
            name,
            self.fs,
            len(u),
            self.rig.equations_of_motion().actuators,
            self.rig.sensor_rows()[0],
            "multisine" if kind == "multisine" else "noise",
            float(np.sqrt(np.mean(u[:, np.any(u, axis=0)] ** 2))),
            start_s,
            PERIOD_s if kind == "multisine" else None,
            floor_names=FLOOR_NAMES if self.measured else (),
        )
        return Record(h, u, y, floor[settle:-1, :3] if self.measured else None), ideal

    @staticmethod
    def _run(
        loop: SampledLoop, u: np.ndarray, settle: int, floor: np.ndarray, seed: int, nonlinear: bool, noisy: bool
    ) -> SimulationRecord:
        if not noisy:
            loop = replace(loop, sensors=replace(loop.sensors, noise_rms_V=np.zeros(len(loop.sensors.chains))))
        drive = np.concatenate([np.zeros((settle, u.shape[1])), u])
        return simulate(
            loop,
            len(u) / loop.sample_rate_Hz,
            seed,
            settle_s=settle / loop.sample_rate_Hz,
            nonlinear=nonlinear,
            floor=floor,
            drive=drive,
        )


def campaign(
    rig_name: str, form: Form, measured: bool, seed: int, duration_s: float, percent: float
) -> tuple[Campaign, Record, np.ndarray]:
    """A campaign of a form, a record of noise in all drives beside it, and what the truth reads of that from rest."""
    rig = load_rig(rig_name)
    bench = _Bench(rig, perturbed_truth(rig, seed=seed), measured)
    rng, samples = np.random.default_rng((seed, 7)), round(duration_s * rig.sample_rate_Hz)
    records, start = [], 0.0
    for k, u in enumerate(_voltages(rig, form, samples, rng)):
        record, _ = bench.record(f"{k:02d}", form.signal, bench.level(u, percent), start, (seed, k))
        records.append(record)
        start += duration_s + SETTLE_s
    u = _signal("noise", samples, len(rig.equations_of_motion().actuators), rig.sample_rate_Hz, rng)
    other, ideal = bench.record("00", "noise", bench.level(u, percent), 0.0, (seed, 1000), from_rest=True)
    return Campaign(rig.name, tuple(records), "sound campaign"), other, ideal


def run(
    rig_name: str,
    form: str,
    floor: str,
    seed: int,
    duration_s: float,
    percent: float,
    folder: Path,
    command: Callable[[list[str]], subprocess.CompletedProcess[str]],
) -> Result:
    """One case, end to end."""
    made, other, ideal = campaign(rig_name, FORMS[form], floor == "measured", seed, duration_s, percent)
    case = folder / f"{rig_name}_{form.replace(' ', '_')}_{floor}_{seed}"
    case.mkdir(parents=True, exist_ok=True)
    write_campaign(case / "campaign.h5", made)
    write_campaign(case / "other.h5", Campaign(made.rig, (other,), "another record"))
    began = time.monotonic()
    done = command(["identify", str(case / "campaign.h5"), "--rig", rig_name, "--out", str(case / "found")])
    seconds, text = time.monotonic() - began, done.stdout + done.stderr
    (case / "said.txt").write_text(text)
    said = [line.strip() for line in text.splitlines() if any(word in line for word in REFUSALS)]
    if done.returncode != 0:
        said += done.stderr.splitlines()[-1:]
    ratio: dict[str, float] = {}
    relative: dict[str, float] = {}
    if done.returncode == 0:
        told = command(["predict", str(case / "found"), str(case / "other.h5"), "--out", str(case / "predicted.h5")])
        if told.returncode != 0:
            return Result(rig_name, form, floor, told.returncode, seconds, ratio, relative, [*said, told.stderr])
        with h5py.File(case / "predicted.h5") as file:
            predicted = file["records/00/y"][()]
        for j, name in enumerate(other.header.y_names):
            error, noise = (np.std(other.y[:, j] - y[:, j]) for y in (predicted, ideal))
            ratio[name], relative[name] = float(error / noise), float(error / np.std(other.y[:, j]))
    return Result(rig_name, form, floor, done.returncode, seconds, ratio, relative, said)


def _command(arguments: list[str]) -> subprocess.CompletedProcess[str]:
    code = "from avis_ctrl.cli import main; main()"
    return subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rigs", nargs="+", default=["avis", "halcyonics", "halcyonics_loaded"])
    parser.add_argument("--forms", nargs="+", default=list(FORMS), choices=list(FORMS))
    parser.add_argument("--floor", nargs="+", default=["measured", "unmeasured"], choices=["measured", "unmeasured"])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--duration", type=float, default=30.0)
    parser.add_argument("--level", type=float, default=50.0, help="share of the largest level in percent")
    parser.add_argument("--folder", type=Path, help="keeps campaigns and reports")
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = asked.folder or Path(scratch)
        print(f"{'rig':18s} {'form':18s} {'floor':11s} code     s  worst error / noise   said")
        for rig in asked.rigs:
            for form in asked.forms:
                for floor in asked.floor:
                    one = run(rig, form, floor, asked.seed, asked.duration, asked.level, folder, _command)
                    worst = max(one.ratio, key=lambda name: one.ratio[name], default="")
                    print(
                        f"{rig:18s} {form:18s} {floor:11s} {one.code:4d} {one.seconds:5.0f}  "
                        + (
                            f"{one.ratio[worst]:6.2f} {worst:4s} {100 * one.relative[worst]:5.2f} %"
                            if worst
                            else " " * 19
                        )
                        + "   "
                        + " | ".join(line[:90] for line in one.said[:2]),
                        flush=True,
                    )
                    if asked.out:
                        with asked.out.open("a", encoding="utf-8") as file:
                            file.write(json.dumps(asdict(one)) + "\n")


if __name__ == "__main__":
    main()
