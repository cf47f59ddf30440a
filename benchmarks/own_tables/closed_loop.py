"""A sampled controller on a table: is the loop stable, in which axis not, how still is the body, what the floor does.

`linearise` and `run` answer the same question by two routes (eigenvalues of the one-sample map; growth of what a small
push leaves in the nonlinear simulation) and know nothing of each other.
"""

import json
import math
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from .physics import (
    AXES,
    Accelerometer,
    Geophone,
    Record,
    State,
    Table,
    drive_matrix,
    floor_motion,
    sensor_matrix,
    simulate,
)
from .tables import truth


@dataclass(frozen=True)
class Controller:
    """x+ = A x + B y, u = C x + D y: sensor volts in, drive volts out, positive feedback, at the rig's rate."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    sample_rate_Hz: float
    inputs: tuple = ()
    outputs: tuple = ()
    delay_samples: float | None = None

    @classmethod
    def read(cls, path) -> "Controller":
        """From `controller.json` of an export. ValueError if its form is another."""
        d = json.loads(Path(path).read_text())
        if d.get("format") != "avis-sampled-controller":
            raise ValueError(f"{path}: format '{d.get('format')}', expected 'avis-sampled-controller'")
        ni, no = len(d["inputs"]), len(d["outputs"])
        n = len(d["A"])
        shapes = (("A", (n, n)), ("B", (n, ni)), ("C", (no, n)), ("D", (no, ni)))
        A, B, C, D = (np.array(d[k], float).reshape(s) for k, s in shapes)
        return cls(
            A, B, C, D, float(d["sample_rate_Hz"]), tuple(d["inputs"]), tuple(d["outputs"]), d.get("delay_samples")
        )

    def write(self, path, name="own") -> None:
        """In the same form, float64."""
        d = {"format": "avis-sampled-controller", "version": 1, "name": name, "arithmetic": "float64"}
        d |= {"sample_rate_Hz": self.sample_rate_Hz, "delay_samples": self.delay_samples}
        d |= {k: getattr(self, k).tolist() for k in "ABCD"} | {"inputs": self.inputs, "outputs": self.outputs}
        Path(path).write_text(json.dumps(d))

    def on(self, table: Table):
        """(A, B, C, D) in the order of the table's sensors and drives. ValueError if they do not belong together."""
        if abs(self.sample_rate_Hz - table.sample_rate_Hz) > 1e-6 * table.sample_rate_Hz:
            raise ValueError(f"controller at {self.sample_rate_Hz:g} Hz, table at {table.sample_rate_Hz:g} Hz")
        sensors, drives = [s.name for s in table.sensors], [d.name for d in table.drives]
        for what, own, theirs in (
            ("sensors", self.inputs or sensors, sensors),
            ("drives", self.outputs or drives, drives),
        ):
            if sorted(own) != sorted(theirs):
                raise ValueError(f"{what} of the controller {list(own)}, of the table {theirs}")
        i = [list(self.inputs or sensors).index(s) for s in sensors]
        o = [list(self.outputs or drives).index(d) for d in drives]
        return self.A, self.B[:, i], self.C[o], self.D[np.ix_(o, i)]

    def delay_s(self, table: Table, own_delay: bool) -> float | None:
        """The table's loop delay, or the one that the controller's file states."""
        return self.delay_samples * table.dt if own_delay and self.delay_samples is not None else None


def open_loop(table: Table) -> Controller:
    """No controller."""
    ns, nd = len(table.sensors), len(table.drives)
    return Controller(np.zeros((0, 0)), np.zeros((0, ns)), np.zeros((nd, 0)), np.zeros((nd, ns)), table.sample_rate_Hz)


