"""Measurement campaigns of a table in every usual form, written as `avis-campaign` HDF5 files.

Forms, each of them a fit for a sound campaign:

- `multisine`: one record per drive, orthogonal random-phase multisines on all drives at once (phases shifted by a
  Fourier matrix);
- `zippered`: one record, each drive has its own lines of one multisine;
- `logical`: one record per logical axis, a multisine through the least-squares distribution over the drives;
- `logical_noise`: one record, band-limited noise through all logical axes at once;
- `noise`: one record, independent band-limited noise on all drives;
- `single`: one record per drive, a multisine on it alone, the others silent;
- `sweep`: one record per drive, a logarithmic swept sine on it alone (written as `noise`, the word of the contract for
  what is not periodic).

Each campaign also holds a record at rest and, last, a record of independent noise that is not meant for the fit.
Logical axes are those of the nominal table: nobody knows the true one.
"""

import math
import os
import sys
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from .physics import State, Table, drive_matrix, floor_motion, simulate
from .tables import NOMINAL, modes, truth


@dataclass(frozen=True)
class Settings:
    """How long, how wide and how strong; the level is set by the sensors."""

    period_s: float = 20.0  # of a multisine; lines 0.05 Hz apart resolve a mode of 1.5 Hz and 2 %
    periods: int = 3  # the first holds the transient
    noise_s: float = 120.0
    sweep_s: float = 80.0
    rest_s: float = 40.0
    validation_s: float = 60.0
    settle_s: float = 15.0  # of ambient motion before each record
    low_Hz: float = 0.5
    high_over_highest_mode: float = 5.0  # upper end of the band, at most a fifth of the sample rate
    sensor_share: float = 0.4  # largest sensor voltage over the converter's range
    drive_share: float = 0.8  # largest drive voltage over its limit
    floor_noise_m_per_s: float = 2e-8  # r.m.s. of the measured floor velocity's own noise


def band(table: Table, settings: Settings) -> tuple[float, float]:
    """Excited band in Hz."""
    high = settings.high_over_highest_mode * modes(table)[0].max()
    return settings.low_Hz, min(high, 0.2 * table.sample_rate_Hz)


def logical_axes(table: Table) -> np.ndarray:
    """(drives, axes) volts per logical axis, largest volt 1: least-squares distribution onto x, y, z and the turns.

    Of the nominal table, if there is one of that name. An axis that the drives do not reach is left out.
    """
    table = NOMINAL[table.name]() if table.name in NOMINAL else table
    T = drive_matrix(table)
    size = np.array([1.0] * 3 + [0.5] * 3)  # half a metre of arm: a newton metre beside a newton
    inverse = np.linalg.pinv(T / size[:, None], rcond=0.05)
    reached = np.linalg.norm((T / size[:, None]) @ inverse, axis=0) > 0.5
    L = inverse[:, reached]
    return L / abs(L).max(axis=0)


