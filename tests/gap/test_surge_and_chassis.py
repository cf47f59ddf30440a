"""What resonates inside mounts and under them: states at the ends of a record, and whether the search finds it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from noise_fit import fitted
from test_score import MODEL, gaussian
from truth.cases import draw_case, rig, simulate_case

from avis_ctrl.gap.analysis import analyse
from avis_ctrl.gap.effects.library import library
from avis_ctrl.gap.operators import Assembled
from avis_ctrl.gap.score import Score
from avis_ctrl.gap.starting_values import seeds
from avis_ctrl.gap.table_model import TableModel, active
from avis_ctrl.identification.parameter_sets import default_parameters
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.identification.spectral_block import SpectralBlock
from avis_ctrl.rigs.rigid_body import point_map

OMEGA = 2 * np.pi * np.geomspace(0.5, 80.0, 40)


def with_effect(name: str, place: str, values: list[float]) -> TableModel:
    bare = TableModel(ResponseModel.of(rig(), default_parameters(rig())))
    return bare.with_effect(active(library()[name], bare, place, values))


def recorded(truth: TableModel, count: int, noise: float) -> list[SpectralBlock]:
    """Lines of periodic records, all drives random, the floor at rest; noise : r.m.s. of each sensor's."""
    omega, rng, blocks = 2 * np.pi * np.linspace(0.5, 60.0, 150), np.random.default_rng(5), []
    for k in range(count):
        U = np.zeros((len(omega), 11, 1), complex)
        U[:, :8] = 0.3 * gaussian(rng, len(omega), 8, 1)
        made = SpectralBlock(f"{k:02d}", omega, U, np.zeros((len(omega), 6, 1), complex), transient=False)
        Y = truth.answer(made, None, False).Y + noise * gaussian(rng, len(omega), 6, 1)
        blocks.append(replace(made, Y=Y).with_noise(noise**2 * np.tile(np.eye(6, dtype=complex), (len(omega), 1, 1))))
    return blocks


def test_a_push_on_the_mass_inside_a_mount():
    """Against the table with the four masses as coordinates of their own."""
    f, share, zeta, uneven = 17.0, 0.4, 0.05, np.array([0.02, -0.01, 0.03, -0.04])
    made = Assembled(with_effect("mount_surge", "isolators z", [f, share, zeta, *uneven[:3]]).operators(OMEGA))
    mounts, s = made.ops.mounts, 1j * OMEGA[:, None]
    up = mounts.along("z")
    G, k, c, w = mounts.payload[up], mounts.stiffness[up], mounts.damping[up], 2 * np.pi * f * (1 + uneven)
    upper, lower = (k / part * (1 + 2 * zeta * s / w) for part in (share, 1 - share))
    mass = k * (1 / share + 1 / (1 - share)) / w**2
    full = np.zeros((len(OMEGA), 10, 10), complex)
    full[:, :6, :6] = made.D + G.T @ ((upper + s * c - made.z_pp[:, up])[:, :, None] * G)
    full[:, :6, 6:] = -G.T * upper[:, None]
    full[:, 6:, :6] = np.swapaxes(full[:, :6, 6:], 1, 2)
    full[:, range(6, 10), range(6, 10)] = upper + lower + s**2 * mass
    impulses, steps = np.split(made.inverse @ made.forces_of_states, 2, axis=2)
    np.testing.assert_allclose(impulses, np.linalg.inv(full)[:, :6, 6:], rtol=1e-9)
    np.testing.assert_allclose(steps, s[:, :, None] * impulses, rtol=1e-9)


@pytest.mark.parametrize(
    ("place", "values"),
    [
        ("chassis/translation", [900.0, 0.05, 9.0, 11.0, 14.0]),
        ("chassis/rocking", [900.0, 0.05, 9.0, 11.0, 14.0, 10.0, 12.0, 13.0, 0.4, 0.5, 0.6, -0.45, -0.2]),
    ],
)
def test_a_push_on_the_chassis(place, values):
    """Against payload and chassis as two bodies: what the payload's momentum gains the chassis loses."""
    model = with_effect("base_compliance", place, values)
    made = Assembled(model.operators(OMEGA))
    moves, S = made.ops.recoil, 1j * OMEGA[:, None, None]
    ways = np.flatnonzero(np.any(moves, axis=(0, 1)))
    G, under = made.G, made.ops.mounts.chassis[:, ways]
    z = made.z_pp[:, :, None]
    inertia = S**2 * made.M
    full = np.concatenate(
        [
            np.concatenate([inertia + G.T @ (z * G), -G.T @ (z * under)], axis=2),
            np.concatenate([inertia[:, ways], np.linalg.inv(moves[:, ways][:, :, ways])], axis=2),
        ],
        axis=1,
    )
    impulses, steps = np.split(made.inverse @ made.forces_of_states, 2, axis=2)
    true = np.linalg.inv(full)[:, :6, 6:]
    np.testing.assert_allclose(impulses, true, atol=1e-9 * np.abs(true).max())
    np.testing.assert_allclose(steps, S * impulses, atol=1e-9 * np.abs(S * true).max())
    assert model.inner_transients(OMEGA).shape == (len(OMEGA), 6, 2 * len(ways))


