"""Whether records can be those of a rig at all, before any fit: levels and resonances against the rig's model.

The model's answer to the recorded voltages is compared with what was recorded, per sensor and third of an octave, as
decades of r.m.s. Where the records are off by more than any table is from its file, single slips of a unit are undone
in turn: of a gain (of all channels, one sensor, one drive), of the unit of y, and of each kind of parameter of the rig.
The one that makes the records fit is named.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.measurement.gates.excerpt import excerpt
from avis_ctrl.measurement.gates.h1 import h1, segment_length, spectra, usable
from avis_ctrl.rigs.plausible_ranges import RANGES


@dataclass(frozen=True)
class RecordPlausibility:
    """When records are taken for those of another unit; distances are mean decades of r.m.s., see `distance`.

    far : below it nothing is said (tables off by 30 % in any parameter with hidden effects stay below half of it).
    fits, share : a slip is named where undoing it leaves at most `fits`, and at most `share` of what there was.
    cap : decades at which one band counts no more.
    gain_decades : of the slips of a gain that are tried. rig_factors : of a rig's parameters.
    coherent : multiple coherence of a band from which its power is an answer to the drives.
    records, samples, lines : that are looked at, for speed. octaves : width of a band.
    hopeless : distance at which records are refused though no slip explains them: ten times and more off everywhere.
    rare : added to the distance left by a slip of other than three decades, scope : by one that is not a gain of all,
    half of it by one of a single channel, so that the plainest of like ones is named.
    rate : ratio of sample rates of records and rig from which one of them is taken for a slip.
    """

    far: float = 0.30
    fits: float = 0.15
    share: float = 0.35
    cap: float = 2.0
    gain_decades: tuple[float, ...] = (3.0, -3.0, 6.0, -6.0, 2.0, -2.0)
    rig_factors: tuple[float, ...] = (1e3, 1e-3, 1e6, 1e-6)
    coherent: float = 0.6
    records: int = 8
    samples: int = 1 << 17
    lines: int = 300
    octaves: float = 1 / 3
    hopeless: float = 1.5
    rare: float = 0.02
    scope: float = 0.02
    rate: float = 20.0


SETTINGS = RecordPlausibility()
Response = Callable[[np.ndarray], np.ndarray]
# Fields of rig files by the names of parameters; others are named as they are.
FIELDS = {"mass": "payload.mass_kg", "J": "payload.inertia_kgm2", "Ixx": "payload.inertia_kgm2",
          "Iyy": "payload.inertia_kgm2", "Izz": "payload.inertia_kgm2", "isolator.k": "isolator.stiffness_N_per_m",
          "isolator.c": "isolator.damping_Ns_per_m", "actuator": "actuators.constant_N_per_V",
          "e": "actuators.constant_N_per_V", "k_s": "suspension.k_s_N_per_m", "k_a": "suspension.k_a_N_per_m",
          "k_t": "suspension.k_t_N_per_m", "k_r": "suspension.k_r_Nm_per_rad", "d1": "suspension.d1_Ns_per_m",
          "d3": "suspension.d3_Ns_per_m", "d4": "suspension.d4_Nms_per_rad", "d5": "suspension.d5_Nms_per_rad",
          "d6": "suspension.d6_Nms_per_rad"}
# A gain of all channels enters together: no slip of one of them can be told from one of another.
UNITS = ("kg", "kg m^2", "N/m", "N s/m", "N m/rad", "N m s/rad")


@dataclass(frozen=True, eq=False)
class Seen:
    """What was recorded, at some lines of some records.

    peak_u, peak_y : largest of all drives and of all sensors. omega : (n,) rad/s. U : (K, n, n_u) spectra of segments.
    power : (bands, n_y) of y over the segments, nan where it is not an answer to the drives. bands : (bands, n) masks.
    """

    peak_u: float
    peak_y: float
    omega: np.ndarray
    U: np.ndarray
    power: np.ndarray
    bands: np.ndarray

    def predicted(self, G: np.ndarray, volts: np.ndarray | None = None) -> np.ndarray:
        """(bands, n_y) power of the model's answer; volts (n_u,) factors on the drives."""
        U = self.U if volts is None else self.U * volts
        Y = np.einsum("fij,kfj->kfi", G, U)
        return self.bands @ np.sum(np.abs(Y) ** 2, axis=0)

    def decades(self, G: np.ndarray, volts: np.ndarray | None = None) -> np.ndarray:
        """(bands, n_y) recorded over predicted, decades of r.m.s., nan where nothing answered."""
        predicted = self.predicted(G, volts)
        ok = np.isfinite(self.power) & (predicted > 0)
        found = np.full(self.power.shape, np.nan)
        found[ok] = 0.5 * np.log10(self.power[ok] / predicted[ok])
        return found


