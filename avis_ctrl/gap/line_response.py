"""A table on the lines of a whole record: the linear part of a simulation in time.

A record from rest is put before silence of at least its own length and `quiet_s`, so that what the discrete Fourier
transform wraps around has died out. The responses are those of `TableModel`: hold, delay and aliases included, the
floor's velocity band-limited between its samples. At frequency zero, where displacement by velocity of the floor and
an integrating loop are infinite while what is read is not, the line is taken at `lowest_line` of the line spacing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.fft

from avis_ctrl.errors import InputError
from avis_ctrl.gap.operators import Assembled
from avis_ctrl.gap.table_model import TableModel
from avis_ctrl.identification.response import N_Q


@dataclass(frozen=True)
class RecordLineSettings:
    """Of a whole record on the lines of its transform.

    quiet_s : silence behind a record [s]: with 1 % of damping at 1.5 Hz, motion falls to 0.4 % of itself.
    highest_Hz : lines above this are taken as zero [Hz]: a table moves there by its mass alone, and little.
    lowest_line : where the line at frequency zero is taken [line spacings].
    chunk : lines of which the dynamic stiffness is formed at once: memory.
    most_samples : samples of a record beyond which it does not fit into memory in one piece (padded: some 1.5 kB a
        sample).
    """

    quiet_s: float = 60.0
    highest_Hz: float = 500.0
    lowest_line: float = 0.01
    chunk: int = 8192
    most_samples: int = 1_000_000


SETTINGS = RecordLineSettings()


class LineResponse:
    """The table on lines of a padded record.

    Attributes
    ----------
    samples, padded : of a record, without and with silence. omega : (n,) rad/s of the lines kept, from zero on.
    compliance : (n, n_q, n_q) inverse dynamic stiffness. rows : (1 or n, n_y, n_q) what each sensor sees of x, and
        sense : (n, n_y) its chain, sensitivity included.
    volts : (n, n_u) commanded to acting volts. alias_drive : (1 or n, n_u) of volts, alias_map : (n_y, n_u) and
        alias : (n, n_y) what sampling folds. against : (n_y, 6) rows of sensors that read against the chassis, zero for
        the others.
    floor : (n, n_q, 3) force, chassis : (n, 6, 3) displacement by velocity of the floor. recoil : (n, 6, n_q) or None,
        displacement of the chassis towards the payload by x.
    T : (n_q, n_u). G, G_c : (n_g, n_q) and (n_g, 6), deflection by x and chassis.
    """

    def __init__(self, model: TableModel, samples: int, padded: int, sample_rate_Hz: float):
        self.samples, self.padded, self.sample_rate_Hz = samples, padded, sample_rate_Hz
        spacing = 2 * np.pi * sample_rate_Hz / padded
        n = min(padded // 2 + 1, int(SETTINGS.highest_Hz * padded / sample_rate_Hz) + 1)
        self.omega = spacing * np.arange(n)
        self.omega[0] = SETTINGS.lowest_line * spacing
        made: dict[str, np.ndarray] = {}
        for k in range(0, n, SETTINGS.chunk):
            for name, part in _lines(Assembled(model.operators(self.omega[k:k + SETTINGS.chunk]))).items():
                if name not in made:
                    made[name] = np.empty((n if len(part) > 1 else 1, *part.shape[1:]), part.dtype)
                made[name][k:k + SETTINGS.chunk] = part
        self.compliance, self.rows, self.sense = made["compliance"], made["rows"], made["sense"]
        self.volts, self.alias, self.alias_drive = made["volts"], made["alias"], made["alias_drive"]
        self.floor, self.chassis, self.recoil = made["floor"], made["chassis"], made.get("recoil")
        first, mat = Assembled(model.operators(self.omega[:1])), model.matrices
        gain = (first.ops.base.sensors.sensitivity * first.ops.sensor_gain)[:, None]
        self.alias_map = gain * (mat.R @ np.linalg.inv(mat.M) @ mat.T)
        self.against = mat.R * first.ops.base.sensors.relative[:, None]
        self.T, self.G, self.G_c = first.T.real, first.G, first.ops.mounts.chassis

    def spectrum(self, samples: np.ndarray) -> np.ndarray:
        """(n, m) of (samples, m) from rest."""
        return scipy.fft.rfft(samples, self.padded, axis=0)[:len(self.omega)]

    def in_time(self, spectrum: np.ndarray) -> np.ndarray:
        """(samples, m) of (n, m)."""
        return scipy.fft.irfft(spectrum, self.padded, axis=0)[:self.samples]

    def drive(self, u: np.ndarray, floor: np.ndarray | None) -> np.ndarray:
        """(n, n_q) force of commanded volts (samples, n_u) and floor velocity (samples, 3)."""
        force = (self.volts * self.spectrum(u)) @ self.T.T
        if floor is not None:
            force += (self.floor @ self.spectrum(floor)[:, :, None])[:, :, 0]
        return force

    def motion(self, force: np.ndarray) -> np.ndarray:
        """(n, n_q) of a force."""
        return (self.compliance @ force[:, :, None])[:, :, 0]

    def deflection(self, x: np.ndarray, floor: np.ndarray | None) -> np.ndarray:
        """(n, n_g) payload less chassis at the mounts; floor velocity in time."""
        return self._less_chassis(x @ self.G.T, self.G_c, x, floor)

    def _less_chassis(self, moved: np.ndarray, rows: np.ndarray, x: np.ndarray, floor: np.ndarray | None) -> np.ndarray:
        """moved (n, m) less the chassis' motion along rows (m, 6)."""
        if self.recoil is not None:
            moved = moved + (self.recoil @ x[:, :, None])[:, :, 0] @ rows.T
        if floor is not None:
            moved = moved - (self.chassis @ self.spectrum(floor)[:, :, None])[:, :, 0] @ rows.T
        return moved

    def sensed(self, x: np.ndarray, u: np.ndarray, floor: np.ndarray | None = None) -> np.ndarray:
        """(n, n_y) y of a motion x; the aliases are those of volts u (samples, n_u); floor velocity in time."""
        seen = x @ self.rows[0].T if len(self.rows) == 1 else (self.rows @ x[:, :, None])[:, :, 0]
        if np.any(self.against):
            seen = self._less_chassis(seen, self.against, x, floor)
        return self.sense * seen + self.alias * ((self.alias_drive * self.spectrum(u)) @ self.alias_map.T)

    def read_beside(self, acceleration: np.ndarray) -> np.ndarray:
        """(n, n_y) y of an acceleration (samples, n_y) along the sensors that no motion of x shows."""
        return -self.sense * self.spectrum(acceleration) / (self.omega ** 2)[:, None]


