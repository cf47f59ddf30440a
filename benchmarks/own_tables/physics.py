"""A vibration isolation table of any make: what it is made of, the floor under it, and its simulation.

Places are in metres from the geometric centre, directions are vectors of any length, all SI.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .kernel import Arrays, sampled_loop

AXES = ("x", "y", "z", "phi_x", "phi_y", "phi_z")


@dataclass(frozen=True)
class Mount:
    """Springs and dampers along three axes of the earth, or along the columns of `frame`."""

    position_m: tuple
    stiffness_N_per_m: tuple
    damping_Ns_per_m: tuple
    frame: tuple = ((1, 0, 0), (0, 1, 0), (0, 0, 1))

    def along_earth(self, values) -> np.ndarray:
        F = np.array(self.frame, float)
        return F @ np.diag(values) @ F.T


@dataclass(frozen=True)
class Drive:
    """A force along a direction; a negative constant turns its sign."""

    name: str
    position_m: tuple
    direction: tuple
    constant_N_per_V: float
    limit_V: float = 10.0
    corner_Hz: float | None = None  # amplifier lag, first order
    fixed_to: str = "body"  # or "earth": does the direction turn with the body


def _chain(*parts):
    """State space of filters in series, first one first; each (A, B, C, D), one input, one output."""
    A, B, C, D = np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.ones((1, 1))
    for a, b, c, d in parts:
        A = np.block([[A, np.zeros((len(A), len(a)))], [b @ C, a]])
        B, C, D = np.vstack([B, b @ D]), np.hstack([d @ C, c]), d @ D
    return A, B, C, D


def _second_order(n2, n1, n0, w, z):
    """(n2 s^2 + n1 s + n0) / (s^2 + 2 z w s + w^2)."""
    A = np.array([[0.0, 1.0], [-w * w, -2 * z * w]])
    return A, np.array([[0.0], [1.0]]), np.array([[n0 - n2 * w * w, n1 - 2 * n2 * z * w]]), np.array([[n2]])


def _first_order(n1, n0, w):
    """(n1 s + n0) / (s + w)."""
    return np.array([[-w]]), np.array([[1.0]]), np.array([[n0 - n1 * w]]), np.array([[float(n1)]])


@dataclass(frozen=True)
class _Sensor:
    name: str
    position_m: tuple
    direction: tuple


@dataclass(frozen=True)
class Geophone(_Sensor):
    """Coil voltage over velocity S s^2/(s^2 + 2 z w s + w^2), then compensation to another corner, then gain."""

    sensitivity_Vs_per_m: float
    corner_Hz: float
    damping: float
    gain: float = 1.0
    compensated_Hz: float | None = None
    compensated_damping: float = 0.7
    noise_rms_V: float = 0.0  # after the gain, white at the sample rate
    on: str = "body"  # or "floor"
    trimmed: tuple | None = None  # corner Hz and damping that the compensation was made for; None: the geophone's own

    def filter(self):
        w, z = 2 * np.pi * self.corner_Hz, self.damping
        parts = [
            _second_order(0.0, self.sensitivity_Vs_per_m * self.gain, 0.0, w, z)
        ]  # driven by acceleration: one s less
        if self.compensated_Hz is not None:
            if self.trimmed is not None:
                w, z = 2 * np.pi * self.trimmed[0], self.trimmed[1]
            parts.append(
                _second_order(1.0, 2 * z * w, w * w, 2 * np.pi * self.compensated_Hz, self.compensated_damping)
            )
        return (1 if self.on == "floor" else 0), _chain(*parts)


@dataclass(frozen=True)
class Accelerometer(_Sensor):
    """S s/(s + w) over acceleration: charge amplifier of first order."""

    sensitivity_Vs2_per_m: float
    low_corner_Hz: float
    noise_rms_V: float = 0.0
    high_corner_Hz: float | None = None  # first-order bandwidth
    on: str = "body"

    def filter(self):
        parts = [_first_order(self.sensitivity_Vs2_per_m, 0.0, 2 * np.pi * self.low_corner_Hz)]
        if self.high_corner_Hz is not None:
            w = 2 * np.pi * self.high_corner_Hz
            parts.append(_first_order(0.0, w, w))
        return (1 if self.on == "floor" else 0), _chain(*parts)


@dataclass(frozen=True)
class PositionSensor(_Sensor):
    """Place of a body point against the floor's point that it stood on, along a direction."""

    sensitivity_V_per_m: float
    noise_rms_V: float = 0.0
    corner_Hz: float | None = None  # first-order bandwidth

    def filter(self):
        S = self.sensitivity_V_per_m
        if self.corner_Hz is None:
            return 2, (np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.array([[S]]))
        w = 2 * np.pi * self.corner_Hz
        return 2, _first_order(0.0, S * w, w)