def distance(decades: np.ndarray, cap: float = SETTINGS.cap) -> float:
    """Mean over sensors of the mean over bands of |decades|; nan where nothing answered."""
    size = np.minimum(np.abs(decades), cap)
    there = np.isfinite(size)
    columns = there.any(axis=0)
    if not columns.any():
        return float("nan")
    return float(np.mean([size[there[:, k], k].mean() for k in np.flatnonzero(columns)]))


def records_fit(measured: Campaign, model: ResponseModel, despite: bool, progress: Callable[[str], None]) -> None:
    """`check_records`; where the user goes on `despite` what gates say, its complaint is a line of progress."""
    try:
        check_records(measured, model)
    except InputError as error:
        if not despite:
            raise InputError(f"{error.expected}; --despite-gates goes on all the same", field=error.field,
                             value=error.value) from None
        progress(f"  stop: {error}")


def check_records(measured: Campaign, model: ResponseModel, settings: RecordPlausibility = SETTINGS) -> None:
    """Refuse records that one slip of a unit explains, or that no table like the rig could have given.

    Raises
    ------
    InputError : one line that names the field and the likely slip.
    """
    ratio = measured.sample_rate_Hz / model.rig.sample_rate_Hz
    if not 1 / settings.rate < ratio < settings.rate:
        raise InputError(f"the rig file says {model.rig.sample_rate_Hz:g} Hz, {1 / ratio:g} times that; did you mean "
                         f"{measured.sample_rate_Hz * 1e3:g} (given in kHz)?" if ratio < 1 else
                         f"the rig file says {model.rig.sample_rate_Hz:g} Hz; was that given in kHz, or this in mHz?",
                         field="sample_rate_Hz of the records", value=measured.sample_rate_Hz)
    seen = look(measured, settings)
    if seen is None:
        return

    def response(of: ResponseModel) -> np.ndarray:
        G = of.response(seen.omega)
        return G[:, :, [of.inputs.index(name) for name in measured.u_names]]
    G = response(model)
    now = seen.decades(G)
    before = distance(now)
    worst = _worst_channel(now, settings)
    if not (before > settings.far or worst > settings.far):
        return
    found = sorted(_candidates(seen, G, now, measured, model, response, settings), key=lambda one: one[0])
    left = [one for one in found if one[0] <= settings.fits and one[0] <= settings.share * max(before, worst)]
    if left:
        _, field, value, said = left[0]
        raise InputError(f"the records are {_said(now)} what the rig's model answers to the same voltages; {said}",
                         field=field, value=value)
    if before > settings.hopeless:
        raise InputError(f"the records are {_said(now)} what the rig's model answers to the same voltages, and no "
                         "single slip of a unit explains it; check units of y and u, sensitivities, gains, force "
                         "constants", field="records")


def _said(decades: np.ndarray) -> str:
    middle = [np.nanmedian(column) for column in decades.T if np.isfinite(column).any()]
    low, high = 10 ** min(middle), 10 ** max(middle)
    return f"{low:.3g} times" if high < 1.5 * low else f"{low:.3g} to {high:.3g} times"


def _worst_channel(decades: np.ndarray, settings: RecordPlausibility) -> float:
    """A single channel that is off by itself, in the same measure as the mean over all: a slip is three decades."""
    each = [np.nanmedian(np.abs(column)) for column in decades.T if np.isfinite(column).any()]
    return settings.far * 1.01 if max(each, default=0.0) > 1.5 else 0.0


