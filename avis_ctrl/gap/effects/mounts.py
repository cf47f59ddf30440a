"""Effects of the mounts that a model may lack: relaxation, loss, internal mass, leveling, friction, amplitude, time."""

from __future__ import annotations

from functools import partial
from itertools import product

import numpy as np

from avis_ctrl.gap.dahl import dahl
from avis_ctrl.gap.effects.base import SETTINGS as LIBRARY
from avis_ctrl.gap.effects.base import Added, Effect, EffectParameter, Reported, Table, Values, register, shares, uneven
from avis_ctrl.gap.effects.impedance import peaks, project
from avis_ctrl.gap.effects.sensors import sprung
from avis_ctrl.gap.operators import Operators, mount_geometry
from avis_ctrl.gap.record_motion import RecordMotion
from avis_ctrl.gap.score import Score, reduction, symmetric_coordinates
from avis_ctrl.gap.starting_values import SETTINGS, Seed
from avis_ctrl.rigs.rig import Rig


def has_mounts(model: Table) -> bool:
    """Whether the rig has named stiffness and damping parameters of its mounts."""
    return "isolator1.k_z" in model.rig.parameters()


def vertical(rig: Rig) -> np.ndarray:
    """(n_g,) mask of the vertical mount rows."""
    return mount_geometry(rig).along("z")


class OfMounts(Effect):
    """An effect of mounts that have named stiffness and damping parameters."""

    at: tuple[str, ...] = ("isolators z",)

    def places(self, model: Table) -> tuple[str, ...]:
        return self.at if has_mounts(model) else ()


@register
class MountRelaxation(OfMounts):
    """Vertical stiffness k (1 + r s tau/(1 + s tau)): a Maxwell branch, or a second chamber behind an orifice."""

    name = "mount_relaxation"
    title = "the vertical stiffness of the mounts rises with frequency (a second chamber, a Maxwell branch)"
    looks_like = "vertical resonances higher and more damped than the low frequencies suggest"
    holds_states = True

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        corners = (0.3, 0.8, 1.5, 2.5, 4.0, 7.0, 15.0, 40.0)
        return (
            EffectParameter("stiffness_ratio", "1", "stiffness of the branch over that at rest", 0.0, 0.0, 20.0, 0.1),
            EffectParameter.shape("corner_Hz", "Hz", "above which the branch acts", 0.02, 300.0, 1.0, corners),
        )

    def change(self, ops: Operators, place: str, values: Values) -> None:
        x = ops.s / (2 * np.pi * values["corner_Hz"])
        branch = values["stiffness_ratio"] * x / (1 + x)
        ops.stiffness_factor = ops.stiffness_factor + branch[:, None] * vertical(ops.base.rig)
        rows = mount_geometry(ops.base.rig).payload[vertical(ops.base.rig)].T
        ops.decays.append(rows / (ops.s + 2 * np.pi * values["corner_Hz"])[:, None, None])


@register
class StructuralDamping(OfMounts):
    """Loss nearly independent of frequency in every mount.

    causal : k (s/w_ref)^a, loss factor tan(pi a/2) at every frequency, with the rise of stiffness that causality
    requires. complex : k (1 + j eta), the textbook constant, which no passive element has at all frequencies. In their
    place a rig file states viscous damping: k and c that are equal to each law at the suspension resonances.
    """

    name = "structural_damping"
    title = "besides viscous damping, the mounts have a loss that hardly depends on frequency"
    looks_like = "more damping at low resonances and less at high ones than with dashpots"
    at = ("isolators/causal", "isolators/complex")
    always_possible = True
    viscous = " viscous"  # suffix of a place: its law in a rig file

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        return (EffectParameter("loss_factor", "1", "loss factor of the mounts", 0.0, 0.0, 1.0, 0.05),)

    def instead(self, place: str) -> str:
        return place + self.viscous

    def change(self, ops: Operators, place: str, values: Values) -> None:
        law, eta = place.removesuffix(self.viscous), values["loss_factor"]

        def factor(s: np.ndarray) -> np.ndarray:
            if law.endswith("complex"):
                return np.full(len(s), 1 + 1j * eta)
            return np.asarray((s / (2 * np.pi * LIBRARY.loss_Hz)) ** (2 / np.pi * np.arctan(eta)))

        if place.endswith(self.viscous):
            w = ops.mounts.resonances(ops.base.matrices.M)
            at_resonance = factor(1j * w)
            ops.stiffness_factor = ops.stiffness_factor * (at_resonance.real + ops.s[:, None] / w * at_resonance.imag)
        else:
            ops.stiffness_factor = ops.stiffness_factor * factor(ops.s)[:, None]


