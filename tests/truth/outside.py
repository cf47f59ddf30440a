"""Effects that the library does not hold. Naming one of them as something else is the worst answer."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.signal import bilinear, lfilter

from .effect import Draw, Effect, Hidden
from .table import Plant, Signal

Drawn = tuple[str, dict[str, float], dict[str, Any]]


def _on_channel(j: int, change: Any) -> Signal:
    """change(column, t, rng) -> column, on one sensor only."""

    def signal(y: np.ndarray, t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        out = y.copy()
        out[:, j] = change(y[:, j], t, rng)
        return out

    return signal


def _air_drag(d: Draw) -> Drawn:
    speed = float(np.mean(d.high.speed))
    return "payload", {"drag_Ns2_per_m2": 650.0 * d.size(0.003, 1.0) / speed}, {}


def _apply_air_drag(plant: Plant, h: Hidden) -> None:
    plant.extra["drag"] = h.parameters["drag_Ns2_per_m2"]


def _sensor_crosstalk(d: Draw) -> Drawn:
    name, source = d.rng.permutation(np.array(d.plant.sensors))[:2]
    return str(name), {"share": d.sign() * d.size(0.001, 0.15)}, {"source": str(source)}


def _apply_sensor_crosstalk(plant: Plant, h: Hidden) -> None:
    j, i = plant.sensors.index(h.location), plant.sensors.index(h.details["source"])

    def mixed(y: np.ndarray, t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        out = y.copy()
        out[:, j] += h.parameters["share"] * y[:, i]
        return out

    plant.analogue.append(mixed)


def _sensor_low_pass(d: Draw) -> Drawn:
    return d.one(d.plant.sensors), {"corner_Hz": d.size(2000.0, 20.0)}, {}


def _apply_sensor_low_pass(plant: Plant, h: Hidden) -> None:
    w = 2 * np.pi * h.parameters["corner_Hz"]
    b, a = bilinear([w], [1, w], plant.rig.sample_rate_Hz)
    plant.analogue.append(_on_channel(plant.sensors.index(h.location), lambda y, t, rng: lfilter(b, a, y)))


def _sensor_spurious_resonance(d: Draw) -> Drawn:
    return (
        d.one(d.plant.sensors),
        {"frequency_Hz": d.between(15.0, 40.0)},
        {"share": d.size(0.002, 0.3), "damping_ratio": d.between(0.01, 0.05)},
    )


def _apply_sensor_spurious_resonance(plant: Plant, h: Hidden) -> None:
    w, z, share = 2 * np.pi * h.parameters["frequency_Hz"], h.details["damping_ratio"], h.details["share"]
    b, a = bilinear([1 + share, 2 * z * w, w * w], [1, 2 * z * w, w * w], plant.rig.sample_rate_Hz)
    plant.analogue.append(_on_channel(plant.sensors.index(h.location), lambda y, t, rng: lfilter(b, a, y)))


def _one_amplifier_lag(d: Draw) -> Drawn:
    return d.one(d.plant.motors), {"corner_Hz": d.size(600.0, 20.0)}, {}


def _apply_one_amplifier_lag(plant: Plant, h: Hidden) -> None:
    lag = np.zeros(8)
    lag[plant.motors.index(h.location)] = 2 * np.pi * h.parameters["corner_Hz"]
    plant.extra["lag"] = lag


def _force_constant_of_displacement(d: Draw) -> Drawn:
    rms = float(np.mean(d.high.stretch))
    slope, curvature = d.sign() * d.size(0.002, 0.5) / rms, -d.size(0.002, 0.4) / rms**2
    return "actuators", {"slope_per_m": slope}, {"curvature": curvature}


def _apply_force_constant_of_displacement(plant: Plant, h: Hidden) -> None:
    plant.extra.update(motor_b1=np.full(8, h.parameters["slope_per_m"]), motor_b2=np.full(8, h.details["curvature"]))


def _force_constant_of_drive(d: Draw) -> Drawn:
    return "actuators", {"slope_per_V": d.sign() * d.size(0.001, 0.25) / d.high.level}, {}


def _apply_force_constant_of_drive(plant: Plant, h: Hidden) -> None:
    plant.drive.append(lambda u, t, rng: u * (1 + h.parameters["slope_per_V"] * u))


def _sensor_quadratic(d: Draw) -> Drawn:
    name = d.one(d.plant.sensors)
    return name, {"slope_per_V": d.sign() * d.size(0.0005, 0.15) / float(d.high.y[d.plant.sensors.index(name)])}, {}


def _apply_sensor_quadratic(plant: Plant, h: Hidden) -> None:
    plant.analogue.append(
        _on_channel(plant.sensors.index(h.location), lambda y, t, rng: y * (1 + h.parameters["slope_per_V"] * y))
    )


def _clock_rate_error(d: Draw) -> Drawn:
    return "loop", {"relative": d.sign() * d.size(3e-7, 1e-3)}, {}


def _apply_clock_rate_error(plant: Plant, h: Hidden) -> None:
    plant.clock_error = h.parameters["relative"]


def _dropped_samples(d: Draw) -> Drawn:
    return "geophones", {"per_second": d.size(0.01, 1.0)}, {}


def _apply_dropped_samples(plant: Plant, h: Hidden) -> None:
    def dropped(y: np.ndarray, t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        lost = rng.random(len(y)) < h.parameters["per_second"] / plant.rig.sample_rate_Hz
        kept = y[~lost]  # what follows a lost sample moves up; the end repeats its last
        return np.vstack([kept, np.repeat(kept[-1:], len(y) - len(kept), axis=0)])

    plant.digital.append(dropped)


def _asymmetric_stiffness(d: Draw) -> Drawn:
    rms = float(np.mean(d.high.stretch[:, 2]))
    return "isolators z", {"quadratic_N_per_m2": d.sign() * 4.5e4 * d.size(0.001, 0.15) / rms}, {}


def _apply_asymmetric_stiffness(plant: Plant, h: Hidden) -> None:
    plant.extra["k2"] = np.full(4, h.parameters["quadratic_N_per_m2"])


def _actuator_gain_drift(d: Draw) -> Drawn:
    return "actuators", {"change": d.sign() * d.size(0.001, 0.08)}, {"span_s": d.span_s}


def _apply_actuator_gain_drift(plant: Plant, h: Hidden) -> None:
    plant.drive.append(lambda u, t, rng: u * (1 + h.parameters["change"] * t[:, None] / h.details["span_s"]))


def _gyroscope(d: Draw) -> Drawn:
    axis = np.eye(3)[2] if d.rng.random() < 0.7 else d.direction()
    return "payload", {"momentum_Nms": d.size(0.15, 100.0)}, {"axis": axis.tolist()}


def _apply_gyroscope(plant: Plant, h: Hidden) -> None:
    plant.extra["rotor"] = h.parameters["momentum_Nms"] * np.array(h.details["axis"])


def _dead_zone(d: Draw) -> Drawn:
    return d.one(d.plant.motors), {"half_width_V": d.middle.level * d.size(0.003, 0.6)}, {}


def _apply_dead_zone(plant: Plant, h: Hidden) -> None:
    width, j = h.parameters["half_width_V"], plant.motors.index(h.location)

    def dead(u: np.ndarray, t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        out = u.copy()
        out[:, j] = np.sign(u[:, j]) * np.maximum(np.abs(u[:, j]) - width, 0.0)
        return out

    plant.drive.append(dead)


def _noisy_sensor(d: Draw) -> Drawn:
    return d.one(d.plant.sensors), {"noise_rms_V": 1e-3 * d.size(1.5, 60.0)}, {}


def _apply_noisy_sensor(plant: Plant, h: Hidden) -> None:
    plant.noise_V[plant.sensors.index(h.location)] = h.parameters["noise_rms_V"]


def _sensor_delay(d: Draw) -> Drawn:
    return d.one(d.plant.sensors), {"delay_s": d.size(3e-5, 5e-3)}, {}


def _apply_sensor_delay(plant: Plant, h: Hidden) -> None:
    def delayed(y: np.ndarray, t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        samples = h.parameters["delay_s"] * plant.rig.sample_rate_Hz
        n = len(y)
        padded = np.concatenate([np.full(64, y[0]), y, np.full(64, y[-1])])
        whole, part = int(samples), samples - int(samples)
        taps = np.arange(-16, 16) - part
        sinc = np.sinc(taps) * np.cos(np.pi * taps / 36) ** 2  # windowed interpolation
        sinc /= sinc.sum()
        return np.convolve(padded, sinc)[64 - whole + 16 :][:n]

    plant.analogue.append(_on_channel(plant.sensors.index(h.location), delayed))


OUTSIDE = tuple(
    Effect(name, "outside", draw, apply)
    for name, draw, apply in (
        ("air_drag", _air_drag, _apply_air_drag),
        ("sensor_crosstalk", _sensor_crosstalk, _apply_sensor_crosstalk),
        ("sensor_low_pass", _sensor_low_pass, _apply_sensor_low_pass),
        ("sensor_spurious_resonance", _sensor_spurious_resonance, _apply_sensor_spurious_resonance),
        ("one_amplifier_lag", _one_amplifier_lag, _apply_one_amplifier_lag),
        ("force_constant_of_displacement", _force_constant_of_displacement, _apply_force_constant_of_displacement),
        ("force_constant_of_drive", _force_constant_of_drive, _apply_force_constant_of_drive),
        ("sensor_quadratic", _sensor_quadratic, _apply_sensor_quadratic),
        ("clock_rate_error", _clock_rate_error, _apply_clock_rate_error),
        ("dropped_samples", _dropped_samples, _apply_dropped_samples),
        ("asymmetric_stiffness", _asymmetric_stiffness, _apply_asymmetric_stiffness),
        ("actuator_gain_drift", _actuator_gain_drift, _apply_actuator_gain_drift),
        ("gyroscope", _gyroscope, _apply_gyroscope),
        ("dead_zone", _dead_zone, _apply_dead_zone),
        ("noisy_sensor", _noisy_sensor, _apply_noisy_sensor),
        ("sensor_delay", _sensor_delay, _apply_sensor_delay),
    )
)