def look(measured: Campaign, settings: RecordPlausibility = SETTINGS) -> Seen | None:
    """Spectra of the first records that drive something; None where there are none, or too few samples."""
    driven = [one for one in measured.records if one.header.level_V > 0 or one.header.excitation in ("multisine",
                                                                                                      "noise", "sine")]
    parts, peak_u, peak_y = [], 0.0, 0.0
    length = 0
    for record in driven[:settings.records]:
        seen = excerpt(record, settings.samples)
        if not seen.driven:
            continue
        u, y, wrap = usable(seen)
        peak_u, peak_y = max(peak_u, float(np.abs(u).max())), max(peak_y, float(np.abs(y).max()))
        length = length or segment_length(len(u), int(np.count_nonzero(np.ptp(u, axis=0))))
        if len(u) >= length:
            parts.append(spectra(u, y, seen.header.sample_rate_Hz, length, wrap))
    estimate = h1(parts) if parts else None
    if estimate is None:
        return None
    first = parts[0]
    lines = np.flatnonzero(np.isin(first.f, estimate.f))
    place = np.unique(np.geomspace(1, len(lines), min(settings.lines, len(lines))).astype(int) - 1)
    f = first.f[lines[place]]
    U = np.concatenate([one.U for one in parts])[:, lines[place]]
    Y = np.concatenate([one.Y for one in parts])[:, lines[place]]
    number = np.floor(np.log2(f / f[0]) / settings.octaves).astype(int)
    bands = np.array([number == k for k in np.unique(number)], float)
    coherence = bands @ estimate.coherence[place] / bands.sum(axis=1)[:, None]
    power = bands @ np.sum(np.abs(Y) ** 2, axis=0)
    answered = np.where((coherence > settings.coherent) & (power > 0), power, np.nan)
    return Seen(peak_u, peak_y, 2 * np.pi * f, U, answered, bands)


Candidate = tuple[float, str, object, str]


def _candidates(seen: Seen, G: np.ndarray, now: np.ndarray, measured: Campaign, model: ResponseModel,
                response: Callable[[ResponseModel], np.ndarray], settings: RecordPlausibility) -> Iterator[Candidate]:
    """(distance left, field, value, what is asked) of each slip undone; the plainest first."""
    for c in settings.gain_decades:
        yield distance(now - c) + _rare(c, settings), *_common_gain(10.0 ** c, seen, measured, model)
    for k, name in enumerate(measured.y_names):
        for c in settings.gain_decades:
            one = now.copy()
            one[:, k] -= c
            yield distance(one) + settings.scope / 2, *_sensor_gain(name, 10.0 ** c, model)
    for k, name in enumerate(measured.u_names):
        for c in settings.gain_decades[:2]:
            volts = np.ones(len(measured.u_names))
            volts[k] = 10.0 ** c
            yield (distance(seen.decades(G, volts)) + settings.scope / 2, f"force constant of {name}", None,
                   f"did you mean {10.0 ** c:g} times that constant, or is u of {name} in "
                   f"{'kV' if c > 0 else 'mV'} where V is said?")
    for unit in ("V", "m", "m/s", "m/s^2"):
        if unit != measured.y_unit:
            try:
                other = response(ResponseModel.of(model.rig, (), unit, measured.y_names, measured.u_names,
                                                  model.period_s > 0, model.amplifier_corner_Hz))
            except InputError:
                continue
            for c in (0.0, 3.0, -3.0):
                much = f" times {10.0 ** c:g}" if c else ""
                yield (distance(seen.decades(other) - c) + settings.scope, "unit of y", measured.y_unit,
                       f"did you mean {unit}{much}?")
    yield from _of_rig(seen, model, response, settings)


def _of_rig(seen: Seen, model: ResponseModel, response: Callable[[ResponseModel], np.ndarray],
            settings: RecordPlausibility) -> Iterator[Candidate]:
    """Each kind of parameter of the rig, all of that kind together."""
    known = model.rig.parameters()
    kinds: dict[str, list[str]] = {}
    for name, parameter in known.items():
        if parameter.unit in UNITS and parameter.value:
            kinds.setdefault(_kind(name), []).append(name)
    for kind, names in kinds.items():
        for factor in settings.rig_factors:
            try:
                rig = model.rig.with_parameters({name: factor * known[name].value for name in names})
                moved = response(replace(model, rig=rig))
            except (InputError, ArithmeticError, np.linalg.LinAlgError):
                continue
            value, decades = known[names[0]].value, float(np.log10(factor))
            much = f"{'a thousand' if abs(decades) == 3 else 'a million'} times {'more' if factor > 1 else 'less'}"
            left = distance(seen.decades(moved)) + settings.scope + _rare(decades, settings)
            yield left, FIELDS.get(kind, kind), value, f"did you mean {value * factor:g} ({much})?"