def test_a_chassis_bears_what_hangs_on_the_payload_and_what_holds_it():
    """Payload, chassis and a sprung mass as bodies of their own, with a cable to ground."""
    values = [900.0, 0.05, 9.0, 11.0, 14.0, 10.0, 12.0, 13.0, 0.4, 0.5, 0.6, -0.45, -0.2]
    model = with_effect("base_compliance", "chassis/rocking", values)
    m, f, zeta, at = 20.0, 12.0, 0.05, [0.3, 0.2, 0.1]
    oscillator = active(library()["attached_oscillator"], model, "payload/z", [m, f, zeta, *at[:2]])
    cable = active(library()["cable_stiffness"], model, "payload/axes", [2e4, 1e4, 3e4, 1e-3, *at])
    alone = Assembled(model.operators(OMEGA))
    made = Assembled(model.with_effect(oscillator).with_effect(cable).operators(OMEGA))
    s, w = 1j * OMEGA[:, None, None], 2 * np.pi * f
    g = point_map(np.array(at))
    k = m * (w**2 + 2 * zeta * w * s)
    K = (g.T @ np.diag([2e4, 1e4, 3e4]) @ g) * (1 + 1e-3 * s)
    z, under = alone.z_pp[:, :, None], alone.ops.mounts.chassis
    up = point_map(np.array([*at[:2], 0.0]))[2:3]
    springs, stands = alone.G.T @ (z * alone.G), np.linalg.inv(alone.ops.recoil)
    full = np.zeros((len(OMEGA), 13, 13), complex)
    full[:, 6:12, :6] = s**2 * alone.M + K + up.T * k * up  # of both bodies together: motors cancel
    full[:, :6, :6] = full[:, 6:12, :6] + springs
    full[:, :6, 6:12], full[:, 6:12, 6:12] = -alone.G.T @ (z * under), stands
    full[:, :6, 12:] = full[:, 6:12, 12:] = -up.T * k
    full[:, 12:, :6], full[:, 12:, 12:] = -k * up, k + m * s**2
    motors = np.broadcast_to(np.vstack([made.T, np.zeros((7, made.T.shape[1]))]), (len(OMEGA), 13, made.T.shape[1]))
    floor = np.concatenate([K[:, :, :3], K[:, :, :3] + stands @ alone.ops.follow, np.zeros((len(OMEGA), 1, 3))], axis=1)
    w = np.broadcast_to(np.eye(3, dtype=complex), (len(OMEGA), 3, 3))
    for found, push in ((made.T, motors), (made.floor_force(w), floor)):
        true = np.linalg.solve(full, push)[:, :6]
        np.testing.assert_allclose(made.inverse @ found, true, atol=1e-9 * np.abs(true).max())


def test_a_small_recoil_in_one_coordinate_is_significant():
    """A heavy chassis that moves up and down at 34 Hz: the test counts its coordinates and the frequencies searched."""
    truth = MODEL.with_effect(
        active(library()["base_compliance"], MODEL, "chassis/translation", [1500.0, 0.018, 280.0, 280.0, 34.0])
    )
    blocks = recorded(truth, 2, 4e-3)
    seed = seeds(library()["base_compliance"], Score(fitted(MODEL, blocks).model, blocks), ["chassis/translation"])[0][
        0
    ]
    assert seed.p_value < 1e-3