@register
class MountSurge(OfMounts):
    """A mass inside every vertical mount, between two springs in series that together have the mount's stiffness.

    Frequency and damping ratio are those of the mass with payload and chassis fixed. Both springs have the same loss;
    the mount's own dashpot is in parallel with them. The mounts' frequencies may differ about their mean.
    """

    name = "mount_surge"
    title = "an internal resonance of the mounts (mass of spring, diaphragm or piston)"
    looks_like = "a resonance far above those of the suspension, equal in all vertical channels"
    holds_states = True
    resonant = True

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        count, shape = int(np.sum(vertical(model.rig))), EffectParameter.shape
        grid, share = np.geomspace(*SETTINGS.surge_Hz), "of the mount's compliance between mass and payload"
        return (
            shape("frequency_Hz", "Hz", "of the mass inside the mounts", 4.0, 400.0, 20.0, grid, none=np.inf),
            shape("payload_share", "1", share, 0.05, 0.95, 0.2, (0.5,), optional=True, none=0.5),
            shape("damping_ratio", "1", "of that resonance", 0.0, 1.0, 0.05, (0.015, 0.05, 0.15), optional=True),
            *uneven(range(1, count), "relative deviation of the frequency of mount {} from the mean", 0.2),
        )

    def seeds(self, score: Score, place: str) -> list[Seed]:
        """Seeds over frequency and damping: to first order the mass is a sprung mass on the payload at the mount."""
        rig = score.model.rig
        rows = mount_geometry(rig).payload[vertical(rig)]
        units = symmetric_coordinates(rows[:, :, None] * rows[:, None, :])
        tried = [
            *product(np.geomspace(*SETTINGS.surge_Hz).tolist(), SETTINGS.dampings),
            *product(peaks(score), SETTINGS.peak_dampings),
        ]
        found = []
        for f, zeta in tried:
            G, b = project(score, partial(sprung, frequency_Hz=f, damping=zeta), ("sprung", f, zeta))
            took = reduction(units @ G @ units.T, units @ b)
            if np.sum(took.coefficients) > 0:
                values = (f, 0.5, max(zeta, SETTINGS.least_surge_damping), *np.zeros(len(units) - 1))
                found.append(Seed(tuple(map(float, values)), took.chi2, len(units), len(tried)))
        return sorted(found, key=lambda seed: -seed.chi2)

    def change(self, ops: Operators, place: str, values: Values) -> None:
        up = vertical(ops.base.rig)
        ops.internal_omega[up] = surge_omega(values)
        ops.payload_share = np.where(up, values["payload_share"], ops.payload_share)
        ops.internal_damping = np.where(up, values["damping_ratio"], ops.internal_damping)

    def reported(self, model: Table, place: str, values: Values, covariance: np.ndarray) -> dict[str, Reported]:
        """Means over the mounts. Their standard deviations include the scatter between the mounts, which a single value
        does not describe. That of the mass follows from frequency, payload_share and scatter; the mean stiffness is
        taken as exact."""
        found = super().reported(model, place, values, covariance)
        k = mount_geometry(model.effective.rig).stiffness[vertical(model.rig)]
        f, a, w = values["frequency_Hz"], values["payload_share"], surge_omega(values)
        m = k / (a * (1 - a) * w**2)
        slope = np.zeros(len(values))
        slope[:2] = -2 * np.mean(m) / f, -np.mean(m) * (1 - 2 * a) / (a * (1 - a))
        variance = float(slope @ covariance @ slope) + _of_mean(m)
        mass = Reported(float(np.mean(m)), float(np.sqrt(max(variance, 0.0))), "kg")
        own = found.pop("frequency_Hz")
        frequency = Reported(own.value, float(np.sqrt(own.std**2 + _of_mean(w / (2 * np.pi)))), "Hz")
        return {"frequency_Hz": frequency, "mass_kg": mass, **found}


def _of_mean(values: np.ndarray) -> float:
    """Variance of the mean of scattered values."""
    return float(np.var(values, ddof=1) / len(values)) if len(values) > 1 else 0.0


def surge_omega(values: Values) -> np.ndarray:
    """(mounts,) resonance frequency inside each mount [rad/s]."""
    return 2 * np.pi * values["frequency_Hz"] * shares(values)


