"""Forces that depend on the motion that they cause: d = d_0 + h * f(d), solved from sample to sample.

d_0 is the deflection without the forces, h the response of the linear part to a force that is linear between samples. A
fixed-point iteration over a whole record diverges unless f is small compared with the force of a lightly damped mount.
Here time is divided into windows short enough for the iteration to contract for any f. The effect of earlier windows on
later ones is added in blocks that double in length (fast convolution of a sequence that is only known up to now:
Hairer, Lubich and Schlichte, SIAM J. Sci. Stat. Comput. 6, 1985).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy.fft

from avis_ctrl.errors import ComputationError
from avis_ctrl.gap.effects.mounts import ContactFriction, Contacts, pushed
from avis_ctrl.gap.line_response import SETTINGS, LineResponse
from avis_ctrl.gap.operators import Assembled
from avis_ctrl.gap.record_motion import RecordMotion
from avis_ctrl.gap.table_model import ActiveEffect
from avis_ctrl.identification.response import N_Q


class ForceResponse:
    """Motion z (c,) per force (6,) at the samples; z contains x, and the chassis if it recoils.

    shape : (n_g, c) deflection per z.
    The force is linear between samples: sinc^2 times the continuous response, plus aliases, known in closed form for
    the mass alone: T^2/6 (z + 4 + 1/z)/(z - 2 + 1/z) in place of 1/s^2.
    """

    def __init__(self, response: LineResponse):
        self.response, table = response, response.parts[0]
        self.n_x, self.shape, recoils = table.n_q, table.G, table.ops.recoil is not None
        if recoils:
            self.shape = np.hstack([table.G, table.ops.mounts.chassis])
        theta = response.omega / response.sample_rate_Hz
        alias, by_mass = _folded(theta) / response.sample_rate_Hz**2, np.linalg.inv(table.M)
        hold = np.sinc(theta / (2 * np.pi))[:, None, None] ** 2
        by_force = hold * np.concatenate([_by_force(part, recoils) for part in response.parts])
        by_force[:, :N_Q] += alias[:, None, None] * by_mass
        self.by_force = by_force
        impulse = np.empty((response.samples, by_force.shape[1], N_Q))
        for k in range(by_force.shape[1]):
            impulse[:, k] = response.in_time(by_force[:, k])
        window = 1 << max(4, round(np.log2(SETTINGS.window_s * response.sample_rate_Hz)))
        self.own = scipy.fft.rfft(impulse[:window], 2 * window, axis=0)
        self.window, self.levels, length = window, [], window
        while length < max(response.samples, 2 * window):
            self.levels.append(scipy.fft.rfft(impulse[: 2 * length], 2 * length, axis=0))
            length *= 2

    def whole(self, force: np.ndarray) -> np.ndarray:
        """(n, c) spectrum of the motion due to a force (samples, 6)."""
        return (self.by_force @ self.response.spectrum(force)[:, :, None])[:, :, 0]

    def after(self, force: np.ndarray, level: int) -> np.ndarray:
        """(B, c) motion in the B samples after a force that lasts B = window 2^level samples."""
        B = self.window << level
        spectrum = scipy.fft.rfft(force, 2 * B, axis=0)
        return scipy.fft.irfft((self.levels[level] @ spectrum[:, :, None])[:, :, 0], 2 * B, axis=0)[B:]

    def within(self, force: np.ndarray, length: int) -> np.ndarray:
        """(length, c) motion within a window due to a force at its first samples."""
        spectrum = scipy.fft.rfft(force, 2 * self.window, axis=0)
        return scipy.fft.irfft((self.own @ spectrum[:, :, None])[:, :, 0], 2 * self.window, axis=0)[:length]


def _by_force(table: Assembled, recoils: bool) -> np.ndarray:
    """(n, c, 6) motion per force on the payload: of the table and, with opposite sign, of a chassis that recoils."""
    x = table.inverse[:, :, :N_Q]
    return np.concatenate([x, -table.chassis(x, np.zeros((len(x), 3, N_Q)))], axis=1) if recoils else x


def _folded(theta: np.ndarray) -> np.ndarray:
    """(n,) sampled double integrator with a linear hold minus its continuous term, over T^2."""
    safe = np.maximum(theta, 0.1)
    exact = -(4 + 2 * np.cos(safe)) / (12 * (1 - np.cos(safe))) + np.sinc(safe / (2 * np.pi)) ** 2 / safe**2
    return np.where(theta < 0.1, -(theta**2) / 720, exact)


class WindowForce:
    """Force of an effect, window by window.

    memory : samples before a window on which the force in it depends; None for all of them.
    """

    def __init__(self, one: ActiveEffect, record: RecordMotion, window: int):
        self.one, self.record = one, record
        self.memory = self._memory(window)

    def _memory(self, window: int) -> int | None:
        """No sample, a window, or all samples; tested on half a record."""
        samples = len(self.record.volts)
        whole, half = self._of(0, samples), samples // 2
        least = 1e-12 * np.max(np.abs(whole))
        for memory in (0, window):
            since = max(half - memory, 0)
            if np.allclose(whole[half:], self._of(since, samples)[half - since :], 1e-9, least):
                return memory
        return None

    def _of(self, start: int, stop: int) -> np.ndarray:
        r = self.record
        part = replace(
            r,
            start_s=r.start_s + start / r.sample_rate_Hz,
            volts=r.volts[start:stop],
            deflection=r.deflection[start:stop],
        )
        force = self.one.effect.force(part, self.one.place, self.one.by_name)
        return np.zeros((stop - start, N_Q)) if force is None else force

    def __call__(self, start: int, stop: int) -> np.ndarray:
        """(stop - start, 6) force for the current deflection of the record."""
        since = 0 if self.memory is None else max(start - self.memory, 0)
        return self._of(since, stop)[start - since :]

    def accept(self, start: int, stop: int) -> None:
        """Accept the deflection up to stop as final."""


class FrictionForce(WindowForce):
    """Friction of contacts; their state is carried from window to window."""

    def __init__(self, one: ActiveEffect, record: RecordMotion, window: int):
        super().__init__(one, record, window)
        self.contacts = Contacts(record, one.by_name["slip_m"])

    def _memory(self, window: int) -> int | None:
        return None

    def __call__(self, start: int, stop: int) -> np.ndarray:
        return pushed(self.contacts.friction(start, stop), self.record, self.one.by_name)

    def accept(self, start: int, stop: int) -> None:
        self.contacts.friction(start, stop, keep=True)


def march(
    by_force: ForceResponse, free: np.ndarray, effects: Sequence[ActiveEffect], record: RecordMotion, beyond: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Solve z = free + h * f(z) from rest: z (samples, c), and the force (samples, 6) that it causes.

    Parameters
    ----------
    free : (samples, c) motion without the forces of the effects. record : its deflection is overwritten.
    beyond : (samples, n_g) deflection that no z represents.

    Raises
    ------
    ComputationError : a motion that grows without bound.
    """
    z, W, samples = free.copy(), by_force.window, len(free)
    forces = [
        (FrictionForce if type(one.effect) is ContactFriction else WindowForce)(one, record, W) for one in effects
    ]
    total, largest = np.zeros((samples, N_Q)), float(np.max(np.abs(record.deflection), initial=0.0))

    def forced(start: int, here: slice) -> np.ndarray:
        """(samples, 6) force of all effects; an effect with memory starts from its state at the start of the window."""
        found = np.zeros((here.stop - here.start, N_Q))
        for force in forces:
            since = start if force.memory is None else here.start
            found += force(since, here.stop)[here.start - since :]
        return found

    def solved(start: int, stop: int, piece: int) -> tuple[np.ndarray, np.ndarray] | None:
        """z and its force in a window, piece by piece; None if the iteration does not contract."""
        push, moved = np.zeros((stop - start, N_Q)), z[start:stop]
        for a in range(0, stop - start, piece):
            b = min(a + piece, stop - start)
            here, before = slice(start + a, start + b), None
            for iteration in range(1, SETTINGS.most_iterations + 1):
                moved = z[start:stop] + by_force.within(push[:b], stop - start)
                deflection = moved[a:b] @ by_force.shape.T + beyond[here]
                change = np.inf if before is None else float(np.max(np.abs(deflection - before)))
                record.deflection[here] = before = deflection
                if change <= SETTINGS.window_tolerance * largest:
                    break
                if not change < np.inf and iteration > 1:
                    return None
                push[a:b] = forced(start, here)
                if not np.max(np.abs(push[a:b])) < 1e12:
                    return None
            else:
                return None
        return moved, push

    for start in range(0, samples, W):
        stop = min(start + W, samples)
        if start:
            level = (start // W & -(start // W)).bit_length() - 1
            B = W << level
            end = min(start + B, samples)
            z[start:end] += by_force.after(total[start - B : start], level)[: end - start]
        done = next(filter(None, (solved(start, stop, max(W // piece, 1)) for piece in SETTINGS.pieces)), None)
        if done is None:
            raise _without_bound(effects, record, start)
        z[start:stop], total[start:stop] = done
        for force in forces:
            force.accept(start, stop)
    return z, total


def _without_bound(effects: Sequence[ActiveEffect], record: RecordMotion, start: int) -> ComputationError:
    peak = float(np.max(np.abs(record.deflection[:start]), initial=0.0))
    values = ", ".join(f"{one.label} {one.by_name}" for one in effects)
    return ComputationError(
        f"no motion of the table with {values} satisfies the equations at {start / record.sample_rate_Hz:.3g} s",
        measured=f"up to {peak:.3g} m of deflection before; {SETTINGS.most_iterations} iterations a sample",
        cause="an effect that pushes harder the farther the table moves, or that is far stiffer than a mount",
        next_step="other values of the effect's parameters, or a lower level",
    )
