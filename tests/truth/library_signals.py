"""Effects of the library in sensors, converter, amplifiers and loop."""

from __future__ import annotations

from typing import Any

import numpy as np

from .effect import Draw, Effect, Hidden
from .table import AXES, Plant, Signal

Drawn = tuple[str, dict[str, float], dict[str, Any]]


def _geophone_corner(d: Draw) -> Drawn:
    nominal = d.plant.rig.geophones
    corner = nominal.suspension_Hz * (1 + d.sign() * d.size(0.001, 0.25, d.beyond("sensor_corner_percent")))
    constant_damper = d.rng.random() < 0.5  # otherwise the damping ratio stays
    zeta = nominal.suspension_damping * (nominal.suspension_Hz / corner if constant_damper else 1.0)
    return d.one(d.plant.sensors), {"corner_Hz": corner}, {"damping_ratio": zeta}


def _apply_geophone_corner(plant: Plant, h: Hidden) -> None:
    j = plant.sensors.index(h.location)
    plant.wn[j], plant.zn[j] = 2 * np.pi * h.parameters["corner_Hz"], h.details["damping_ratio"]


def _drifting(j: int, h: Hidden) -> Signal:
    """Channel j with a gain that drifts over the campaign, about its mean."""

    def change(x: np.ndarray, t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        out = x.copy()
        out[:, j] *= 1 + h.details["drift"] * (t / h.details["span_s"] - 0.5)
        return out

    return change


def _sensor_gain(d: Draw) -> Drawn:
    return d.one(d.plant.sensors), {"gain": 1 + d.sign() * d.size(0.0007, 0.10, d.beyond("sensor_gain_percent"))}, {}


def _apply_sensor_gain(plant: Plant, h: Hidden) -> None:
    g, j, gain = plant.rig.geophones, plant.sensors.index(h.location), h.parameters["gain"]
    plant.S[j] = g.sensitivity_Vs_per_m[j] * g.preamplifier_gain * gain
    if h.details.get("electric_damping"):  # the shunted coil damps with the square of its sensitivity
        plant.zn[j] *= 1 + h.details["electric_damping"] * (gain**2 - 1)
    if h.details.get("drift"):
        plant.analogue.append(_drifting(j, h))


def nominal_axis(plant: Plant, j: int) -> np.ndarray:
    """(3,) of a sensor, as the rig file says."""
    return np.eye(3)[AXES.index(plant.rig.geophones.axis[j])]


def _sensor_misalignment(d: Draw) -> Drawn:
    name = d.one(d.plant.sensors)
    axis = nominal_axis(d.plant, d.plant.sensors.index(name))
    away = np.cross(axis, d.direction())
    return (
        name,
        {"angle_rad": d.size(0.002, 0.15, d.beyond("direction_rad"))},
        {"towards": (away / np.linalg.norm(away)).tolist()},
    )


def _apply_sensor_misalignment(plant: Plant, h: Hidden) -> None:
    j, angle = plant.sensors.index(h.location), h.parameters["angle_rad"]
    away = np.array(h.details["towards"])
    plant.sensor_n[j] = np.cos(angle) * nominal_axis(plant, j) + np.sin(angle) * away
    plant.sensor_p[j] += h.details.get("foot_m", 0.0) * np.sin(angle) * away


def _tilt_coupling(d: Draw) -> Drawn:
    return "horizontal geophones", {"gravity_m_per_s2": 9.81}, {}


def _apply_tilt_coupling(plant: Plant, h: Hidden) -> None:
    plant.extra["g"] = h.parameters["gravity_m_per_s2"]


def _mains_hum(d: Draw) -> Drawn:
    frequency = float(d.rng.choice([50.0, 60.0])) + d.rng.uniform(-0.02, 0.02)
    harmonics = [1, *(n for n in (2, 3, 4, 5, 7) if d.rng.random() < 0.5)]
    largest = d.size(3e-4, 0.3)
    fundamental = d.between(0.15, 1.0, 6)
    amplitude = largest * fundamental / fundamental.max()
    fall = [1.0, *(d.between(0.05, 0.6) for _ in harmonics[1:])]
    return (
        "geophones",
        {"frequency_Hz": frequency, "amplitude_V": largest},
        {
            "harmonics": harmonics,
            "amplitudes_V": (amplitude[:, None] * fall).tolist(),
            "phases": d.rng.uniform(0, 2 * np.pi, (6, len(harmonics))).tolist(),
        },
    )


def _apply_mains_hum(plant: Plant, h: Hidden) -> None:
    def hum(y: np.ndarray, t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        out = y.copy()
        for n, number in enumerate(h.details["harmonics"]):
            # The mains wander about their frequency; rectified loads swing with what they feed.
            wander = h.details.get("wander_rad", 0.0) * np.sin(2 * np.pi * h.details.get("wander_Hz", 0.0) * t)
            swing = 1 + h.details.get("swing", 0.0) * np.sin(2 * np.pi * h.details.get("swing_Hz", 0.0) * t)
            angle = number * (2 * np.pi * h.parameters["frequency_Hz"] * t + wander)
            for j in range(6):
                out[:, j] += swing * h.details["amplitudes_V"][j][n] * np.sin(angle + h.details["phases"][j][n])
        return out

    plant.analogue.append(hum)


def _sensor_quantisation(d: Draw) -> Drawn:
    name = d.one(d.plant.sensors)
    if d.rng.random() < 0.5:
        return name, {"step_V": d.size(2.5e-3, 0.3)}, {}
    return name, {"range_V": float(d.high.y[d.plant.sensors.index(name)]) * d.size(3.8, 1.3)}, {}


def _apply_sensor_quantisation(plant: Plant, h: Hidden) -> None:
    j = plant.sensors.index(h.location)
    plant.step_V[j] = h.parameters.get("step_V", plant.step_V[j])
    plant.range_V[j] = h.parameters.get("range_V", plant.range_V[j])
    plant.offset_steps[j] = 0.5 * h.details.get("mid_riser", False)
    plant.rails[j] = 1 + h.details.get("uneven_rails", 0.0), 1 - h.details.get("uneven_rails", 0.0)


def _actuator_gain(d: Draw) -> Drawn:
    return d.one(d.plant.motors), {"gain": 1 + d.sign() * d.size(0.001, 0.15, d.beyond("actuator_gain_percent"))}, {}


def _apply_actuator_gain(plant: Plant, h: Hidden) -> None:
    j = plant.motors.index(h.location)
    plant.motor[j] = plant.rig.motors[j].constant_N_per_V * h.parameters["gain"]
    if h.details.get("drift"):
        plant.drive.append(_drifting(j, h))


def _actuator_lag(d: Draw) -> Drawn:
    return "actuators", {"corner_Hz": d.size(600.0, 25.0)}, {}


def _apply_actuator_lag(plant: Plant, h: Hidden) -> None:
    corners = 2 * np.pi * h.parameters["corner_Hz"] * np.array(h.details.get("uneven", np.ones(8)))
    plant.extra["lag"] = corners
    if "poles" in h.details:  # over the corner, with the same delay at low frequency
        plant.extra["lag"], plant.extra["lag2"] = (corners * pole for pole in h.details["poles"])


def _actuator_saturation(d: Draw) -> Drawn:
    return "actuators", {"limit_V": d.high.level * d.size(3.8, 1.4)}, {}


def _apply_actuator_saturation(plant: Plant, h: Hidden) -> None:
    limit = h.parameters["limit_V"] * np.array(h.details.get("uneven", np.ones(8)))
    if "knee" in h.details:
        plant.drive.append(lambda u, t, rng: soft_limit(u, h.details["asymptote_V"], h.details["knee"]))
    else:
        plant.drive.append(lambda u, t, rng: np.clip(u, -limit, limit))


def soft_limit(u: np.ndarray, limit: float, knee: float) -> np.ndarray:
    """Linear at first, then bending towards the limit, the more sharply the larger the knee's exponent."""
    return u / (1 + np.abs(u / limit) ** knee) ** (1 / knee)


def _loop_delay(d: Draw) -> Drawn:
    return "loop", {"delay_s": d.size(2e-5, 4e-3)}, {}


def _apply_loop_delay(plant: Plant, h: Hidden) -> None:
    plant.delay_s += h.parameters["delay_s"]
    plant.jitter_s = h.details.get("jitter_s", 0.0)


def _ground_motion(d: Draw) -> Drawn:
    factor = d.size(5.0, 30.0)
    ambient = d.plant.rig.ambient.floor_velocity_rms_m_per_s
    return "floor", {"velocity_rms_m_per_s": factor * ambient}, {"factor": factor}


def _apply_ground_motion(plant: Plant, h: Hidden) -> None:
    plant.floor_factor = h.details["factor"] * np.array(h.details.get("uneven", np.ones(3)))


SIGNALS = tuple(
    Effect(name, family, draw, apply)
    for name, family, draw, apply in (
        ("geophone_corner", "sensor", _geophone_corner, _apply_geophone_corner),
        ("sensor_gain", "sensor", _sensor_gain, _apply_sensor_gain),
        ("sensor_misalignment", "sensor", _sensor_misalignment, _apply_sensor_misalignment),
        ("tilt_coupling", "sensor", _tilt_coupling, _apply_tilt_coupling),
        ("mains_hum", "disturbance", _mains_hum, _apply_mains_hum),
        ("sensor_quantisation", "converter", _sensor_quantisation, _apply_sensor_quantisation),
        ("actuator_gain", "actuator", _actuator_gain, _apply_actuator_gain),
        ("actuator_lag", "loop", _actuator_lag, _apply_actuator_lag),
        ("actuator_saturation", "drive", _actuator_saturation, _apply_actuator_saturation),
        ("loop_delay", "loop", _loop_delay, _apply_loop_delay),
        ("ground_motion", "floor", _ground_motion, _apply_ground_motion),
    )
)