@dataclass(frozen=True)
class FloorVelocity(_Sensor):
    """Velocity of the floor, without dynamics."""

    sensitivity_Vs_per_m: float
    noise_rms_V: float = 0.0

    def filter(self):
        S = np.array([[self.sensitivity_Vs_per_m]])
        return 3, (np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), S)


@dataclass(frozen=True)
class Table:
    """A rig: body, mounts, drives, sensors, converter and what is normal on site."""

    name: str
    mass_kg: float
    inertia_kgm2: np.ndarray  # (3, 3) about the centre of mass
    centre_of_mass_m: tuple
    mounts: tuple
    drives: tuple
    sensors: tuple
    sample_rate_Hz: float
    adc_bits: int
    adc_range_V: float
    loop_delay_s: float
    floor_velocity_rms_m_per_s: float  # each direction, 0.5 to 60 Hz
    gravity_m_per_s2: float = 0.0  # weight on the mounts (levelled at rest); 0: neglected
    tilt_m_per_s2: float = 0.0  # gravity that inertial sensors feel in tilt; 0: neglected

    @property
    def dt(self) -> float:
        return 1.0 / self.sample_rate_Hz

    @property
    def limits(self) -> np.ndarray:
        return np.array([d.limit_V for d in self.drives], float)

    @cached_property
    def fastest(self) -> float:
        """Largest rate of the body on its mounts, the sensors and the amplifiers, rad/s."""
        rates = [2 * np.pi * d.corner_Hz for d in self.drives if d.corner_Hz]
        rates += [abs(np.linalg.eigvals(s.filter()[1][0])).max(initial=0.0) for s in self.sensors]
        M, C, K = rigid(self)
        A = np.block([[np.zeros((6, 6)), np.eye(6)], [-np.linalg.solve(M, K), -np.linalg.solve(M, C)]])
        return max([abs(np.linalg.eigvals(A)).max(), *rates])

    @cached_property
    def arrays(self) -> Arrays:
        """The table as the kernel takes it."""
        com = np.array(self.centre_of_mass_m, float)

        def place(items):
            return np.array([np.array(i.position_m, float) - com for i in items]).reshape(-1, 3)

        def unit(items):
            d = np.array([i.direction for i in items], float).reshape(-1, 3)
            return d / np.linalg.norm(d, axis=1, keepdims=True)

        kinds, filters = zip(*(s.filter() for s in self.sensors), strict=True) if self.sensors else ((), ())
        order = max((len(f[0]) for f in filters), default=0)
        A, B, C = (np.zeros((len(filters), *s)) for s in ((order, order), (order,), (order,)))
        for k, (a, b, c, _) in enumerate(filters):
            n = len(a)
            A[k, :n, :n], B[k, :n], C[k, :n] = a, b[:, 0], c[0]
        J = np.ascontiguousarray(self.inertia_kgm2, float)
        p = place(self.mounts)
        # the preloads that carry the weight without a moment, smallest in the square
        carry = np.vstack([np.ones(len(p)), p[:, 0], p[:, 1]])
        F = np.zeros_like(p)
        F[:, 2] = np.linalg.pinv(carry) @ [self.mass_kg * self.gravity_m_per_s2, 0.0, 0.0] if len(p) else 0.0
        stiffness = [m.along_earth(m.stiffness_N_per_m) for m in self.mounts]
        damping = [m.along_earth(m.damping_Ns_per_m) for m in self.mounts]
        return Arrays(
            mass=float(self.mass_kg),
            J=J,
            J_inverse=np.ascontiguousarray(np.linalg.inv(J)),
            gravity=float(self.gravity_m_per_s2),
            tilt=float(self.tilt_m_per_s2),
            mount_p=p,
            mount_K=np.array(stiffness).reshape(-1, 3, 3),
            mount_B=np.array(damping).reshape(-1, 3, 3),
            mount_F=F,
            drive_p=place(self.drives),
            drive_d=unit(self.drives),
            drive_gain=np.array([d.constant_N_per_V for d in self.drives], float),
            drive_w=np.array([2 * np.pi * (d.corner_Hz or 0.0) for d in self.drives]),
            drive_earth=np.array([d.fixed_to == "earth" for d in self.drives], dtype=np.bool_),
            sensor_p=place(self.sensors),
            sensor_d=unit(self.sensors),
            sensor_kind=np.array(kinds, dtype=np.int64),
            A=A,
            B=B,
            C=C,
            D=np.array([f[3][0, 0] for f in filters], float),
        )


