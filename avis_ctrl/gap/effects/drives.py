"""Effects of the drives and of the loop that a model may lack: force constant, lag, delay, limit."""

from __future__ import annotations

import numpy as np

from avis_ctrl.gap.effects.base import Added, Effect, EffectParameter, Reported, Table, Values, register, shares, uneven
from avis_ctrl.gap.operators import Operators
from avis_ctrl.gap.record_motion import RecordMotion
from avis_ctrl.identification.response import ResponseModel


@register
class ActuatorGain(Effect):
    """One force constant multiplied by a factor (Rademakers, eqs. 2.17-2.18)."""

    name = "actuator_gain"
    title = "an actuator's force constant is not the one of the rig file"
    looks_like = "the response to one input is wrong by the same real factor at every frequency and output"

    def places(self, model: Table) -> tuple[str, ...]:
        return model.actuators

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        return (EffectParameter("gain", "1", "force constant over that of the rig file", 1.0, 0.05, 10.0, 1.0),)

    def change(self, ops: Operators, place: str, values: Values) -> None:
        ops.drive = ops.drive * np.where(np.array(ops.base.actuators) == place, values["gain"], 1)


@register
class ActuatorLag(Effect):
    """Lag 1/(1 + s tau) of every amplifier, corner 1/(2 pi tau). If the model already has a lag, tau is the difference
    from its time constant.

    each : different tau about their mean. two : two poles, 1/((1 + s a tau) (1 + s (1 - a) tau)), with the same delay
    tau at low frequency.

    For aliased components, every law is approximated by one pole at the mean corner. With corners that differ by a
    factor of two, the error is 0.1 % of the response at a tenth of the sample rate, and 1 % at a fifth; with two poles
    0.4 % and 2 %.
    """

    name = "actuator_lag"
    title = "a first-order lag of the current amplifiers"
    looks_like = "phase lag that grows with frequency, the same in every channel, with a loss of gain"
    at = ("actuators", "actuators/each", "actuators/two")

    def places(self, model: Table) -> tuple[str, ...]:
        # Two poles with the time constant that is expected would not be the expected table.
        return tuple(place for place in self.at if not (place.endswith("/two") and expected_lag(model)))

    def titled(self, place: str) -> str:
        return "a lag of the current amplifiers with two poles" if place.endswith("/two") else self.title

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        law = place.partition("/")[2]
        own: tuple[EffectParameter, ...] = ()
        if law == "each":
            own = uneven(model.actuators[:-1], "relative deviation of drive {} from the mean")
        if law == "two":
            words = "fraction of the time constant in the slower pole"
            own = (EffectParameter.shape("slower_share", "1", words, 0.5, 0.999, 0.2, (0.75,), optional=True),)
        known = expected_lag(model)
        words = "time constant of the amplifiers" + (f" beyond the expected {1e3 * known:.3g} ms" if known else "")
        return (EffectParameter("time_constant_s", "s", words, 0.0, -known, 0.3, 1e-3), *own)

    def change(self, ops: Operators, place: str, values: Values) -> None:
        tau, s = values["time_constant_s"] + ops.base.amplifier_time_constant_s, ops.s[:, None]
        ops.amplifier_corner_Hz = 1 / (2 * np.pi * tau) if tau > 1e-9 else None
        if len(values) > 1:
            ops.drive = ops.drive * (1 + s * tau)
            for each in lags(ops.base, values):
                ops.drive = ops.drive / (1 + s * each)

    def reported(self, model: Table, place: str, values: Values, covariance: np.ndarray) -> dict[str, Reported]:
        found = super().reported(model, place, values, covariance)
        own = found["time_constant_s"]
        tau, std = own.value + model.base.amplifier_time_constant_s, own.std
        found["time_constant_s"] = Reported(tau, std, "s")
        if tau <= 1e-9:  # at its bound there is no corner
            return found
        return {"corner_Hz": Reported(1 / (2 * np.pi * tau), std / (2 * np.pi * tau**2), "Hz"), **found}


def expected_lag(model: Table) -> float:
    """Time constant of the amplifiers that a table is expected to have [s]; zero without an expected lag."""
    return (model.nominal or model.base).amplifier_time_constant_s


def lags(model: ResponseModel, values: Values) -> np.ndarray:
    """(poles, n_u) time constants of the amplifiers with the effect [s], not below zero; (poles, 1) if equal."""
    slower = values.get("slower_share")
    poles = [1.0] if slower is None else [slower, 1 - slower]
    each = model.amplifier_time_constant_s + values["time_constant_s"] * shares(values)
    return np.maximum(np.outer(poles, each), 0.0)


@register
class LoopDelay(Effect):
    """exp(-s tau) beyond the rig file's delay, not only in whole samples."""

    name = "loop_delay"
    title = "a delay of transport or computing beyond the nominal one"
    looks_like = "phase lag in proportion to frequency, the same in every channel, without loss of gain"
    at = ("loop",)

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        return (EffectParameter("extra_delay_s", "s", "delay beyond that of the rig file", 0.0, 0.0, 0.2, 1e-3),)

    def change(self, ops: Operators, place: str, values: Values) -> None:
        ops.delay_s = ops.delay_s + values["extra_delay_s"]

    def reported(self, model: Table, place: str, values: Values, covariance: np.ndarray) -> dict[str, Reported]:
        found = super().reported(model, place, values, covariance)
        extra = found["extra_delay_s"]
        return {**found, "delay_s": Reported(model.delay_s + extra.value, extra.std, "s")}


@register
class ActuatorSaturation(Effect):
    """Volts clipped at a limit below that of the rig file, one for all drives or different ones about their mean."""

    name = "actuator_saturation"
    title = "the drives clip below their nominal limit"
    looks_like = "less response than expected in records at high level only, and harmonics of the input"
    at = ("actuators", "actuators/each")
    nonlinear = True

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        peaks = [float(np.max(np.abs(one.volts))) for one in model.motion.values()] or [model.rig.drive_limit_V]
        known = model.rig.drive_limit_V
        peak, words = min(max(peaks), known) or known, "voltage at which the drives clip"
        grid = [peak * share for share in (0.9, 0.7, 0.5, 0.35, 0.2)]
        limit = EffectParameter.shape("limit_V", "V", words, peak / 50, peak, peak, grid, none=known)
        own = (
            uneven(model.actuators[:-1], "relative deviation of the limit of drive {} from the mean")
            if "/" in place
            else ()
        )
        return (limit, *own)

    def volts(self, record: RecordMotion, place: str, values: Values) -> np.ndarray | None:
        limits = voltage_limits(values)
        return np.clip(record.volts, -limits, limits)

    def spectra(self, record: RecordMotion, place: str, values: Values, omega: np.ndarray) -> Added:
        """As `volts`, drive by drive: most drives keep their limit when one limit changes."""
        limits = np.broadcast_to(voltage_limits(values), record.volts.shape[1])

        def clipped(k: int, limit: float) -> np.ndarray:
            return record.kept(f"{self.name} {k} {limit}", omega, lambda: np.clip(record.volts[:, [k]], -limit, limit))

        volts = np.hstack([clipped(k, float(limit)) for k, limit in enumerate(limits)])
        return Added(volts=volts - record.kept("volts", omega, lambda: record.volts))


def voltage_limits(values: Values) -> np.ndarray:
    """(n_u,) clipping voltages of the drives [V], or (1,) if all are equal."""
    return values["limit_V"] * shares(values)
