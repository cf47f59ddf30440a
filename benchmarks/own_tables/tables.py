"""Five tables of a user's own: nominal, as a rig file says, and true, within tolerances.

`python -m benchmarks.own_tables.tables` prints the nominal ones as TOML.
"""

import sys
from dataclasses import dataclass, fields, replace

import numpy as np

from .physics import (
    AXES,
    Accelerometer,
    Drive,
    Geophone,
    Mount,
    PositionSensor,
    Table,
    drive_matrix,
    rigid,
    sensor_matrix,
)

X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Tolerances:
    """One standard deviation of what a rig file states: drawings, scales and calibration sheets of such a table."""

    mass_percent: float = 1.0
    inertia_percent: float = 3.0
    product_of_inertia_share: float = 0.005  # of the mean moment of inertia
    stiffness_percent: float = 5.0
    damping_percent: float = 15.0
    centre_of_mass_m: float = 0.001
    place_m: float = 0.001
    direction_rad: float = 0.005
    actuator_gain_percent: float = 1.0
    sensor_gain_percent: float = 1.0
    sensor_corner_percent: float = 1.0
    sensor_damping_percent: float = 3.0


def _turned(degrees, up=0.0) -> tuple:
    """Unit vector at `degrees` from x towards y, `up` degrees above the horizontal; rounded as a drawing has it."""
    a, e = np.radians(degrees), np.radians(up)
    return tuple(round(float(v), 4) for v in (np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)))


def _at(radius, degrees, height) -> tuple:
    a = np.radians(degrees)
    return tuple(round(float(v), 4) for v in (radius * np.cos(a), radius * np.sin(a), height))


def tripod() -> Table:
    """200 kg on three legs, a vertical and a tangential drive and 1 Hz geophone in each; uncompensated geophones."""
    angles = (90.0, 210.0, 330.0)
    mounts = tuple(
        Mount(_at(0.45, a, -0.12), (h, h2, v), (ch, ch2, cv))
        for a, (h, h2, v), (ch, ch2, cv) in zip(
            angles,
            ((8400.0, 8700.0, 16400.0), (8700.0, 8400.0, 16900.0), (8500.0, 8600.0, 15900.0)),
            ((45.0, 46.0, 62.0), (47.0, 45.0, 65.0), (44.0, 47.0, 60.0)),
            strict=True,
        )
    )
    drives, sensors = [], []
    for leg, a in enumerate(angles, 1):
        drives += [
            Drive(f"V{leg}", _at(0.41, a, -0.10), Z, 3.0),
            Drive(f"H{leg}", _at(0.45, a, -0.08), _turned(a + 90), 3.0),
        ]
        for name, place, d in (
            (f"GV{leg}", _at(0.47, a, -0.05), Z),
            (f"GH{leg}", _at(0.47, a, -0.06), _turned(a + 90)),
        ):
            sensors.append(Geophone(name, place, d, 80.0, 1.0, 0.6, 300.0, noise_rms_V=2e-3))
    J = np.diag([12.9, 13.4, 24.8])
    return Table(
        "tripod", 200.0, J, (0.0, 0.0, 0.0), mounts, tuple(drives), tuple(sensors), 1000.0, 16, 10.0, 0.001, 5e-6
    )


def four_vertical() -> Table:
    """80 kg on four mounts, four vertical drives and geophones only: x, y and the turn about z stay passive."""
    corners = ((-0.30, -0.22), (0.30, -0.22), (0.30, 0.22), (-0.30, 0.22))
    stiff = (
        (19500.0, 20000.0, 12400.0),
        (20000.0, 19500.0, 12900.0),
        (19700.0, 19900.0, 12200.0),
        (19900.0, 19600.0, 12800.0),
    )
    damp = ((38.0, 38.0, 28.0), (39.0, 37.0, 30.0), (38.0, 38.0, 27.0), (37.0, 39.0, 29.0))
    mounts = tuple(Mount((x, y, -0.06), k, c) for (x, y), k, c in zip(corners, stiff, damp, strict=True))
    drives = tuple(Drive(f"V{i}", (x * 0.9, y * 0.9, -0.05), Z, 1.5) for i, (x, y) in enumerate(corners, 1))
    sensors = tuple(
        Geophone(f"G{i}", (round(x * 1.1, 3), round(y * 1.1, 3), 0.02), Z, 28.8, 4.5, 0.56, 500.0, 0.8, 0.7, 2e-3)
        for i, (x, y) in enumerate(corners, 1)
    )
    J = np.diag([2.47, 4.33, 6.67])
    return Table("four_vertical", 80.0, J, (0.0, 0.0, 0.0), mounts, drives, sensors, 1000.0, 14, 10.0, 0.001, 5e-6)


