"""The spring-suspended Halcyonics table (Beadle, Hurlebaus, Stoebener, Gaul), eqs. 1-32 corrected.

The matrices are those of eqs. 16-19 with the misprints of the source corrected (each has a test):
second derivatives in eq. 4, K(4,4) = (k_a + k_s) L_2^2 + 2 k_a L_6^2, E(3,1..4) = e_i.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.rigs.equipment import Accelerometers, Ambient, Electronics
from avis_ctrl.rigs.instruments import AccelerometerAt, Tolerances, triple
from avis_ctrl.rigs.mounted_body import Mount, MountedBody, PointActuator
from avis_ctrl.rigs.rig import Parameter, Place, Rig
from avis_ctrl.rigs.rigid_body import EquationsOfMotion, cross_matrix, point_map

_ROOT_HALF = np.sqrt(0.5)
# Signs of (x, y): corners at which actuator A_i and spring i are placed, and force directions of A5..A8.
CORNERS = np.array([[1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]])
_PUSH = np.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])
# A5..A8 are placed at (+-1/2, +-1/2) (L4 + L5): E determines only their lines of action, not the points along them.
_STAND = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


@dataclass(frozen=True)
class Load:
    """Equipment on the plate: centre of mass (L7, L8, L9) [m] from the plate's, inertia about its own [kg m^2].

    Ixy, Ixz, Iyz are products of inertia with the sign of eq. 11 (the tensor has -Ixy). Table 2 prints
    I_xx + I^e_xx, without the terms m_e L^2 of eq. 16. Only this interpretation is physically possible with the
    table's "actual values": it gives I^e = (0.115, 0.115, 0.230) with Ixy = 0.115 and principal moments
    (0, 0.230, 0.230), a slender rod at 45 degrees, the limiting case of a rigid body. If the printed totals included
    m_e L^2, a load of 10 kg would have moments of -0.005 kg m^2 about x and y.
    """

    mass: float
    L7: float
    L8: float
    L9: float
    Ixx: float
    Iyy: float
    Izz: float
    Ixy: float = 0.0
    Ixz: float = 0.0
    Iyz: float = 0.0

    def position(self) -> np.ndarray:
        """Centre of mass (3,) [m] relative to that of the plate."""
        return np.array([self.L7, self.L8, self.L9])

    def inertia(self) -> np.ndarray:
        """(3, 3) tensor about the load's own centre of mass, eq. 11."""
        return np.array(
            [[self.Ixx, -self.Ixy, -self.Ixz], [-self.Ixy, self.Iyy, -self.Iyz], [-self.Ixz, -self.Iyz, self.Izz]]
        )


@dataclass(frozen=True)
class ReactionMass:
    """Freely vibrating actuator of section 2.2: mass [kg], damping [N s/m], force constant [N/V]."""

    mass: float
    damping: float
    constant_N_per_V: float


_SCALARS = {  # field: unit, description
    "mass": ("kg", "mass m of the upper plate"),
    "Ixx": ("kg m^2", "inertia of the plate"),
    "Iyy": ("kg m^2", "inertia of the plate"),
    "Izz": ("kg m^2", "inertia of the plate"),
    "L1": ("m", "distance of the springs along x"),
    "L2": ("m", "distance of the springs along y"),
    "L3": ("m", "places the vertical actuators: arm L3 - L1/2 along x"),
    "L4_plus_L5": ("m", "places the horizontal actuators: yaw arm (L4 + L5)/sqrt(2)"),
    "L6": ("m", "height of the centre of mass above the horizontal actuators"),
    "k_a": ("N/m", "stiffness of an actuator"),
    "k_t": ("N/m", "transverse stiffness of the suspension"),
    "k_r": ("N m/rad", "yaw stiffness of the suspension"),
    "d1": ("N s/m", "damping along x and along y"),
    "d3": ("N s/m", "damping along z"),
    "d4": ("N m s/rad", "damping of phi_x"),
    "d5": ("N m s/rad", "damping of phi_y"),
    "d6": ("N m s/rad", "damping of phi_z"),
    "M2_arm": ("m", "measured point M2 from the centre of mass, along x (assumed)"),
    "M3_arm": ("m", "measured point M3 from the centre of mass, along y (assumed)"),
}
_LOAD_UNITS = {"mass": "kg", "L7": "m", "L8": "m", "L9": "m"}


