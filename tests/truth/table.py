"""One drawn table: its numbers, the changes that effects make to it, and a linear estimate of its motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from avis_ctrl.rigs import IsolatorTable

from .kernel import Physics

AXES = "xyz"
Signal = Callable[[np.ndarray, np.ndarray, np.random.Generator], np.ndarray]


@dataclass
class Plant:
    """A table with room for effects. Points are from the geometric centre; lists and dicts are filled by effects.

    extra : fields of Physics that differ from the table without effects.
    drive : functions (u, t, rng) -> u on the held voltages (samples, 8) at campaign times t.
    analogue : functions (y, t, rng) -> y on the sensor voltages (samples, 6) before noise and converter.
    digital : the same after the converter.
    stiffness : function t -> factor of all mounts' stiffness.
    offset_steps : of the converter's codes. rails : (6, 2) upper and lower end over range_V.
    jitter_s : half width of the even spread of each sample's delay. floor_factor : of all directions, or of each.
    points, chassis_points : (4, 3) the mounts' ends; motor_p, sensor_p : (8, 3), (6, 3). They and the directions
    motor_d (earth axes) and sensor_n (body axes) are the rig's until a clutter moves them.
    """

    rig: IsolatorTable
    m: float
    J: np.ndarray
    k: np.ndarray
    c: np.ndarray
    com: np.ndarray = field(default_factory=lambda: np.zeros(3))
    extra: dict[str, Any] = field(default_factory=dict)
    drive: list[Signal] = field(default_factory=list)
    analogue: list[Signal] = field(default_factory=list)
    digital: list[Signal] = field(default_factory=list)
    stiffness: Callable[[np.ndarray], np.ndarray] = np.ones_like
    delay_s: float = 0.0
    jitter_s: float = 0.0
    clock_error: float = 0.0
    floor_factor: Any = 1.0
    noise_V: np.ndarray = field(init=False)
    step_V: np.ndarray = field(init=False)
    range_V: np.ndarray = field(init=False)
    offset_steps: np.ndarray = field(init=False)
    rails: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        acquisition = self.rig.acquisition
        self.delay_s = acquisition.loop_delay_s
        self.noise_V = np.full(6, self.rig.ambient.sensor_noise_rms_V)
        self.step_V = np.full(6, 2 * acquisition.adc_range_V / 2**acquisition.adc_bits)
        self.range_V = np.full(6, acquisition.adc_range_V)
        self.offset_steps, self.rails = np.zeros(6), np.ones((6, 2))
        g = self.rig.geophones
        self.points = np.array([isolator.position for isolator in self.rig.isolators])
        self.chassis_points = self.points.copy()
        self.motor_at = np.array([motor.isolator - 1 for motor in self.rig.motors])
        self.motor_p = self.points[self.motor_at]
        self.motor_d = np.eye(3)[[AXES.index(motor.axis) for motor in self.rig.motors]]
        self.motor = np.array([motor.constant_N_per_V for motor in self.rig.motors])
        self.sensor_at = np.array(g.isolator) - 1
        self.sensor_p = self.points[self.sensor_at]
        self.sensor_n = np.eye(3)[[AXES.index(axis) for axis in g.axis]]
        self.S = np.array(g.sensitivity_Vs_per_m) * g.preamplifier_gain
        self.wn = np.full(6, 2 * np.pi * g.suspension_Hz)
        self.zn = np.full(6, g.suspension_damping)

    @property
    def sensors(self) -> tuple[str, ...]:
        return self.rig.geophones.names

    @property
    def motors(self) -> tuple[str, ...]:
        return tuple(motor.name for motor in self.rig.motors)

    def physics(self) -> Physics:
        """The numbers that the integrator takes."""
        g = self.rig.geophones
        wn, zn, wc, zc = (
            2 * np.pi * g.suspension_Hz,
            g.suspension_damping,
            2 * np.pi * g.compensated_Hz,
            g.compensated_damping,
        )
        none, none3, none4, none8 = np.zeros(0), np.zeros((0, 3)), np.zeros((0, 4)), np.zeros((0, 8))
        values: dict[str, Any] = dict(
            m=float(self.m),
            J=self.J,
            Ji=np.linalg.inv(self.J),
            rotor=np.zeros(3),
            drag=0.0,
            r=self.points - self.com,
            k=self.k,
            c=self.c,
            k2=np.zeros(4),
            k3=np.zeros(4),
            k5=np.zeros(4),
            motor_r=self.motor_p - self.com,
            motor_d=self.motor_d,
            motor_at=self.motor_at,
            motor=self.motor,
            motor_b1=np.zeros(8),
            motor_b2=np.zeros(8),
            sensor_r=self.sensor_p - self.com,
            sensor_at=self.sensor_at,
            sensor_n=self.sensor_n,
            S=self.S,
            wn=self.wn,
            zn=self.zn,
            b1=np.full(6, 2 * zn * wn - 2 * zc * wc),
            b0=np.full(6, wn**2 - wc**2),
            wc=wc,
            zc=zc,
            g=0.0,
            lag=none,
            lag2=none,
            mode_shape=np.zeros((0, 4, 3)),
            mode_w=none,
            mode_z=none,
            osc_r=none3,
            osc_d=none3,
            osc_m=none,
            osc_k=none,
            osc_c=none,
            base_free=np.zeros(0, int),
            base_r=np.zeros((4, 3)),
            base_motor_r=np.zeros((8, 3)),
            base_Mi=np.zeros(6),
            base_K=np.zeros((6, 6)),
            base_C=np.zeros((6, 6)),
            max_k=none4,
            max_c=none4,
            max_q=none4,
            ladder_k=none4,
            ladder_w=none,
            surge_m=none,
            surge_c=none,
            surge_share=none,
            level_w=none,
            level_tau=0.0,
            cable_r=none3,
            cable_d=none3,
            cable_k=none,
            cable_c=none,
            fric_jenkins=0,
            fric_s0=none8,
            fric_s1=0.0,
            fric_s2=0.0,
            fric_Fc=none8,
            fric_Fs=none8,
            fric_vs=1.0,
        )
        values |= self.extra
        for name in ("osc_r", "cable_r"):
            values[name] = values[name] - self.com
        for name, value in values.items():
            if isinstance(value, np.ndarray):
                values[name] = np.ascontiguousarray(
                    value, np.int64 if name in ("motor_at", "sensor_at", "base_free") else np.float64
                )
        return Physics(**values)


def draw_plant(rig: IsolatorTable, rng: np.random.Generator, spread: float = 1.0) -> Plant:
    """A table whose mass, moments of inertia and stiffnesses lie within +-5 % of the rig's, dampings within +-20 %.

    spread : 0 gives the rig's own numbers.
    """

    def near(value: object, relative: float) -> np.ndarray:
        value = np.asarray(value, float)
        return value * (1 + spread * relative * rng.uniform(-1, 1, value.shape))

    k = near([isolator.stiffness for isolator in rig.isolators], 0.05)
    c = near([isolator.damping for isolator in rig.isolators], 0.20)
    return Plant(rig, float(near(rig.mass, 0.05)), np.diag(near(np.diag(rig.inertia_matrix()), 0.05)), k, c)


@dataclass(frozen=True)
class Pilot:
    """Expected r.m.s. of a table without effects under one excitation, to give effects sizes that matter.

    stretch, speed : (4, 3) m and m/s over the mounts. y : (6,) V. level : V r.m.s. of every motor.
    poles : of the table alone, rad/s.
    """

    level: float
    stretch: np.ndarray
    speed: np.ndarray
    y: np.ndarray
    poles: np.ndarray


def carry(p: np.ndarray) -> np.ndarray:
    """(3, 6) motion of a body-fixed point at p per (translation, rotation)."""
    x, y, z = p
    return np.hstack([np.eye(3), [[0, z, -y], [-z, 0, x], [y, -x, 0]]])


def matrices(plant: Plant) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """M, C, K (6, 6) and T (6, 8) of small motion about the centre of mass."""
    G = [carry(p) for p in plant.points - plant.com]
    M = np.zeros((6, 6))
    M[:3, :3], M[3:, 3:] = plant.m * np.eye(3), plant.J
    K = sum(g.T @ np.diag(k) @ g for g, k in zip(G, plant.k, strict=True))
    C = sum(g.T @ np.diag(c) @ g for g, c in zip(G, plant.c, strict=True))
    T = np.array(
        [d @ carry(p) * tau for p, d, tau in zip(plant.motor_p - plant.com, plant.motor_d, plant.motor, strict=True)]
    ).T
    return M, C, K, T


def pilot(plant: Plant, band_Hz: tuple[float, float], level: float) -> Pilot:
    """Linear estimate for independent voltages of `level` V r.m.s., flat over band_Hz."""
    M, C, K, T = matrices(plant)
    f = np.geomspace(*band_Hz, 400)
    s = 2j * np.pi * f[:, None, None]
    q = np.linalg.solve(s**2 * M + s * C + K, np.broadcast_to(T, (len(f), 6, 8)))
    density = level**2 / (band_Hz[1] - band_Hz[0])
    G = np.array([carry(p) for p in plant.points - plant.com])
    e = np.einsum("iaq,fqu->fiau", G, q)
    power = (np.abs(e) ** 2).sum(axis=-1) * density
    speed = power * (2 * np.pi * f[:, None, None]) ** 2
    stretch_rms, speed_rms = (np.sqrt(np.trapezoid(p, f, axis=0)) for p in (power, speed))
    y = np.abs(np.einsum("ja,jaf->jf", plant.sensor_n, speed_rms[plant.sensor_at][:, :, None]))[:, 0] * plant.S
    A = np.block([[np.zeros((6, 6)), np.eye(6)], [-np.linalg.solve(M, K), -np.linalg.solve(M, C)]])
    return Pilot(level, stretch_rms, speed_rms, y, np.linalg.eigvals(A))