def cross_matrix(r) -> np.ndarray:
    """S(r) with S(r) a = r x a."""
    return np.array([[0.0, -r[2], r[1]], [r[2], 0.0, -r[0]], [-r[1], r[0], 0.0]])


def rigid(table: Table):
    """Linear M, C, K about the centre of mass, `M q'' + C q' + K q = T u` (weight neglected); see `drive_matrix`."""
    M, C, K = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros((6, 6))
    M[:3, :3], M[3:, 3:] = table.mass_kg * np.eye(3), table.inertia_kgm2
    for m in table.mounts:
        G = np.hstack([np.eye(3), -cross_matrix(np.subtract(m.position_m, table.centre_of_mass_m))])
        C += G.T @ m.along_earth(m.damping_Ns_per_m) @ G
        K += G.T @ m.along_earth(m.stiffness_N_per_m) @ G
    return M, C, K


def drive_matrix(table: Table) -> np.ndarray:
    """T (6, drives) in N/V and N m/V about the centre of mass."""
    columns = []
    for d in table.drives:
        force = np.array(d.direction, float) / np.linalg.norm(d.direction) * d.constant_N_per_V
        columns.append(np.concatenate([force, np.cross(np.subtract(d.position_m, table.centre_of_mass_m), force)]))
    return np.array(columns).T


def sensor_matrix(table: Table) -> np.ndarray:
    """(sensors, 6): what each sensor sees of the body's motion along its direction, without its dynamics and gain."""
    rows = []
    for s in table.sensors:
        d = np.array(s.direction, float) / np.linalg.norm(s.direction)
        on_body = getattr(s, "on", "body") == "body" and not isinstance(s, FloorVelocity)
        arm = np.cross(np.subtract(s.position_m, table.centre_of_mass_m), d)
        rows.append(np.concatenate([d, arm]) * on_body)
    return np.array(rows)


def floor_motion(samples, dt, rms, rng, band=(0.5, 60.0), axes=(0, 1, 2)) -> np.ndarray:
    """(samples + 1, 18): place, velocity, acceleration of six axes of the floor; band-limited noise of flat velocity.

    Periodic in `samples`; place, velocity and acceleration are exact derivatives of each other. `rms` in m/s (rad/s):
    a number or one per axis of `axes`.
    """
    f = np.fft.rfftfreq(samples, dt)
    lines = (f >= band[0]) & (f <= band[1]) & (f > 0)
    if not lines.any():
        raise ValueError(f"no line of {samples} samples lies within {band} Hz")
    out = np.zeros((samples + 1, 18))
    for axis, level in zip(axes, np.broadcast_to(rms, len(axes)), strict=True):
        v = np.zeros(len(f), complex)
        v[lines] = np.exp(2j * np.pi * rng.random(lines.sum())) * level * samples / math.sqrt(2 * lines.sum())
        jw = np.where(f > 0, 2j * np.pi * f, 1.0)
        for offset, spectrum in ((0, v / jw), (6, v), (12, v * jw)):
            out[:-1, offset + axis] = np.fft.irfft(spectrum, samples)
    out[-1] = out[0]
    return out


@dataclass
class State:
    """Where a table and its controller stand between two samples."""

    x: np.ndarray
    past: np.ndarray
    xc: np.ndarray

    @classmethod
    def rest(cls, table: Table, controller_order: int = 0, delay_s: float | None = None) -> "State":
        P = table.arrays
        x = np.zeros(13 + len(table.drives) + P.B.size)
        x[3] = 1.0
        whole, _ = split_delay(table, delay_s)
        return cls(x, np.zeros((whole + 1, len(table.drives))), np.zeros(controller_order))

    def copy(self) -> "State":
        return State(self.x.copy(), self.past.copy(), self.xc.copy())


