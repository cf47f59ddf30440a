"""Plausibility of records before any fit: levels and resonances in comparison with the rig's model.

The model's response to the recorded voltages is compared with the recorded outputs, per sensor and third octave, as the
logarithm of the r.m.s. ratio (in decades). If the difference is larger than between any table and its rig file, single
unit errors are corrected in turn: in a gain (of all channels, one sensor, one drive), in the unit of y, and in each
kind of parameter of the rig. The error whose correction makes records and model agree is named.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.measurement.gates import Finding
from avis_ctrl.measurement.gates.excerpt import excerpt
from avis_ctrl.measurement.gates.h1 import h1, segment_length, usable
from avis_ctrl.rigs.plausible_ranges import RANGES, Range
from avis_ctrl.rigs.rig_writer import file_keys
from avis_ctrl.summary import joined


@dataclass(frozen=True)
class RecordPlausibility:
    """Criteria for records in a wrong unit; distances are mean decades of r.m.s., see `distance`.

    far : records below this distance pass (tables with any parameter off by 30 % and hidden effects stay below 0.6
        of it).
    fits, share : an error is named if its correction reduces the distance to at most `fits`, and to at most the
        fraction `share` of the previous distance.
    cap : maximum number of decades that one band contributes.
    gain_decades : gain errors that are tried. rig_factors : errors of the rig's parameters that are tried.
    coherent : multiple coherence from which the power of a band counts as response to the drives.
    records, samples, lines : maximum numbers used, for speed. octaves : width of a band.
    least_bands : minimum number of bands in which a sensor must respond to the drives for a comparison (all driven
        bands, if there are fewer): a unit error acts in all of them. If most of the response is incoherent, as with two
        clocks that differ, the level in the remaining bands is no evidence of a unit.
    hopeless : distance above which records are refused even if no single error explains them: a factor of about 30.
    rare : penalty added to the distance for an error other than three decades. scope : penalty for an error other than
        a common gain; half of it for a single channel, so that the simplest of similar errors is named.
    like_g : a factor within this many decades of 9.81 is taken for the acceleration of gravity.
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
    least_bands: int = 3
    hopeless: float = 1.5
    rare: float = 0.02
    scope: float = 0.02
    like_g: float = 0.06


SETTINGS = RecordPlausibility()
# Likely wrong field, its present value, what was probably meant; a candidate has the remaining distance in front.
Question = tuple[str, object, str]
Candidate = tuple[float, str, object, str]
# Units of the rig parameters that are tried. Factors of a channel's gain are not among them, because an error of one of
# them cannot be distinguished from an error of another.
UNITS = ("kg", "kg m^2", "N/m", "N s/m", "N m/rad", "N m s/rad")


class ImplausibleRecordsError(InputError):
    """Records that a unit error explains, or that no table similar to the rig could have produced."""


@dataclass(frozen=True, eq=False)
class RecordSpectra:
    """The recorded data, at some lines of some records.

    peak_u : (n_u,) largest voltage of each drive. peak_y : largest value of all sensors. omega : (n,) rad/s.
    U : (K, n, n_u) spectra of segments.
    power : (bands, n_y) of y over the segments, nan if it is not a response to the drives. bands : (bands, n) masks.
    """

    peak_u: np.ndarray
    peak_y: float
    omega: np.ndarray
    U: np.ndarray
    power: np.ndarray
    bands: np.ndarray

    def predicted(self, G: np.ndarray, volts: np.ndarray | None = None) -> np.ndarray:
        """(bands, n_y) power of the model's response; volts : (n_u,) factors on the drives."""
        U = self.U if volts is None else self.U * volts
        Y = np.einsum("fij,kfj->kfi", G, U)
        return self.bands @ np.sum(np.abs(Y) ** 2, axis=0)

    def decades(self, G: np.ndarray, volts: np.ndarray | None = None) -> np.ndarray:
        """(bands, n_y) recorded over predicted r.m.s. in decades; nan where there is no response."""
        predicted = self.predicted(G, volts)
        ok = np.isfinite(self.power) & (predicted > 0)
        found = np.full(self.power.shape, np.nan)
        found[ok] = 0.5 * np.log10(self.power[ok] / predicted[ok])
        return found


def distance(decades: np.ndarray) -> float:
    """Mean over sensors of the mean over bands of |decades|; nan where there is no response."""
    size = np.minimum(np.abs(decades), SETTINGS.cap)
    there = np.isfinite(size)
    columns = there.any(axis=0)
    if not columns.any():
        return float("nan")
    return float(np.mean([size[there[:, k], k].mean() for k in np.flatnonzero(columns)]))