def velocity_feedback(table: Table, damping_Ns_per_m: float) -> Controller:
    """The crude loop to try the bench with: every axis braked by what geophones and accelerometers take for velocity.

    Geophones count by their sensitivity without dynamics, accelerometers are summed up with a leak of 0.3 Hz; so it is
    stable only as far as they tell velocity. `table`: the nominal one. The damping applies to x, y, z; the turns get
    the same share of their inertia.
    """
    leak = math.exp(-2 * math.pi * 0.3 * table.dt)
    kinds = [type(s) for s in table.sensors]
    use = np.array(
        [k in (Geophone, Accelerometer) and s.on == "body" for k, s in zip(kinds, table.sensors, strict=True)]
    )
    volts = np.array([getattr(s, "sensitivity_Vs_per_m", 1.0) * getattr(s, "gain", 1.0) for s in table.sensors])
    volts *= [getattr(s, "sensitivity_Vs2_per_m", 1.0) for s in table.sensors]
    see = np.linalg.pinv((sensor_matrix(table) * volts[:, None])[use], rcond=0.05)
    share = np.diag(np.concatenate([np.ones(3), np.diag(table.inertia_kgm2) / table.mass_kg]))
    gain = np.zeros((len(table.drives), len(volts)))
    gain[:, use] = -damping_Ns_per_m * np.linalg.pinv(drive_matrix(table), rcond=0.05) @ share @ see
    summed = np.flatnonzero([k is Accelerometer for k in kinds])
    C, D = leak * gain[:, summed], gain
    D[:, summed] *= table.dt
    B = np.zeros((len(summed), len(volts)))
    B[np.arange(len(summed)), summed] = table.dt
    return Controller(leak * np.eye(len(summed)), B, C, D, table.sample_rate_Hz)


def lifted_map(
    table: Table, controller: Controller | None = None, own_delay: bool = False
) -> tuple[np.ndarray, list[str]]:
    """One-sample map of the closed loop about rest by central differences of the nonlinear model; names of its states.

    Drives and converter have no limits here: in some units of the controller's states a small step would saturate them.
    States: 6 of place (m, rad), 6 of velocity, amplifiers with a lag, sensors, commands under way, controller.
    """
    c = controller or open_loop(table)
    K, delay = c.on(table), c.delay_s(table, own_delay)
    table = replace(table, drives=tuple(replace(d, limit_V=1e12) for d in table.drives), adc_range_V=1e12)
    P = table.arrays
    nd, order = len(table.drives), P.B.shape[1]
    rest = State.rest(table, len(K[0]), delay)
    names = [*AXES, *("v_" + a for a in AXES)]
    used = []  # where in x the states beyond the body stand
    for k, d in enumerate(table.drives):
        if d.corner_Hz:
            used.append(13 + k)
            names.append(f"amplifier {d.name}")
    for k, s in enumerate(table.sensors):
        for j in range(len(s.filter()[1][0])):
            used.append(13 + nd + k * order + j)
            names.append(f"sensor {s.name}")
    names += [f"command {d.name}, {j + 1} before" for j in range(len(rest.past)) for d in table.drives]
    names += [f"controller {j}" for j in range(len(K[0]))]

    def after(z):
        state = rest.copy()
        place, angle, velocity, turn = z[:3], z[3:6], z[6:9], z[9:12]
        size = np.linalg.norm(angle)
        state.x[:3], state.x[7:10], state.x[10:13] = place, velocity, turn
        state.x[3], state.x[4:7] = np.cos(size / 2), 0.5 * angle * np.sinc(size / 2 / np.pi)
        n = 12 + len(used)
        state.x[used] = z[12:n]
        state.past[:] = z[n : n + state.past.size].reshape(state.past.shape)
        state.xc[:] = z[n + state.past.size :]
        simulate(table, np.zeros((1, nd)), controller=K, state=state, quantise=False, delay_s=delay, fineness=0.1)
        x = state.x
        v = np.linalg.norm(x[4:7])
        angle = 2 * x[4:7] * (np.arcsin(v) / v if v > 1e-9 else 1.0)
        return np.concatenate([x[:3], angle, x[7:13], x[used], state.past.ravel(), state.xc])

    step = np.full(len(names), 1e-4)  # small against limits and converter, large against rounding
    step[:12] = 1e-6
    columns = []
    for j, h in enumerate(step):
        z = np.zeros(len(names))
        z[j] = h
        columns.append((after(z) - after(-z)) / (2 * h))
    return np.array(columns).T, names


@dataclass(frozen=True)
class Mode:
    """One mode of the sampled loop."""

    magnitude: float  # of the eigenvalue, above 1: grows
    frequency_Hz: float
    growth_per_s: float
    shares: dict  # of the body's kinetic energy in the mode, per axis
    axis: str  # the largest of them


@dataclass(frozen=True)
class Linear:
    """Eigenvalues of the sampled loop."""

    spectral_radius: float
    stable: bool
    least_stable: Mode
    modes: tuple  # the ten least stable ones