def _spectral(samples, lines, phases) -> np.ndarray:
    """(samples, n) periodic signals of r.m.s. 1 with the given line numbers and phases (lines, n)."""
    spectrum = np.zeros((samples // 2 + 1, phases.shape[1]), complex)
    spectrum[lines] = np.exp(1j * phases)
    signal = np.fft.irfft(spectrum, samples, axis=0)
    return signal / np.maximum(signal.std(axis=0), 1e-300)


def _lines(samples, table, settings):
    low, high = band(table, settings)
    step = table.sample_rate_Hz / samples
    return np.arange(math.ceil(low / step), math.floor(high / step) + 1)


def _noise(seconds, n, table, settings, rng):
    samples = round(seconds * table.sample_rate_Hz)
    lines = _lines(samples, table, settings)
    return _spectral(samples, lines, 2 * np.pi * rng.random((len(lines), n)))


def _periodic(samples, n, table, settings, rng, zippered=False):
    lines = _lines(samples, table, settings)
    phases = 2 * np.pi * rng.random((len(lines), n))
    if not zippered:
        return _spectral(samples, lines, phases)
    return np.hstack([_spectral(samples, lines[k::n], phases[k::n, k : k + 1]) for k in range(n)])


def _sweep(table, settings):
    """Logarithmic sweep over the band and back to silence, starting and ending smoothly."""
    n = round(settings.sweep_s * table.sample_rate_Hz)
    low, high = band(table, settings)
    t = np.arange(n) * table.dt
    rate = math.log(high / low) / settings.sweep_s
    signal = np.sin(2 * np.pi * low * np.expm1(rate * t) / rate)
    edge = np.minimum(1.0, np.minimum(t, settings.sweep_s - t) / 1.0)
    return (signal * np.sin(0.5 * np.pi * edge) ** 2)[:, None]


def excitations(table: Table, form: str, settings: Settings, rng) -> list[tuple[str, np.ndarray, float | None]]:
    """Records of a form: (word of the contract, commands (N, drives) not yet scaled, period in s or None)."""
    nd = len(table.drives)
    samples = round(settings.period_s * table.sample_rate_Hz)
    one = np.eye(nd)

    def repeat(u):
        return "multisine", np.tile(u, (settings.periods, 1)), settings.period_s

    if form == "multisine":
        lines = _lines(samples, table, settings)
        phases = 2 * np.pi * rng.random((len(lines), nd))
        k = np.arange(nd)
        return [repeat(_spectral(samples, lines, phases + 2 * np.pi * r * k / nd)) for r in range(nd)]
    if form == "zippered":
        return [repeat(_periodic(samples, nd, table, settings, rng, zippered=True))]
    if form == "logical":
        L = logical_axes(table)
        return [repeat(_periodic(samples, 1, table, settings, rng) @ L[:, [k]].T) for k in range(L.shape[1])]
    if form == "logical_noise":
        L = logical_axes(table)
        return [("noise", _noise(settings.noise_s, L.shape[1], table, settings, rng) @ L.T, None)]
    if form == "noise":
        return [("noise", _noise(settings.noise_s, nd, table, settings, rng), None)]
    if form == "single":
        return [repeat(_periodic(samples, 1, table, settings, rng) @ one[[k]]) for k in range(nd)]
    if form == "sweep":
        return [("noise", _sweep(table, settings) @ one[[k]], None) for k in range(nd)]
    raise ValueError(f"form '{form}': one of {', '.join(FORMS)}")


FORMS = ("multisine", "zippered", "logical", "logical_noise", "noise", "single", "sweep")


def scale(table: Table, u: np.ndarray, settings: Settings) -> float:
    """Factor on `u` that brings the strongest sensor (or drive) to its share; one try, the table is linear enough."""
    trial = 0.01 * u / max(abs(u).max(), 1e-300)
    y = simulate(table, trial, quantise=False).y
    worst = max(abs(y).max() / (settings.sensor_share * table.adc_range_V), 1e-300)
    drives = (abs(trial) / (settings.drive_share * table.limits)).max()
    return 0.01 / max(abs(u).max(), 1e-300) / max(worst, drives)


def record(table: Table, u: np.ndarray, settings: Settings, rng, floor_rms: float | None = None, shares: bool = False):
    """One record after `settle_s` of ambient motion: y (N, sensors) V, floor velocity (N, 3) m/s, noise shares.

    Shares (asked for): per sensor, in percent of its r.m.s., what the best prediction from the commands alone and from
    commands and floor leaves: ambient motion, sensor noise and converter.
    """
    before = round(settings.settle_s * table.sample_rate_Hz)
    rms = table.floor_velocity_rms_m_per_s if floor_rms is None else floor_rms
    floor = floor_motion(before + len(u), table.dt, rms, rng)
    state = State.rest(table)
    simulate(table, np.zeros((before, len(table.drives))), floor=floor[: before + 1], state=state)
    quiet = state.copy()
    y = simulate(table, u, floor=floor[before:], state=state, rng=rng).y
    velocity = floor[before:-1, 6:9] + settings.floor_noise_m_per_s * rng.standard_normal((len(u), 3))
    left = {}
    if shares:
        alone = simulate(table, u, quantise=False).y
        known = simulate(table, u, floor=floor[before:], state=quiet, quantise=False).y
        for name, best in (("commands", alone), ("commands_and_floor", known)):
            left[name] = (100 * (y - best).std(axis=0) / y.std(axis=0)).round(3).tolist()
    return y, velocity, left


def write_campaign(
    table: Table,
    form: str,
    path,
    *,
    seed: int,
    floor_measured: bool = False,
    settings: Settings | None = None,
    floor_record_rms_m_per_s: float | None = None,
    rig: str | None = None,
) -> list[dict]:
    """Simulate a campaign and write it whole; returns one line per record (excitation, level, largest volts).

    The last line, of the validation record, has `left_by_noise_percent`: what no model can predict of each sensor.

    `floor_record_rms_m_per_s`: also a record with the floor shaken so strongly, drives silent. `rig`: name in the file,
    the table's if not given.
    """
    s = settings or Settings()
    rng = np.random.default_rng(seed)
    plan = [(word, scale(table, u, s) * u, period, None) for word, u, period in excitations(table, form, s, rng)]
    silent = np.zeros((round(s.rest_s * table.sample_rate_Hz), len(table.drives)))
    plan.append(("rest", silent, None, None))
    if floor_record_rms_m_per_s is not None:
        plan.append(("floor", silent, None, floor_record_rms_m_per_s))
    u = _noise(s.validation_s, len(table.drives), table, s, rng)
    plan.append(("noise", scale(table, u, s) * u, None, None))
    path = Path(path)
    partial = path.with_name(path.name + ".partial")
    told, start = [], 0.0
    with h5py.File(partial, "w") as file:
        file.attrs.update(format="avis-campaign", version=1, rig=rig or table.name)
        for k, (word, u, period, floor_rms) in enumerate(plan):
            y, velocity, left = record(table, u, s, rng, floor_rms, shares=k == len(plan) - 1)
            driven = u[:, abs(u).max(axis=0) > 0]
            level = float(driven.std()) if driven.size else 0.0
            group = file.create_group(f"records/{k:02d}")
            group.attrs.update(sample_rate_Hz=table.sample_rate_Hz, excitation=word, level_V=level, start_s=start)
            if period is not None:
                group.attrs["period_s"] = period
            entries = [("u", u, [d.name for d in table.drives], "V"), ("y", y, [d.name for d in table.sensors], "V")]
            if floor_measured:
                entries.append(("floor", velocity, ["vx", "vy", "vz"], "m/s"))
            for name, data, names, unit in entries:
                data_set = group.create_dataset(name, data=data, compression="gzip", compression_opts=1)
                data_set.attrs.update(names=names, unit=unit)
            start += len(u) * table.dt + s.settle_s
            told.append({"record": f"{k:02d}", "excitation": word, "seconds": len(u) * table.dt, "level_V": level})
            told[-1] |= {"largest_u_V": float(abs(u).max()), "largest_y_V": float(abs(y).max())}
            told[-1] |= {"left_by_noise_percent": left} if left else {}
    os.replace(partial, path)
    return told


if __name__ == "__main__":
    if len(sys.argv) not in (4, 5, 6):
        sys.exit("usage: campaign TABLE FORM FILE [SEED] [floor]   forms: " + ", ".join(FORMS))
    number = int(sys.argv[4]) if len(sys.argv) > 4 else 1
    for line in write_campaign(
        truth(sys.argv[1], number), sys.argv[2], sys.argv[3], seed=number, floor_measured="floor" in sys.argv[5:]
    ):
        print(line)