def records_fit(
    measured: Campaign, model: ResponseModel, despite: bool, progress: Callable[[str], None]
) -> tuple[Finding, ...]:
    """`check_records`; with `despite`, implausible records are only reported as a line of progress."""
    try:
        return check_records(measured, model)
    except ImplausibleRecordsError as error:
        if not despite:
            raise InputError(
                f"{error.expected}; --despite-gates continues anyway", field=error.field, value=error.value
            ) from None
        progress(f"  stop: {error}")
        return ()


def check_records(measured: Campaign, model: ResponseModel) -> tuple[Finding, ...]:
    """Refuse records that a single unit error explains, or that no table similar to the rig could have produced.

    Returns warnings on sensors that are off by one factor in all bands; these do not stop the analysis.

    Raises ImplausibleRecordsError: one line that names the field and the likely error.
    """
    seen = record_spectra(measured)
    if seen is None:
        return ()
    errors = UnitErrors(measured, model, seen)
    before, worst = distance(errors.decades), _worst_channel(errors.decades)
    doubts = errors.doubts()
    if not (before > SETTINGS.far or worst > SETTINGS.far):
        return doubts
    said = f"the recorded y is {_as_text(errors.decades)} the y that the rig's model predicts for these voltages"
    enough = min(SETTINGS.fits, SETTINGS.share * max(before, worst))
    found = [one for one in sorted(errors.corrected(), key=lambda one: one[0]) if one[0] <= enough]
    if found:
        _, field, value, question = found[0]
        raise ImplausibleRecordsError(f"{said}; {question}", field=field, value=value)
    if before > SETTINGS.hopeless:
        raise ImplausibleRecordsError(
            f"{said}, and no single wrong unit explains it; check the units of y and u, sensitivities, gains and "
            "force constants",
            field="records",
        )
    return doubts


def _as_text(decades: np.ndarray) -> str:
    middle = [np.nanmedian(column) for column in decades.T if np.isfinite(column).any()]
    low, high = 10 ** min(middle), 10 ** max(middle)
    return f"{low:.3g} times" if high < 1.5 * low else f"{low:.3g} to {high:.3g} times"


def _worst_channel(decades: np.ndarray) -> float:
    """A value just above `far` if any channel is off by more than 1.5 decades (unit errors are three), else 0."""
    each = [np.nanmedian(np.abs(column)) for column in decades.T if np.isfinite(column).any()]
    return SETTINGS.far * 1.01 if max(each, default=0.0) > 1.5 else 0.0


def record_spectra(measured: Campaign) -> RecordSpectra | None:
    """Spectra of the first records with drive voltages; None if there are none, or too few samples."""
    kinds = ("multisine", "noise", "sine")
    driven = [one for one in measured.records if one.header.level_V > 0 or one.header.excitation in kinds]
    parts, peak_u, peak_y, length = [], np.zeros(len(measured.u_names)), 0.0, 0
    for record in driven[: SETTINGS.records]:
        seen = excerpt(record, SETTINGS.samples)
        if not seen.driven:
            continue
        samples = usable(seen)
        peak_u = np.maximum(peak_u, np.abs(samples.u).max(axis=0))
        peak_y = max(peak_y, float(np.abs(samples.y).max()))
        length = length or segment_length(len(samples.u), samples.moving)
        if len(samples.u) >= length:
            parts.append(samples.spectra(length))
    estimate = h1(parts) if parts else None
    if estimate is None:
        return None
    first = parts[0]
    lines = np.flatnonzero(np.isin(first.f, estimate.f))
    place = np.unique(np.geomspace(1, len(lines), min(SETTINGS.lines, len(lines))).astype(int) - 1)
    f = first.f[lines[place]]
    U = np.concatenate([one.U for one in parts])[:, lines[place]]
    Y = np.concatenate([one.Y for one in parts])[:, lines[place]]
    number = np.floor(np.log2(f / f[0]) / SETTINGS.octaves).astype(int)
    bands = np.array([number == k for k in np.unique(number)], float)
    coherence = bands @ estimate.coherence[place] / bands.sum(axis=1)[:, None]
    power = bands @ np.sum(np.abs(Y) ** 2, axis=0)
    responds = (coherence > SETTINGS.coherent) & (power > 0)
    responds &= responds.sum(axis=0) >= min(SETTINGS.least_bands, len(bands))
    return RecordSpectra(peak_u, peak_y, 2 * np.pi * f, U, np.where(responds, power, np.nan), bands)