def linearise(table: Table, controller: Controller | None = None, own_delay: bool = False, count: int = 10) -> Linear:
    """Spectral radius of the sampled closed loop and its least stable modes, hold, delay and sensors included."""
    A, _ = lifted_map(table, controller, own_delay)
    values, vectors = np.linalg.eig(A)
    weight = np.concatenate([np.full(3, table.mass_kg), np.diag(table.inertia_kgm2)])
    found = []
    for k in np.argsort(-abs(values)):
        if values[k].imag < 0:
            continue
        energy = weight * abs(vectors[6:12, k]) ** 2
        energy = energy / max(energy.sum(), 1e-300)
        size = abs(values[k])
        found.append(
            Mode(float(size), float(abs(np.angle(values[k])) / (2 * np.pi * table.dt)),
                 float(math.log(max(size, 1e-300)) / table.dt),
                 {a: round(float(e), 4) for a, e in zip(AXES, energy, strict=True)}, AXES[int(energy.argmax())])
        )  # fmt: skip
        if len(found) == count:
            break
    radius = float(abs(values).max())
    return Linear(radius, radius < 1.0, found[0], tuple(found))


@dataclass(frozen=True)
class Run:
    """What a nonlinear simulation of the closed loop showed."""

    stable: bool
    why: str
    growth_per_s: float  # of what a small push leaves, late in the run
    growing_axis: str  # where most of that is
    velocity_rms: dict  # per axis, m/s or rad/s, second half
    passive_rms: dict  # the same table, same floor, no controller
    saturated: float  # share of the second half with a drive at its limit
    overloaded: float  # share of the second half with a sensor beyond the converter
    largest_y_V: float


def _per_axis(values):
    return {a: float(v) for a, v in zip(AXES, values, strict=True)}


def run(table: Table, controller: Controller, seconds: float = 60.0, seed: int = 1, floor_rms: float | None = None,
        push_m_per_s: float = 1e-7, own_delay: bool = False) -> Run:  # fmt: skip
    """Nonlinear simulation from rest under floor motion and sensor noise: converter, hold, delay, limits; seeded.

    Stable: nothing left its mounts, no drive is at its limit and no sensor beyond the converter for more than a
    hundredth of the second half, and what a small push leaves does not grow. The last is told by a twin of the run with
    the same floor and noise but a small push of all axes at the start, both without converter; it sees a growth that
    takes minutes to show above the noise.
    """
    K, delay = controller.on(table), controller.delay_s(table, own_delay)
    N = round(seconds * table.sample_rate_Hz)
    silent = np.zeros((N, len(table.drives)))
    rms = table.floor_velocity_rms_m_per_s if floor_rms is None else floor_rms
    floor = floor_motion(N, table.dt, rms, np.random.default_rng([seed, 0]))

    def one(K, quantise, push):
        state = State.rest(table, len(K[0]) if K else 0, delay)
        state.x[7:13] += push * np.array([1.0, 1.0, 1.0, 2.0, 2.0, 2.0])
        rng = np.random.default_rng([seed, 1])
        return simulate(
            table, silent, floor=floor, rng=rng, controller=K, state=state, quantise=quantise, delay_s=delay
        )

    measured = one(K, True, 0.0)
    passive = one(None, True, 0.0)
    half = len(measured.u) // 2
    saturated = _share(abs(measured.u[half:]) >= 0.999 * table.limits)
    overloaded = _share(abs(measured.y[half:]) >= 0.999 * table.adc_range_V)
    a, b = one(K, False, 0.0), one(K, False, push_m_per_s)
    growth, axis = _growth(table, a, b, push_m_per_s)
    why = "the body left its mounts" if measured.left else ""
    if not why and saturated > 0.01:
        why = f"drives at their limit {100 * saturated:.0f} % of the time"
    if not why and overloaded > 0.01:
        why = f"converter overloaded {100 * overloaded:.0f} % of the time"
    if growth > 0.0:
        why = f"a small push grows by {growth:.3g} 1/s, most in {axis}" + (f"; {why}" if why else "")
    return Run(
        stable=not why,
        why=why or "a small push dies out",
        growth_per_s=growth,
        growing_axis=axis,
        velocity_rms=_per_axis(_rms(measured.velocity[half:])),
        passive_rms=_per_axis(_rms(passive.velocity[half:])),
        saturated=saturated,
        overloaded=overloaded,
        largest_y_V=float(abs(measured.y).max()),
    )