def twelve_sensors() -> Table:
    """350 kg, loaded off centre, on four mounts; eight drives, eight geophones and four accelerometers."""
    places = ((-0.60, -0.40), (0.60, -0.40), (0.50, 0.40), (-0.50, 0.40))
    stiff = (
        (26000.0, 25000.0, 38000.0),
        (25500.0, 26500.0, 40000.0),
        (27000.0, 25500.0, 36500.0),
        (25000.0, 26000.0, 39000.0),
    )
    damp = ((95.0, 92.0, 130.0), (93.0, 96.0, 138.0), (98.0, 94.0, 126.0), (92.0, 95.0, 134.0))
    mounts = tuple(Mount((x, y, -0.15), k, c) for (x, y), k, c in zip(places, stiff, damp, strict=True))
    drives = [
        Drive(f"V{i}", (x, y, -0.10), Z, 4.0)
        for i, (x, y) in enumerate(((-0.55, -0.35), (0.55, -0.35), (0.45, 0.35), (-0.45, 0.35)), 1)
    ]
    sides = ((0.0, -0.42, X), (0.58, 0.0, Y), (0.0, 0.42, (-1.0, 0.0, 0.0)), (-0.52, 0.0, (0.0, -1.0, 0.0)))
    drives += [Drive(f"H{i}", (x, y, -0.05), d, 4.0) for i, (x, y, d) in enumerate(sides, 1)]
    sensors = [
        Geophone(f"G{n}", p, d, 60.0, 2.0, 0.6, 200.0, 0.4, 0.7, 2e-3)
        for n, p, d in (
            ("v1", (-0.62, -0.42, 0.0), Z), ("v2", (0.62, -0.42, 0.0), Z),
            ("v3", (0.52, 0.42, 0.0), Z), ("v4", (-0.52, 0.42, 0.0), Z),
            ("x1", (0.0, -0.40, -0.02), X), ("y1", (0.56, 0.0, -0.02), Y),
            ("x2", (0.0, 0.40, -0.02), X), ("y2", (-0.50, 0.0, -0.02), Y),
        )
    ]  # fmt: skip
    sensors += [
        Accelerometer(f"A{n}", p, d, 100.0, 0.3, 3e-3)
        for n, p, d in (
            ("z1", (0.30, -0.20, 0.08), Z),
            ("z2", (-0.30, 0.20, 0.08), Z),
            ("x1", (0.0, 0.25, 0.08), X),
            ("y1", (0.25, 0.0, 0.08), Y),
        )
    ]
    J = np.array([[24.0, -0.4, 0.3], [-0.4, 42.0, -0.2], [0.3, -0.2, 60.0]])
    return Table(
        "twelve_sensors",
        350.0,
        J,
        (0.02, -0.03, 0.05),
        mounts,
        tuple(drives),
        tuple(sensors),
        2000.0,
        16,
        10.0,
        0.00075,
        4e-6,
    )


def skewed() -> Table:
    """120 kg on four stiff mounts; six drives like a hexapod's legs, each with an accelerometer; lagging amplifiers."""
    corners = ((-0.35, -0.28), (0.35, -0.28), (0.35, 0.28), (-0.35, 0.28))
    stiff = ((75e3, 77e3, 168e3), (77e3, 75e3, 174e3), (76e3, 76e3, 165e3), (74e3, 78e3, 172e3))
    damp = ((70.0, 72.0, 110.0), (72.0, 70.0, 116.0), (71.0, 71.0, 108.0), (69.0, 73.0, 113.0))
    mounts = tuple(Mount((x, y, -0.10), k, c) for (x, y), k, c in zip(corners, stiff, damp, strict=True))
    feet = ((20.0, 110.0), (100.0, 10.0), (140.0, 230.0), (220.0, 130.0), (260.0, 350.0), (340.0, 250.0))  # place, lean
    drives = tuple(
        Drive(f"L{i}", _at(0.32, a, -0.06), _turned(b, 45.0), 5.0, corner_Hz=300.0) for i, (a, b) in enumerate(feet, 1)
    )
    sensors = tuple(
        Accelerometer(f"A{i}", _at(0.34, a, -0.02), _turned(b, 45.0), 100.0, 0.3, 3e-3)
        for i, (a, b) in enumerate(feet, 1)
    )
    J = np.diag([6.6, 9.4, 11.2])
    return Table("skewed", 120.0, J, (0.0, 0.0, 0.03), mounts, drives, sensors, 2000.0, 18, 10.0, 0.00065, 5e-6)