@register
class LevelingLoop(OfMounts):
    """Leveled mounts k (1 + w/s), w = 2 pi rate; with a lag of the valves k (1 + w/(s (1 + s tau))); or a different
    rate for each mount.

    A valve admits air at a rate that depends on the height of the payload above the chassis. The force of this air is
    proportional to the mount's own stiffness.
    """

    name = "leveling_loop"
    title = "leveling valves integrate the height at isolators 1-3"
    looks_like = "phase and gain change at the lowest frequencies, vertical and tilting channels only"
    at = ("isolators 1-3 z/plain", "isolators 1-3 z/lag", "isolators 1-3 z/each")
    holds_states = True

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        # A rate above the decay rate of the best damped mode makes the loop unstable; a measured table is stable.
        fastest = max(2 * fastest_decay(model) / (2 * np.pi), 0.1)
        rate = EffectParameter("rate_Hz", "Hz", "of the integrator, over 2 pi", 0.0, 0.0, fastest, 0.02)
        if place.endswith("plain"):
            return (rate,)
        if place.endswith("each"):
            return (rate, *uneven(range(1, LIBRARY.leveled), "relative deviation of valve {} from the mean rate"))
        # A valve may be faster than the data can show; its corner then ends at the upper bound.
        low, high, grid = *LIBRARY.valve_Hz, (0.1, 0.3, 1.0, 3.0)
        lag = "first-order lag of the valves"
        return (rate, EffectParameter.shape("valve_corner_Hz", "Hz", lag, low, high, 1.0, grid, optional=True))

    def implausible(self, values: Values, std: Values) -> str:
        slow = values.get("valve_corner_Hz", np.inf) < 1.001 * LIBRARY.valve_Hz[0]
        return "valves so slow that the loop does not level" if slow else ""

    def change(self, ops: Operators, place: str, values: Values) -> None:
        ratio = 2 * np.pi * values["rate_Hz"] / ops.s
        if "valve_corner_Hz" in values:
            ratio = ratio / (1 + ops.s / (2 * np.pi * values["valve_corner_Hz"]))
        own = leveled(ops.base.rig)
        each = np.zeros(len(own))
        each[own] = shares(values)
        ops.stiffness_factor = ops.stiffness_factor + ratio[:, None] * each
        # Each integrator has an initial force of its own, each valve an initial opening.
        rows = mount_geometry(ops.base.rig).payload[own].T
        ops.decays.append(rows / ops.s[:, None, None])
        if "valve_corner_Hz" in values:
            ops.decays.append(rows / (ops.s + 2 * np.pi * values["valve_corner_Hz"])[:, None, None])

    def reported(self, model: Table, place: str, values: Values, covariance: np.ndarray) -> dict[str, Reported]:
        """With the mean force per displacement and second over the leveled mounts, at their fitted stiffness."""
        found = super().reported(model, place, values, covariance)
        rate, g = found["rate_Hz"], mount_geometry(model.rig)
        by_rate = 2 * np.pi * float(np.mean(g.stiffness[leveled(model.rig)]))
        if values.get("valve_corner_Hz", 0.0) > 0.999 * LIBRARY.valve_Hz[1]:
            del found["valve_corner_Hz"]
        return {**found, "integral_gain_N_per_ms": Reported(by_rate * rate.value, by_rate * rate.std, "N/(m s)")}


def leveled(rig: Rig) -> np.ndarray:
    """(n_g,) which mount rows the leveling acts on: the first three vertical ones."""
    up = vertical(rig)
    return up & (np.cumsum(up) <= LIBRARY.leveled)


@register
class CubicStiffness(OfMounts):
    """Force -k3 d^3 at every vertical mount, or -(k2 d^2 + k3 d^3 + k5 d^5). Mounts may differ in k3 about their mean;
    the other two coefficients then differ by the same factors."""

    name = "cubic_stiffness"
    title = "the mounts stiffen with amplitude"
    looks_like = "the frequencies of vertical resonances rise with the level, and third harmonics appear"
    at: tuple[str, ...] = ("isolators z", "isolators z/polynomial")
    nonlinear = True

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        others = (stiffness(model, 2, "quadratic"), stiffness(model, 5, "quintic")) if "/" in place else ()
        return (
            stiffness(model, 3, "cubic"),
            *others,
            *uneven(range(1, int(np.sum(vertical(model.rig)))), "relative deviation of mount {} from the mean"),
        )

    def force(self, record: RecordMotion, place: str, values: Values) -> np.ndarray | None:
        d = record.deflection[:, record.vertical]
        return stiffened(sum(values[name] * d**n for n, name in powers(values)), record, values)

    def spectra(self, record: RecordMotion, place: str, values: Values, omega: np.ndarray) -> Added:
        """As `force`, from the spectra of the powers."""

        def of_power(n: int) -> np.ndarray:
            return record.kept(f"{self.name} {n}", omega, lambda: record.deflection[:, record.vertical] ** n)

        return Added(force=stiffened(sum(values[name] * of_power(n) for n, name in powers(values)), record, values))

    def implausible(self, values: Values, std: Values) -> str:
        return "mounts that soften with amplitude" if values["k3_N_per_m3"] < 0 else ""