def _share(hit) -> float:
    return float(hit.any(axis=1).mean()) if hit.size else 0.0


def _growth(table: Table, a: Record, b: Record, push: float) -> tuple[float, str]:
    """Rate at which two runs part, 1/s, and the axis; before a drive reaches its limit, where growth would end.

    From the third to the fourth quarter of that time; nothing is taken for growth that is a millionth of the push.
    """
    N = min(len(a.u), len(b.u))
    limited = ((abs(a.u[:N]) >= 0.999 * table.limits) | (abs(b.u[:N]) >= 0.999 * table.limits)).any(axis=1)
    N = int(limited.argmax()) if limited.any() else N
    q = max(N // 4, 1)
    weight = np.sqrt(np.concatenate([np.full(3, table.mass_kg), np.diag(table.inertia_kgm2)]))
    d = (b.velocity - a.velocity)[: 4 * q] * weight
    third, last = _rms(d[2 * q : 3 * q]), _rms(d[3 * q :])
    floor = 1e-6 * push * np.linalg.norm(weight)
    growth = math.log(max(np.linalg.norm(last), floor) / max(np.linalg.norm(third), floor)) / (q * table.dt)
    return growth, AXES[int(last.argmax())]


def _rms(v):
    return np.sqrt((v**2).mean(axis=0))


def transmissibility(table: Table, controller: Controller | None = None, *, band=(0.4, 60.0), floor_rms: float = 2e-5,
                     period_s: float = 25.0, settle_periods: int = 2, seed: int = 1, noise: bool = False,
                     own_delay: bool = False):  # fmt: skip
    """Floor velocity to velocity of the centre of mass: (n,) frequencies in Hz and T (n, 6, 3), from floor x, y, z.

    The floor is shaken along one axis at a time by periodic band-limited noise; after `settle_periods` one period is
    transformed, so that no window is needed. For an unstable loop the numbers mean nothing: ask `linearise` first.
    """
    K = controller.on(table) if controller else None
    delay = controller.delay_s(table, own_delay) if controller else None
    n = round(period_s * table.sample_rate_Hz)
    f = np.fft.rfftfreq(n, table.dt)
    keep = (f >= band[0]) & (f <= band[1])
    T = np.zeros((keep.sum(), 6, 3), complex)
    for axis in range(3):
        floor = floor_motion(n, table.dt, floor_rms, np.random.default_rng([seed, axis]), band, (axis,))
        floor = np.vstack([np.tile(floor[:-1], (settle_periods + 1, 1)), floor[:1]])
        rng = np.random.default_rng([seed, axis, 1]) if noise else None
        silent = np.zeros((len(floor) - 1, len(table.drives)))
        result = simulate(table, silent, floor=floor, rng=rng, controller=K, quantise=noise, delay_s=delay)
        if result.left:
            raise ArithmeticError("the body left its mounts: the loop is unstable")
        shaken = np.fft.rfft(floor[-1 - n : -1, 6 + axis])[keep]
        T[:, :, axis] = np.fft.rfft(result.velocity[-n:], axis=0)[keep] / shaken[:, None]
    return f[keep], T


def peaks_dB(frequency, T) -> dict:
    """Largest transmissibility of x, y and z, each from its own floor axis, with its frequency in Hz."""
    out = {}
    for k, axis in enumerate(AXES[:3]):
        size = abs(T[:, k, k])
        at = int(size.argmax())
        out[axis] = (round(float(20 * np.log10(size[at])), 2), round(float(frequency[at]), 2))
    return out


if __name__ == "__main__":
    if len(sys.argv) not in (3, 4):
        sys.exit("usage: closed_loop TABLE controller.json [SEED]")
    table = truth(sys.argv[1], int(sys.argv[3]) if len(sys.argv) > 3 else 1)
    loop = Controller.read(sys.argv[2])
    linear, nonlinear = linearise(table, loop), run(table, loop)
    print(f"spectral radius {linear.spectral_radius:.7f}, least stable: {linear.least_stable}")
    print(f"{'stable' if nonlinear.stable else 'UNSTABLE'} in simulation: {nonlinear}")
    if linear.stable:
        print("peak transmissibility, dB at Hz:", peaks_dB(*transmissibility(table, loop)))