def granite() -> Table:
    """3 t of granite on twelve mounts; eight drives, six position sensors against the floor and four geophones."""
    grid = [(x, y) for y in (-0.7, 0.0, 0.7) for x in (-1.2, -0.4, 0.4, 1.2)]
    share = (1.03, 0.98, 1.01, 0.97, 1.02, 0.99, 1.00, 1.04, 0.96, 1.01, 0.98, 1.01)  # unevenness of the mounts
    mounts = tuple(
        Mount(
            (x, y, -0.25),
            tuple(round(k * s, -1) for k in (25300.0, 25300.0, 47800.0)),
            tuple(round(c * s, 1) for c in (140.0, 140.0, 230.0)),
        )
        for (x, y), s in zip(grid, share, strict=True)
    )
    drives = [
        Drive(f"V{i}", (x, y, -0.25), Z, 40.0)
        for i, (x, y) in enumerate(((-1.0, -0.6), (1.0, -0.6), (1.0, 0.6), (-1.0, 0.6)), 1)
    ]
    drives += [
        Drive(n, p, d, 40.0)
        for n, p, d in (
            ("X1", (-1.3, -0.5, -0.1), X),
            ("X2", (1.3, 0.5, -0.1), X),
            ("Y1", (1.0, -0.8, -0.1), Y),
            ("Y2", (-1.0, 0.8, -0.1), Y),
        )
    ]
    sensors = [
        PositionSensor(f"P{n}", p, d, 2e4, 5e-4, 500.0)
        for n, p, d in (("z1", (-1.3, -0.8, -0.2), Z), ("z2", (1.3, -0.8, -0.2), Z), ("z3", (0.0, 0.8, -0.2), Z),
                        ("x1", (1.35, 0.0, -0.2), X), ("y1", (-1.0, 0.85, -0.2), Y), ("y2", (1.0, 0.85, -0.2), Y))
    ]  # fmt: skip
    sensors += [
        Geophone(f"G{n}", p, d, 100.0, 1.0, 0.7, 200.0, noise_rms_V=2e-3)
        for n, p, d in (
            ("z1", (-1.0, 0.0, 0.0), Z),
            ("z2", (1.0, 0.3, 0.0), Z),
            ("x1", (0.0, -0.5, 0.0), X),
            ("y1", (0.3, 0.0, 0.0), Y),
        )
    ]
    J = np.diag([872.0, 2022.0, 2770.0])
    return Table(
        "granite", 3000.0, J, (0.0, 0.0, 0.0), mounts, tuple(drives), tuple(sensors), 1000.0, 16, 10.0, 0.001, 4e-6
    )


NOMINAL = {f.__name__: f for f in (tripod, four_vertical, twelve_sensors, skewed, granite)}