def stiffness(model: Table, n: int, words: str) -> EffectParameter:
    """Coefficient of a force proportional to the n-th power of the deflection."""
    size = 1e-2 * float(np.mean(mount_geometry(model.rig).stiffness)) / largest_rms(model) ** (n - 1)
    return EffectParameter(
        f"k{n}_N_per_m{n}", f"N/m^{n}", f"{words} stiffness, mean of the mounts", 0.0, -1e4 * size, 1e4 * size, size
    )


def powers(values: Values) -> list[tuple[int, str]]:
    """Exponent of the deflection and parameter name of each stiffness."""
    return [(int(name[1]), name) for name in values if name.startswith("k")]


def stiffened(pull: np.ndarray | int, record: RecordMotion, values: Values) -> np.ndarray:
    """(n, 6) generalized force on the payload from the pull (n, m) of equal mounts [N], in time or on lines."""
    return -pull @ (shares(values)[:, None] * record.rows[record.vertical])


def largest_rms(model: Table) -> float:
    """Largest r.m.s. deflection of a mount [m] in any record; 10 micrometres if none is known."""
    found = [float(one.rms_deflections.max()) for one in model.motion.values()]
    return max(found, default=1e-5) or 1e-5


def median_rms(model: Table) -> float:
    """Median over the records of the median r.m.s. deflection of the mounts [m]; 10 micrometres if none is known."""
    found = [float(np.median(one.rms_deflections)) for one in model.motion.values()]
    return float(np.median(found)) if found else 1e-5


@register
class ContactFriction(Effect):
    """Dahl friction at every drive, along its axis: f' = sigma v (1 - sign(v) f/F_c), F_c = sigma times the slip.

    P. R. Dahl, A solid friction model (1968): stiff and lossless for motion far below the slip, Coulomb friction far
    above it. All contacts slip at the same displacement; their stiffnesses may differ from the mean.
    """

    name = "contact_friction"
    title = "friction at the actuators' contact points: stiff at small amplitude, slipping at large"
    looks_like = "stiffness and damping that depend on the level: stiffer at a low level, more damped at a medium one"
    nonlinear = True
    strength = "stiffness_N_per_m"

    def places(self, model: Table) -> tuple[str, ...]:
        find = getattr(model.rig, "mount_of", None)
        return ("actuators",) if find and has_mounts(model) and all(map(find, model.actuators)) else ()

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        rms, k = median_rms(model), float(np.mean(mount_geometry(model.rig).stiffness))
        slips, words = [rms * x for x in (0.03, 0.1, 0.3, 1.0, 3.0, 10.0)], "displacement at which a contact slips"
        return (
            EffectParameter("stiffness_N_per_m", "N/m", "of a contact before it slips", 0.0, 0.0, 20 * k, 0.05 * k),
            EffectParameter.shape("slip_m", "m", words, 1e-3 * rms, 1e3 * rms, rms, slips),
            *uneven(model.actuators[:-1], "relative deviation of the contact stiffness of {} from the mean"),
        )

    def force(self, record: RecordMotion, place: str, values: Values) -> np.ndarray | None:
        return pushed(Contacts(record, values["slip_m"]).friction(0, len(record.volts)), record, values)

    def spectra(self, record: RecordMotion, place: str, values: Values, omega: np.ndarray) -> Added:
        """As `force`, interpolated between values of the slip."""
        f = record.interpolated(
            self.name, values["slip_m"], omega, lambda slip: Contacts(record, slip).friction(0, len(record.volts))
        )
        return Added(force=pushed(f, record, values))

    def reported(self, model: Table, place: str, values: Values, covariance: np.ndarray) -> dict[str, Reported]:
        k, slip = values["stiffness_N_per_m"], values["slip_m"]
        slope = np.array([slip, k])
        variance = float(slope @ covariance[:2, :2] @ slope)
        return {
            "force_N": Reported(k * slip, float(np.sqrt(max(variance, 0.0))), "N"),
            **super().reported(model, place, values, covariance),
        }