def split_delay(table: Table, delay_s: float | None = None) -> tuple[int, float]:
    """Whole samples of delay and the part of a sample beyond."""
    delay = (table.loop_delay_s if delay_s is None else delay_s) * table.sample_rate_Hz
    whole = math.floor(delay + 1e-9)
    part = delay - whole
    return whole, part if part > 1e-9 else 0.0


@dataclass
class Record:
    """What was measured and what really happened; rows are samples."""

    y: np.ndarray  # (N, sensors) V, after converter
    u: np.ndarray  # (N, drives) V, as commanded, after the limits
    place: np.ndarray  # (N, 6) centre of mass m and rotation vector rad, earth
    velocity: np.ndarray  # (N, 6) m/s and rad/s, earth
    left: bool  # the body left its mounts (1 m) or ran out of numbers


def rotation(q) -> np.ndarray:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4)."""
    q0, q1, q2, q3 = np.moveaxis(np.asarray(q), -1, 0)
    rows = [
        [1 - 2 * (q2 * q2 + q3 * q3), 2 * (q1 * q2 - q0 * q3), 2 * (q1 * q3 + q0 * q2)],
        [2 * (q1 * q2 + q0 * q3), 1 - 2 * (q1 * q1 + q3 * q3), 2 * (q2 * q3 - q0 * q1)],
        [2 * (q1 * q3 - q0 * q2), 2 * (q2 * q3 + q0 * q1), 1 - 2 * (q1 * q1 + q2 * q2)],
    ]
    return np.stack([np.stack(r, -1) for r in rows], -2)


def simulate(table: Table, commands, *, floor=None, rng=None, controller=None, state=None, quantise=True, delay_s=None,
             fineness=0.4) -> Record:  # fmt: skip
    """Run a table over `commands` (N, drives) in volts, sensors noisy if `rng` is given; `state` is advanced in place.

    `controller` (A, B, C, D), sampled, adds its u = C x + D y to the commands before the drive limits. `fineness`: the
    largest step of the integration times the fastest rate of the table. Runge-Kutta of fourth order: 0.4 leaves about
    1e-4 of a transient of the fastest filter, and far less of all that is slower.
    """
    commands = np.ascontiguousarray(commands, float)
    N, ns, nd = len(commands), len(table.sensors), len(table.drives)
    if controller is None:
        controller = (np.zeros((0, 0)), np.zeros((0, ns)), np.zeros((nd, 0)), np.zeros((nd, ns)))
    K = tuple(np.ascontiguousarray(m, float) for m in controller)
    state = State.rest(table, len(K[0]), delay_s) if state is None else state
    whole, part = split_delay(table, delay_s)
    steps = max(1, math.ceil(table.dt * table.fastest / fineness))
    noise = np.zeros((N, ns))
    if rng is not None:
        noise = rng.standard_normal((N, ns)) * np.array([s.noise_rms_V for s in table.sensors])
    floor = np.zeros((0, 18)) if floor is None else np.ascontiguousarray(floor, float)
    if 0 < len(floor) < N + 1:
        raise ValueError(f"the floor has {len(floor)} rows, {N + 1} needed")
    lsb = 2 * table.adc_range_V / 2**table.adc_bits if quantise else 0.0
    y, u, motion = np.zeros((N, ns)), np.zeros((N, nd)), np.zeros((N, 13))
    done = sampled_loop(table.dt, whole, part, steps, state.x, state.past, state.xc, table.arrays, K, commands, floor,
                        noise, lsb, table.adc_range_V, table.limits, y, u, motion)  # fmt: skip
    y, u, motion = y[:done], u[:done], motion[:done]
    angle = 2 * motion[:, 4:7] * np.sign(motion[:, 3:4] + 1e-300)
    size = np.linalg.norm(motion[:, 4:7], axis=1, keepdims=True)
    angle *= np.where(size > 1e-9, np.arcsin(np.minimum(size, 1.0)) / np.maximum(size, 1e-300), 1.0)
    turn = np.einsum("nij,nj->ni", rotation(motion[:, 3:7]), motion[:, 10:13])
    return Record(y, u, np.hstack([motion[:, :3], angle]), np.hstack([motion[:, 7:10], turn]), done < N)