def test_what_holds_no_states_leaves_none():
    model = with_effect("actuator_gain", "Az1", [1.1])
    assert model.inner_transients(OMEGA).shape == (len(OMEGA), 6, 0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "seed", "strength", "parameter"),
    [
        ("mount_surge", 20000, "clear", "frequency_Hz"),
        ("mount_surge", 20001, "gross", "frequency_Hz"),
        ("base_compliance", 20000, "clear", "mass_kg"),
        ("base_compliance", 20001, "gross", "mass_kg"),
    ],
)
def test_one_is_found_from_the_first_look(name, seed, strength, parameter):
    """The search among this one effect closes the gap, at the truth's frequency or mass within its scatter of 3 %."""
    case = draw_case(seed, effect=name, strength=strength, duration_s=30.0)
    found = analyse(simulate_case(case), rig(), effects=[library()[name]])
    assert [one.name for one in found.effects] == [name]
    told = found.effects[0].parameters[parameter].value
    assert told == pytest.approx(case.effects[0].parameters[parameter], rel=0.03)


@pytest.mark.slow
def test_a_light_chassis_is_found_although_tolerances_imitate_it_at_first():
    """It is 1.4 times as heavy as the payload, with a damping ratio of 0.011. Without it, the fit moves a mount by six
    tolerances; fits of the chassis that keep the tolerances there do not reach its true frequencies."""
    case = draw_case(53050)
    assert case.effects[0].name == "base_compliance"
    found = analyse(simulate_case(case), rig())
    assert [one.name for one in found.effects] == ["base_compliance"]
    told, true = found.effects[0].parameters, case.effects[0].parameters
    assert abs(told["mass_kg"].value - true["mass_kg"]) < 3 * told["mass_kg"].std
    assert told["frequency_z_Hz"].value == pytest.approx(true["frequency_Hz"], rel=0.002)


def test_coupled_resonances_are_found_beside_a_fit_with_other_ones():
    """Modes in which a translation and a rotation mix; the fit took one for stiff, the other at a wrong frequency."""
    true = [1400.0, 0.02, 18.1, 16.3, 18.6, 19.2, 17.2, 20.7, 0.5, 0.5, 0.45, -0.43, -0.1]
    wrong = [1600.0, 0.02, 75.0, 16.3, 18.6, 19.2, 19.5, 20.7, 0.5, 0.5, 0.45, -0.36, -0.07]
    place = "chassis/rocking"
    blocks = recorded(with_effect("base_compliance", place, true), 2, 1e-4)
    fit = with_effect("base_compliance", place, wrong)
    found = fit.effects[0].effect.extended_models(Score(fit, blocks), fit.effects[0])
    frequencies = np.array([values[2:8] for _, values in found])
    assert np.min(np.max(np.abs(frequencies / true[2:8] - 1), axis=1)) < 0.08


@pytest.mark.slow
def test_six_sharp_resonances_of_a_chassis_are_found():
    """A chassis of 1.5 % damping that moves in all six coordinates from 10 to 22 Hz, each at its own frequency."""
    case = draw_case(71601, kind="one", effect="base_compliance", duration_s=60.0)
    found = analyse(simulate_case(case), rig(), effects=[library()["base_compliance"]])
    assert [one.name for one in found.effects] == ["base_compliance"]
    told, true = found.effects[0].parameters, case.effects[0]
    names = [f"frequency_{coordinate}_Hz" for coordinate in ("x", "y", "z", "rx", "ry", "rz")]
    np.testing.assert_allclose([told[name].value for name in names], true.details["frequencies_Hz"], rtol=0.01)
    assert told["mass_kg"].value == pytest.approx(true.parameters["mass_kg"], rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "options"), [(71901, {}), (71604, {"kind": "one", "effect": "base_compliance"})])
def test_coupled_sharp_resonances_of_a_chassis_are_found(seed, options):
    """Modes of 2 % damping in which x and the rotation about y are mixed: a fit that takes x for stiff leaves a third
    of the gap, or names a sprung mass beside the chassis."""
    case = draw_case(seed, duration_s=60.0, **options)
    (true,) = case.effects
    found = analyse(
        simulate_case(case), rig(), effects=[library()["base_compliance"], library()["attached_oscillator"]]
    )
    assert [one.name for one in found.effects] == [true.name] == ["base_compliance"]
    told = found.effects[0].parameters
    names = [f"frequency_{coordinate}_Hz" for coordinate in ("x", "y", "z", "rx", "ry", "rz")]
    np.testing.assert_allclose([told[name].value for name in names], true.details["frequencies_Hz"], rtol=0.005)
    assert told["mass_kg"].value == pytest.approx(true.parameters["mass_kg"], rel=0.01)