def contacts(values: Values) -> np.ndarray:
    """(m,) stiffness of each contact [N/m], in the order of the actuators."""
    return values["stiffness_N_per_m"] * shares(values)


class Contacts:
    """Friction of all contacts over their stiffness [m] along a record, continued from a stored state."""

    def __init__(self, record: RecordMotion, slip: float):
        self.record, self.slip = record, slip
        self.state, self.last = np.zeros(len(record.driven_rows)), np.zeros(len(record.driven_rows))

    def friction(self, start: int, stop: int, keep: bool = False) -> np.ndarray:
        """(stop - start, m) m, continued from the last stored state."""
        deflection = np.ascontiguousarray(self.record.deflection[start:stop, self.record.driven_rows])
        found = dahl(deflection, self.last, self.slip, self.state)
        if keep:
            self.state, self.last = found[-1], deflection[-1]
        return found


def pushed(f: np.ndarray, record: RecordMotion, values: Values) -> np.ndarray:
    """(n, 6) generalized force on the payload from friction over stiffness (n, m), in time or on lines."""
    return -f @ (contacts(values)[:, None] * record.rows[record.driven_rows])


@register
class StiffnessDrift(OfMounts):
    """Every stiffness times 1 + change p(t), where p goes from -0.5 to 0.5 over the campaign.

    linear : p = (t - middle)/T. settling : as exp(-t/tau) towards a final value, as after a temperature or pressure
    change.
    """

    name = "stiffness_drift"
    title = "the mounts' stiffness changes over the campaign"
    looks_like = "resonances move from record to record, in the order of time and not of level"
    at = ("isolators/linear", "isolators/settling")
    nonlinear = True
    time_varying = True
    strength = "relative_change"

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        change = EffectParameter("relative_change", "1", "of every stiffness over the campaign", 0.0, -0.9, 0.9, 0.02)
        if not place.endswith("settling"):
            return (change,)
        begin, end = campaign_clock(model)
        T, words = end - begin, "of the approach to the end"
        grid = (0.1 * T, 0.3 * T, T)
        return (change, EffectParameter.shape("time_constant_s", "s", words, 0.01 * T, 10 * T, T, grid, optional=True))

    def force(self, record: RecordMotion, place: str, values: Values) -> np.ndarray | None:
        begin, end = record.campaign_s
        through = drifted((record.time_s - begin) / (end - begin), values.get("time_constant_s", 0.0) / (end - begin))
        push = record.deflection * record.stiffness * through[:, None]
        return -values["relative_change"] * (push @ record.rows)

    def reported(self, model: Table, place: str, values: Values, covariance: np.ndarray) -> dict[str, Reported]:
        found = super().reported(model, place, values, covariance)
        # The model's change is relative to the stiffness from which the record's motion was computed; the reported one
        # is relative to the table's stiffness at the beginning.
        own, ratio = found["relative_change"], drift_over_stiffness(model)
        begin = 1 - own.value * ratio / 2
        one = Reported(own.value * ratio / begin, own.std * ratio / begin**2, own.unit)
        found["relative_change"] = one
        if model.motion:
            begin_s, end_s = campaign_clock(model)
            hours = (end_s - begin_s) / 3600
            found["rate_per_hour"] = Reported(one.value / hours, one.std / hours, "1/h")
        return found


def campaign_clock(model: Table) -> tuple[float, float]:
    """First and last time [s] of the campaign of a model's records; (0, 1) if it has none."""
    return next((one.campaign_s for one in model.motion.values()), (0.0, 1.0))


def drift_over_stiffness(model: Table) -> float:
    """Stiffness of the record's motion, to which a drift's change is relative, over that of the model's rig."""
    known = float(np.sum(mount_geometry(model.effective.rig).stiffness))
    return next((float(np.sum(one.stiffness)) / known for one in model.motion.values()), 1.0)


def drifted(when: np.ndarray, time_constant: float) -> np.ndarray:
    """-0.5 .. 0.5 as `when` goes from 0 to 1: linear, or settling with a time constant > 0 in the same units."""
    if time_constant <= 0:
        return np.asarray(when - 0.5)
    return np.expm1(-when / time_constant) / np.expm1(-1 / time_constant) - 0.5


def fastest_decay(model: Table) -> float:
    """Largest zeta omega [1/s] of the table's own modes."""
    mat = model.base.matrices
    inverse = np.linalg.inv(mat.M)
    n = len(inverse)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ mat.K, -inverse @ mat.C]])
    return float(np.max(-np.linalg.eigvals(A).real))