def perturbed(table: Table, rng: np.random.Generator, tolerances: Tolerances | None = None) -> Table:
    """One table as it may really be: everything that the rig file states, off by a normal draw."""
    t = tolerances or Tolerances()

    def off(percent, size=None):
        return 1.0 + 0.01 * percent * rng.standard_normal(size)

    def place(p):
        return tuple(np.add(p, t.place_m * rng.standard_normal(3)))

    def direction(d):
        d = np.array(d, float) / np.linalg.norm(d)
        return tuple(d + np.cross(t.direction_rad * rng.standard_normal(3), d))

    def sensor(s):
        changes = {"position_m": place(s.position_m), "direction": direction(s.direction)}
        for f in fields(s):
            value = getattr(s, f.name)
            if f.name.startswith("sensitivity"):
                changes[f.name] = value * off(t.sensor_gain_percent)
            elif f.name in ("corner_Hz", "low_corner_Hz") and value is not None:
                changes[f.name] = value * off(t.sensor_corner_percent)
            elif f.name == "damping":
                changes[f.name] = value * off(t.sensor_damping_percent)
        if isinstance(s, Geophone) and s.compensated_Hz is not None:
            changes["trimmed"] = (s.corner_Hz, s.damping)  # the compensation is made for the nominal geophone
        return replace(s, **changes)

    e = rng.standard_normal((3, 3)) * t.product_of_inertia_share * np.trace(table.inertia_kgm2) / 3
    scale = np.sqrt(off(t.inertia_percent, 3))
    J = table.inertia_kgm2 * np.outer(scale, scale) + np.triu(e, 1) + np.triu(e, 1).T
    return replace(
        table,
        mass_kg=float(table.mass_kg * off(t.mass_percent)),
        inertia_kgm2=J,
        centre_of_mass_m=tuple(np.add(table.centre_of_mass_m, t.centre_of_mass_m * rng.standard_normal(3))),
        mounts=tuple(
            replace(m, position_m=place(m.position_m),
                    stiffness_N_per_m=tuple(m.stiffness_N_per_m * off(t.stiffness_percent, 3)),
                    damping_Ns_per_m=tuple(m.damping_Ns_per_m * np.maximum(off(t.damping_percent, 3), 0.2)))
            for m in table.mounts
        ),
        drives=tuple(
            replace(d, position_m=place(d.position_m), direction=direction(d.direction),
                    constant_N_per_V=float(d.constant_N_per_V * off(t.actuator_gain_percent)))
            for d in table.drives
        ),
        sensors=tuple(sensor(s) for s in table.sensors),
    )  # fmt: skip


def truth(name: str, seed: int) -> Table:
    """The table called `name` as it really is, draw `seed`."""
    return perturbed(NOMINAL[name](), np.random.default_rng([seed, list(NOMINAL).index(name)]))


def modes(table: Table):
    """Natural frequencies (Hz) and damping ratios of the body on its mounts, rising."""
    M, C, K = rigid(table)
    A = np.block([[np.zeros((6, 6)), np.eye(6)], [-np.linalg.solve(M, K), -np.linalg.solve(M, C)]])
    s = np.linalg.eigvals(A)
    s = s[s.imag > 0]
    s = s[np.argsort(abs(s))]
    return abs(s) / (2 * np.pi), -s.real / abs(s)


def _toml(value) -> str:
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, np.ndarray | tuple | list):
        return "[" + ", ".join(_toml(v) for v in value) + "]"
    return f"{float(value):.6g}" if not isinstance(value, int) else str(value)


def describe(table: Table) -> str:
    """The numbers of a table as TOML, one line per mount, drive and sensor; the keys are the names of the fields."""
    f, z = modes(table)
    rank = np.linalg.matrix_rank(drive_matrix(table), tol=1e-6)
    seen = np.linalg.matrix_rank(sensor_matrix(table), tol=1e-6)
    lines = [f"# {NOMINAL[table.name].__doc__}" if table.name in NOMINAL else "#",
             "# modes: " + ", ".join(f"{a:.2f} Hz ({100 * b:.1f} %)" for a, b in zip(f, z, strict=True)),
             f"# drives reach {rank} and sensors see {seen} of {len(AXES)} axes"]  # fmt: skip
    for key in ("name", "mass_kg", "inertia_kgm2", "centre_of_mass_m", "sample_rate_Hz", "adc_bits", "adc_range_V",
                "loop_delay_s", "floor_velocity_rms_m_per_s"):  # fmt: skip
        lines.append(f"{key} = {_toml(getattr(table, key))}")
    for group in ("mounts", "drives", "sensors"):
        lines.append(f"{group} = [")
        for item in getattr(table, group):
            entries = {k: v for k, v in vars(item).items() if v is not None and k != "frame"}
            if entries.get("compensated_Hz") is None:
                entries.pop("compensated_damping", None)
            kind = f'kind = "{type(item).__name__}", ' if group == "sensors" else ""
            lines.append("  {" + kind + ", ".join(f"{k} = {_toml(v)}" for k, v in entries.items()) + "},")
        lines.append("]")
    return "\n".join(lines)


if __name__ == "__main__":
    for name in sys.argv[1:] or NOMINAL:
        print(describe(NOMINAL[name]()) + "\n")