@dataclass(frozen=True)
class Halcyonics(Rig):
    """The table; SI units, symbols of the source.

    k_s : the four vertical spring stiffnesses, spring i at the corner of actuator A_i. The source has
        one value for all; separate values allow an independent uncertainty of each mount.
    e : force constants e_1..e_8 [N/V]; load : None when the plate is bare.
    Coordinates are those of the bare plate's centre of mass (eq. 16), loaded or not.
    """

    name: str
    mass: float
    Ixx: float
    Iyy: float
    Izz: float
    L1: float
    L2: float
    L3: float
    L4_plus_L5: float
    L6: float
    k_s: tuple[float, ...]
    k_a: float
    k_t: float
    k_r: float
    d1: float
    d3: float
    d4: float
    d5: float
    d6: float
    e: tuple[float, ...]
    actuator_names: tuple[str, ...]
    reaction: ReactionMass
    accelerometers: Accelerometers
    load: Load | None = None
    M2_arm: float = 0.2
    M3_arm: float = 0.15
    ambient: Ambient | None = None
    tolerances: Tolerances | None = None
    electronics: Electronics = field(default_factory=Electronics)

    def __post_init__(self) -> None:
        if len(self.k_s) != 4 or len(self.e) != 8 or len(self.actuator_names) != 8:
            raise InputError(f"expected 4 springs and 8 actuators, got {len(self.k_s)}, {len(self.e)}", field="k_s, e")
        plate = np.array([self.mass, self.Ixx, self.Iyy, self.Izz])
        if not np.all(np.isfinite(plate)) or np.any(plate <= 0) or np.min(np.linalg.eigvalsh(self.mass_matrix())) <= 0:
            raise InputError(
                "expected positive mass and inertia [kg, kg m^2]", field="mass, Ixx, Iyy, Izz", value=plate.tolist()
            )

    @property
    def edge_m(self) -> float:
        """Lever arm L2/2 along y of the springs and the vertical actuators."""
        return self.L2 / 2

    @property
    def drive_limit_V(self) -> float:
        return self.accelerometers.drive_limit_V

    def with_drives_limited(self, limit_V: float) -> Halcyonics:
        return replace(
            self, accelerometers=replace(self.accelerometers, drive_limit_V=min(self.drive_limit_V, limit_V))
        )

    def mass_matrix(self) -> np.ndarray:
        """M of eq. 16."""
        M = np.diag([self.mass] * 3 + [self.Ixx, self.Iyy, self.Izz])
        if self.load is not None:
            G = point_map(self.load.position())
            M += self.load.mass * G.T @ G
            M[3:, 3:] += self.load.inertia()
        return M

    def damping_matrix(self) -> np.ndarray:
        """D of eq. 17."""
        return np.diag([self.d1, self.d1, self.d3, self.d4, self.d5, self.d6])

    def stiffness_matrix(self) -> np.ndarray:
        """K of eq. 18, corrected; the sums over k_s become 4 k_s, 0, k_s L2^2, k_s L1^2 for equal springs."""
        k_a, k_s, L6 = self.k_a, np.array(self.k_s), self.L6
        x, y = CORNERS[:, 0] * self.L1 / 2, CORNERS[:, 1] * self.L2 / 2
        K = np.diag(
            [
                2 * k_a + self.k_t,
                2 * k_a + self.k_t,
                4 * k_a + k_s.sum(),
                k_a * self.L2**2 + k_s @ y**2 + 2 * k_a * L6**2,
                k_a * ((self.L1 - 2 * self.L3) ** 2 + 2 * L6**2) + k_s @ x**2,
                2 * k_a * self.L4_plus_L5**2 + self.k_r,
            ]
        )
        K[0, 4] = K[4, 0] = -2 * k_a * L6
        K[1, 3] = K[3, 1] = 2 * k_a * L6
        K[2, 3] = K[3, 2] = k_s @ y
        K[2, 4] = K[4, 2] = -k_s @ x
        K[3, 4] = K[4, 3] = -k_s @ (x * y)
        return K

    def actuator_matrix(self) -> np.ndarray:
        """E of eq. 19, corrected, (6, 8) in N/V and N m/V."""
        a, b, r = self.L3 - self.L1 / 2, self.L2 / 2, _ROOT_HALF
        h, g = self.L6 * r, self.L4_plus_L5 * r
        return np.array(
            [
                [0, 0, 0, 0, -r, r, r, -r],
                [0, 0, 0, 0, r, r, -r, -r],
                [1, 1, 1, 1, 0, 0, 0, 0],
                [-b, -b, b, b, h, h, -h, -h],
                [-a, a, a, -a, h, -h, -h, h],
                [0, 0, 0, 0, -g, g, -g, g],
            ]
        ) * np.array(self.e)

    def equations_of_motion(self) -> EquationsOfMotion:
        """Eq. 15: the floor acts through the same K and D as the plate."""
        D, K = self.damping_matrix(), self.stiffness_matrix()
        return EquationsOfMotion(self.mass_matrix(), D, K, D, K, self.actuator_matrix(), self.actuator_names)

    def actuator_axes(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Position (3,) [m] and unit direction (3,) of each actuator's force, A1..A8."""
        a, b, s = self.L3 - self.L1 / 2, self.L2 / 2, self.L4_plus_L5 / 2
        places = [np.array([cx * a, cy * b, 0.0]) for cx, cy in CORNERS]
        places += [np.array([cx * s, cy * s, -self.L6]) for cx, cy in _STAND]
        directions = [np.array([0.0, 0.0, 1.0])] * 4 + [np.array([px, py, 0.0]) * _ROOT_HALF for px, py in _PUSH]
        return dict(zip(self.actuator_names, zip(places, directions, strict=True), strict=True))

    def mounted_body(self) -> MountedBody:
        """The rig described by positions: springs at (+-L1/2, +-L2/2), actuators as springs along their axes."""
        z = np.diag([0.0, 0.0, 1.0])
        corners = [np.array([cx * self.L1 / 2, cy * self.L2 / 2, 0.0]) for cx, cy in CORNERS]
        mounts = [
            Mount(f"spring{k}", place, place, stiffness * z, np.zeros((3, 3)))
            for k, (place, stiffness) in enumerate(zip(corners, self.k_s, strict=True), 1)
        ]
        axes = self.actuator_axes()
        mounts += [
            Mount(name, place, place, self.k_a * np.outer(n, n), np.zeros((3, 3))) for name, (place, n) in axes.items()
        ]
        actuators = tuple(
            PointActuator(name, place, n, e) for (name, (place, n)), e in zip(axes.items(), self.e, strict=True)
        )
        mass, inertia, centre = self._rigid_body()
        suspension = np.diag([self.k_t, self.k_t, 0.0, 0.0, 0.0, self.k_r])
        return MountedBody(mass, inertia, centre, tuple(mounts), actuators, suspension, self.damping_matrix())

    def _rigid_body(self) -> tuple[float, np.ndarray, np.ndarray]:
        """Mass, inertia about the common centre of mass, and this centre, of plate and load."""
        plate = np.diag([self.Ixx, self.Iyy, self.Izz])
        if self.load is None:
            return self.mass, plate, np.zeros(3)
        total = self.mass + self.load.mass
        centre = self.load.mass / total * self.load.position()
        to_plate, to_load = cross_matrix(-centre), cross_matrix(self.load.position() - centre)
        inertia = plate - self.mass * to_plate @ to_plate + self.load.inertia() - self.load.mass * to_load @ to_load
        return total, inertia, centre

    def points(self) -> dict[str, Place]:
        found = {m.name: Place(m.position, "isolator") for m in self.mounted_body().mounts[:4]}
        found |= {name: Place(place, "actuator") for name, (place, _) in self.actuator_axes().items()}
        found |= {name: Place(place, "sensor") for name, (place, _) in self.sensor_axes().items()}
        found |= {
            "M1": Place(np.zeros(3), "measured point"),
            "M2": Place(np.array([self.M2_arm, 0.0, 0.0]), "measured point"),
            "M3": Place(np.array([0.0, self.M3_arm, 0.0]), "measured point"),
            "centre of mass": Place(self._rigid_body()[2], "centre of mass"),
        }
        return found | ({"load": Place(self.load.position(), "load")} if self.load else {})

    @cached_property
    def all_instruments(self) -> tuple[AccelerometerAt, ...]:
        """The built-in accelerometers (section 3.1): "acc_A1" at actuator A1 along its axis, and so on."""
        axes, acc = self.actuator_axes(), self.accelerometers
        chain = (acc.sensitivity_Vs2_per_m, acc.low_corner_Hz, acc.noise_m_per_s2_rtHz)
        return tuple(
            AccelerometerAt(f"acc_{name}", triple(axes[name][0]), triple(axes[name][1]), *chain) for name in acc.at
        )

    def force_constant(self, actuator: str) -> str:
        return f"e{self.actuator_names.index(actuator) + 1}"

    def parameters(self) -> dict[str, Parameter]:
        """Symbols of the source; k_s1..k_s4 by corner (k_s: their mean), e1..e8, load.mass, load.L7, load.Ixx .."""
        found = {name: Parameter(getattr(self, name), unit, text) for name, (unit, text) in _SCALARS.items()}
        found["k_s"] = Parameter(float(np.mean(self.k_s)), "N/m", "vertical stiffness of each suspension spring")
        for k, value in enumerate(self.k_s, 1):
            found[f"k_s{k}"] = Parameter(value, "N/m", f"vertical stiffness of the spring at the corner of A{k}")
        for k, value in enumerate(self.e, 1):
            found[f"e{k}"] = Parameter(value, "N/V", f"force constant of actuator A{k}")
        if self.load is not None:
            for one in fields(self.load):
                unit = _LOAD_UNITS.get(one.name, "kg m^2")
                found[f"load.{one.name}"] = Parameter(getattr(self.load, one.name), unit, f"{one.name} of the load")
        return found

    def _with_values(self, values: dict[str, float]) -> Halcyonics:
        """`k_s` sets all four springs; k_s1..k_s4, if given, take precedence."""
        springs = tuple(values.get(f"k_s{k}", values.get("k_s", old)) for k, old in enumerate(self.k_s, 1))
        constants = tuple(values.get(f"e{k}", old) for k, old in enumerate(self.e, 1))
        load = self.load and replace(
            self.load,
            **{name.removeprefix("load."): value for name, value in values.items() if name.startswith("load.")},
        )
        plain: dict[str, Any] = {name: value for name, value in values.items() if name in _SCALARS}
        return replace(self, k_s=springs, e=constants, load=load, **plain)