_kept: list[tuple[TableModel, int, float, LineResponse]] = []


def line_response(model: TableModel, samples: int, sample_rate_Hz: float) -> LineResponse:
    """The linear part of a model for records of one length; the last one is kept.

    Raises
    ------
    InputError : a record too long for one piece, a rate that is not the model's.
    """
    for known, length, rate, found in _kept:
        if _same(known, model) and (length, rate) == (samples, sample_rate_Hz):
            return found
    if samples > SETTINGS.most_samples:
        raise InputError(f"expected a record of at most {SETTINGS.most_samples} samples, which is simulated in one "
                         "piece", field="samples", value=samples)
    if model.period_s and abs(sample_rate_Hz * model.period_s - 1) > 1e-6:
        raise InputError(f"expected the rig's own {1 / model.period_s:g} Hz", field="sample_rate_Hz",
                         value=sample_rate_Hz)
    padded = scipy.fft.next_fast_len(max(2 * samples, samples + int(np.ceil(SETTINGS.quiet_s * sample_rate_Hz))), True)
    _kept.clear()  # first, so that two never lie in memory
    found = LineResponse(model, samples, padded, sample_rate_Hz)
    _kept.append((model, samples, sample_rate_Hz, found))
    return found


def _same(one: TableModel, other: TableModel) -> bool:
    """Whether two models are made of the very same parts."""
    return (one.base is other.base and len(one.effects) == len(other.effects)
            and all(a is b for a, b in zip(one.effects, other.effects, strict=True)))


def _lines(made: Assembled) -> dict[str, np.ndarray]:
    """What `LineResponse` keeps of some lines."""
    ops, n = made.ops, len(made.ops.omega)
    s = ops.s[:, None, None]
    w = np.broadcast_to(np.eye(3, dtype=complex), (n, 3, 3)) / s
    found = {"compliance": made.inverse, "rows": made.rows,
             "sense": ops.sense * ops.base.sensors.sensitivity * ops.sensor_gain,
             "volts": np.broadcast_to(made.volts, (n, len(ops.base.actuators))),
             "alias": made.folded, "alias_drive": ops.drive, "floor": made.floor_force(w), "chassis": made.follow(w)}
    if ops.recoil is not None:
        found["recoil"] = np.zeros((n, N_Q, made.n_q), complex)
        found["recoil"][:, :, :N_Q] = ops.recoil @ ops.borne(made.M)
    return found


def linear_part(model: TableModel) -> TableModel:
    """The model without effects that depend on amplitude or time."""
    if not model.nonlinear:
        return model
    return replace(model, effects=tuple(one for one in model.effects if not one.effect.nonlinear))