@dataclass(frozen=True, eq=False)
class UnitErrors:
    """Search for the unit error that explains a difference between records and the rig's model.

    A question is (field, value, text): the likely wrong field, its present value, and what was probably meant.
    """

    measured: Campaign
    model: ResponseModel
    seen: RecordSpectra

    def response(self, model: ResponseModel) -> np.ndarray:
        """(n, n_y, n_u) response of a model to the recorded voltages, at the lines of the records."""
        return model.response(self.seen.omega)[:, :, [model.inputs.index(name) for name in self.measured.u_names]]

    @cached_property
    def G(self) -> np.ndarray:
        """Response of the rig's model."""
        return self.response(self.model)

    @cached_property
    def decades(self) -> np.ndarray:
        """(bands, n_y) recorded over predicted r.m.s., in decades."""
        return self.seen.decades(self.G)

    def doubts(self) -> tuple[Finding, ...]:
        """Warnings on sensors of one kind that measure the same multiple of the prediction in all bands."""
        kinds = {one.name: one.quantity for one in self.model.rig.sensors()}
        off: list[tuple[str, float, str]] = []
        for name, column in zip(self.measured.y_names, self.decades.T, strict=True):
            there = column[np.isfinite(column)]
            middle = float(np.median(there)) if there.size >= SETTINGS.least_bands else 0.0
            if abs(middle) > SETTINGS.far and np.median(np.abs(there - middle)) < SETTINGS.fits:
                off.append((kinds.get(name, ""), middle, name))
        alike: list[list[tuple[str, float, str]]] = []
        for one in sorted(off):
            if alike and alike[-1][0][0] == one[0] and one[1] - alike[-1][0][1] < SETTINGS.fits:
                alike[-1].append(one)
            else:
                alike.append([one])
        return tuple(map(self._doubt, alike))

    def _doubt(self, alike: list[tuple[str, float, str]]) -> Finding:
        """The warning on sensors (kind, decades, name) that are off by about the same factor."""
        decades = float(np.median([one[1] for one in alike]))
        names = tuple(name for name in self.measured.y_names if name in [one[2] for one in alike])
        gravity = alike[0][0] == "acceleration" and abs(abs(decades) - np.log10(9.80665)) < SETTINGS.like_g
        likely = " (9.81 is g: is a sensitivity given in V/g instead of V s^2/m, or the reverse?)" if gravity else ""
        return Finding(
            "units",
            "warning",
            f"The signal of {joined(names)} is {10.0**decades:.3g} times the one that the rig's model predicts for "
            f"these voltages, in all frequency bands{likely}. Check sensitivity, gain and unit before you trust the "
            "fit.",
            names,
            value=10.0**decades,
            limit=10.0**SETTINGS.far,
        )

    def corrected(self) -> Iterator[Candidate]:
        """(remaining distance, *question) for each error, as if it were corrected; the simplest first."""
        for c in SETTINGS.gain_decades:
            yield distance(self.decades - c) + _rare(c), *self._common_gain(10.0**c)
        for k, name in enumerate(self.measured.y_names):
            for c in SETTINGS.gain_decades:
                one = self.decades.copy()
                one[:, k] -= c
                yield distance(one) + SETTINGS.scope / 2, *self._sensor_gain(name, 10.0**c)
        for k, name in enumerate(self.measured.u_names):
            for c in SETTINGS.gain_decades[:2]:
                volts = np.ones(len(self.measured.u_names))
                volts[k] = 10.0**c
                question = (
                    f"did you mean {10.0**c:g} times that constant, or is u of {name} given in "
                    f"{'kV' if c > 0 else 'mV'} instead of V?"
                )
                left = distance(self.seen.decades(self.G, volts)) + SETTINGS.scope / 2
                yield left, f"force constant of {name}", None, question
        yield from self._other_units()
        yield from self._of_rig()

    def _other_units(self) -> Iterator[Candidate]:
        """Signals y in another unit, possibly with a prefix."""
        unit, model, channels = self.measured.y_unit, self.model, (self.measured.y_names, self.measured.u_names)
        for other in ("V", "m", "m/s", "m/s^2"):
            if other == unit:
                continue
            with suppress(InputError):  # a unit that these sensors do not have
                changed = ResponseModel.of(
                    model.rig, (), other, *channels, model.period_s > 0, model.amplifier_corner_Hz
                )
                decades = self.seen.decades(self.response(changed))
                for c in (0.0, 3.0, -3.0):
                    much = f" times {10.0**c:g}" if c else ""
                    yield distance(decades - c) + SETTINGS.scope, "unit of y", unit, f"did you mean {other}{much}?"

    def _of_rig(self) -> Iterator[Candidate]:
        """Errors of each key of the rig file; all its parameters have the same factor, as all moments of inertia do."""
        known, keys = self.model.rig.parameters(), file_keys(self.model.rig)
        kinds: dict[str, list[str]] = {}
        for name, parameter in known.items():
            if parameter.unit in UNITS and parameter.value:
                kinds.setdefault(keys.get(name, name).replace("_offdiagonal", ""), []).append(name)
        for field, names in kinds.items():
            for factor in SETTINGS.rig_factors:
                try:
                    rig = self.model.rig.with_parameters({name: factor * known[name].value for name in names})
                    moved = self.response(replace(self.model, rig=rig))
                except (InputError, ArithmeticError, np.linalg.LinAlgError):
                    continue
                value, decades = known[names[0]].value, float(np.log10(factor))
                much = f"{'a thousand' if abs(decades) == 3 else 'a million'} times {'more' if factor > 1 else 'less'}"
                left = distance(self.seen.decades(moved)) + SETTINGS.scope + _rare(decades)
                yield left, field, value, f"did you mean {value * factor:g} ({much})?"

    def _sensor_gain(self, name: str, factor: float) -> Question:
        sensors = self.model.sensors
        k = sensors.names.index(name)
        value = float(sensors.sensitivity[k])
        return (
            f"sensitivity of {name}",
            value,
            f"only {name} differs: did you mean {value * factor:g} {sensors.sensitivity_units[k]} (with "
            "preamplifier), or is it recorded in a different unit from the others?",
        )

    def _common_gain(self, factor: float) -> Question:
        """Question on a factor common to all channels: force constants, sensitivities, units of u and y.

        A value beyond a limit is named first, then a value that the factor would bring into the usual range.
        """
        rig, unit, seen, drives = self.model.rig, self.measured.y_unit, self.seen, self.measured.u_names
        limits, full = rig.limits_of(drives), rig.acquisition.adc_range_V if rig.acquisition else np.inf
        k = int(np.argmax(seen.peak_u / limits))
        meant = "did you mean {:.4g} V (given in mV)?"
        if factor == 1e-3 and seen.peak_u[k] > 3 * limits[k]:
            question = f"the limit of drive {drives[k]} is {limits[k]:g} V: {meant.format(seen.peak_u[k] / 1e3)}"
            return "u of the records", float(f"{seen.peak_u[k]:.4g}"), question
        if factor == 1e3 and unit == "V" and seen.peak_y > 3 * full:
            question = f"the converter's range is {full:g} V: {meant.format(seen.peak_y / 1e3)}"
            return "y of the records", float(f"{seen.peak_y:.4g}"), question
        # (change of the distance from the usual range by the factor, field, value); negative if it gets closer.
        options = [
            (within.off_centre(usual * factor) - within.off_centre(usual), field, value)
            for field, value, usual, within in self._gains()
        ]
        options.sort(key=lambda one: one[0])
        prefix = {1e3: ("m", "k"), 1e-3: ("k", "m")}.get(factor)
        records = f"is y in {prefix[0]}{unit}, or u in {prefix[1]}V, whatever unit the file states?" if prefix else ""
        if options and options[0][0] < -0.2:
            _, field, value = options[0]
            return field, value, f"did you mean {value * factor:g}{', or ' if records else '?'}{records}"
        others = "; ".join(f"{field} = {value:g} ({value * factor:g} would fit)" for _, field, value in options)
        return "unit of y or u", None, f"all channels differ by the same factor: {records} Otherwise check {others}"

    def _gains(self) -> Iterator[tuple[str, float, float, Range]]:
        """(field, value, quantity that it scales, usual range of that quantity) of each gain of all channels."""
        rig, equations = self.model.rig, self.model.rig.equations_of_motion()
        push = float(np.max(np.abs(equations.T[:3]) @ rig.drive_limits_V())) / float(equations.M[0, 0])
        if constants := [p.value for p in rig.parameters().values() if p.unit == "N/V"]:
            yield "actuators.constant_N_per_V", constants[0], push, RANGES.acceleration
        if self.measured.y_unit != "V":
            return
        for section, part, keys in (
            ("geophones", rig.geophones, ("sensitivity_Vs_per_m", "preamplifier_gain")),
            ("accelerometers", rig.accelerometers, ("sensitivity_Vs2_per_m",)),
        ):
            for key in keys:
                value = getattr(part, key, None)
                value = value[0] if isinstance(value, tuple) and value else value
                if isinstance(value, float) and value > 0:
                    yield f"{section}.{key}", value, value, RANGES.keys[key]


def _rare(decades: float) -> float:
    return SETTINGS.rare * (abs(decades) != 3)