def _rare(decades: float, settings: RecordPlausibility) -> float:
    return settings.rare * (abs(decades) != 3)


def _kind(name: str) -> str:
    """isolator3.k_x and isolator1.k_z are one kind, J1 .. J23 another, d1 and d3 two."""
    if re.fullmatch(r"d\d", name):
        return name
    if re.fullmatch(r"I[xyz]{2}|J\d+", name):
        return "J"
    if name.startswith("actuator."):
        return "actuator"
    return re.sub(r"_[xyz]$", "", re.sub(r"\d+", "", name))


def _common_gain(factor: float, seen: Seen, measured: Campaign, model: ResponseModel) -> tuple[str, object, str]:
    """All channels alike: force constants, sensitivities, units of u and y; what is beyond a limit first, then what
    becomes usual."""
    rig, unit = model.rig, measured.y_unit
    limit, full = rig.drive_limit_V, rig.acquisition.adc_range_V if rig.acquisition else np.inf
    if factor == 1e-3 and seen.peak_u > 3 * limit:
        return ("u of the records", float(f"{seen.peak_u:.4g}"), f"the drives' limit is {limit:g} V: did you mean "
                f"{seen.peak_u / 1e3:.4g} V (given in mV)?")
    if factor == 1e3 and unit == "V" and seen.peak_y > 3 * full:
        return ("y of the records", float(f"{seen.peak_y:.4g}"), f"the converter ends at {full:g} V: did you mean "
                f"{seen.peak_y / 1e3:.4g} V (given in mV)?")
    options: list[tuple[float, str, object, str]] = []
    mass = float(rig.equations_of_motion().M[0, 0])
    push = float(np.max(np.abs(rig.equations_of_motion().T[:3]).sum(axis=1))) * rig.drive_limit_V / mass
    constants = [p.value for p in rig.parameters().values() if p.unit == "N/V"]
    if constants:
        options.append((_gained(RANGES.acceleration, push, factor), "actuators.constant_N_per_V", constants[0],
                        f"{constants[0] * factor:g}"))
    if unit == "V":
        for part, keys in ((rig.geophones, ("sensitivity_Vs_per_m", "preamplifier_gain")),
                           (rig.accelerometers, ("sensitivity_Vs2_per_m",))):
            for key in keys if part is not None else ():
                value = getattr(part, key, None)
                value = value[0] if isinstance(value, tuple) and value else value
                if isinstance(value, float) and value > 0:
                    section = "geophones" if part is rig.geophones else "accelerometers"
                    options.append((_gained(RANGES.keys[key], value, factor), f"{section}.{key}", value,
                                    f"{value * factor:g}"))
    options.sort(key=lambda one: one[0])
    prefix = {1e3: ("m", "k"), 1e-3: ("k", "m")}.get(factor)
    records = f"are the records' y in {prefix[0]}{unit} or u in {prefix[1]}V?" if prefix else ""
    if options and options[0][0] < -0.2:
        _, field, value, meant = options[0]
        return field, value, f"did you mean {meant}{', or ' if records else '?'}{records}"
    others = "; ".join(f"{field} = {value:g} (then {meant})" for _, field, value, meant in options)
    return "unit of y or u", None, f"all channels alike: {records} Else a slip in {others}"


def _gained(within, value: float, factor: float) -> float:
    """How much further from the middle of what is usual a value goes by a factor; negative where it comes nearer."""
    return within.off_centre(value * factor) - within.off_centre(value)


def _sensor_gain(name: str, factor: float, model: ResponseModel) -> tuple[str, object, str]:
    k = model.sensors.names.index(name)
    value = float(model.sensors.sensitivity[k])
    return (f"sensitivity of {name}", value,
            f"only {name} is off: did you mean {value * factor:g} {model.sensors.sensitivity_units[k]} (with "
            "preamplifier), or are its records in another unit than the others?")
