"""The response against the exact discretisation, its derivatives against differences, transients against records."""

import weakref
from dataclasses import replace

import numpy as np
import pytest
from exact import discrete_avis, multisine, record

from avis_ctrl.errors import InputError
from avis_ctrl.identification.response import ResponseModel, kept_lines, positive
from avis_ctrl.identification.sample_and_hold import aliases, hold, sampled_pole
from avis_ctrl.identification.spectra import record_block, transient_columns
from avis_ctrl.rigs import load_rig

STIFFNESS = [f"isolator{i}.{kind}_{axis}" for i in (1, 2, 3, 4) for kind in "kc" for axis in "xyz"]
ALL = [
    "mass",
    "J1",
    "J2",
    "J3",
    "J12",
    "com_x",
    "com_z",
    "isolator1.p_x",
    "isolator3.p_z",
    *STIFFNESS,
    "actuator.Az2",
    "sensor.Sz1",
    "loop_delay_s",
]
HALCYONICS = ["mass", "Ixx", "L6", "L3", "k_s1", "k_a", "k_t", "d1", "d4", "e3", "load.L8", "load.mass", "load.Ixy"]


def test_against_the_exact_discretisation(avis):
    """Matrix exponential and one sample of delay; aliases included."""
    A, B, C, _ = discrete_avis(avis)
    f = np.array([0.5, 1.0, 2.0, 3.1, 4.0, 10.0, 20.0, 50.0, 100.0])
    z = np.exp(2j * np.pi * f * 1e-3)
    exact = np.array([C @ np.linalg.solve(w * np.eye(len(A)) - A, B[:, :8]) / w for w in z])
    found = ResponseModel.of(avis, ["mass"]).response(2 * np.pi * f)[:, :, :8]
    error = np.max(np.abs(found - exact), axis=(1, 2)) / np.max(np.abs(exact), axis=(1, 2))
    assert np.all(error[f <= 20] < 1e-7) and np.all(error < 1e-5)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("mass Ixx actuator.Az2 sensor.Sz1 isolator1.k_x isolator4.c_z k_s1 d1 e3", True),
        ("Ixy J12 com_x isolator1.p_x L6 dx e load.L8 spring@isolator1.k_3 loop_delay_s", False),
    ],
)
def test_what_must_be_positive(words, expected):
    """Masses, moments of inertia, stiffness, damping and gains; no product of inertia, no place, no effect's own."""
    assert {name: positive(name) for name in words.split()} == dict.fromkeys(words.split(), expected)


def test_an_amplifier_lags_by_its_corner(avis):
    """In continuous time the response to a voltage is that without amplifier times 1 / (1 + j f / corner)."""
    plain = replace(ResponseModel.of(avis, ["mass"]), period_s=0.0, delay_s=0.0)
    f = np.array([0.5, 3.0, 50.0, 400.0])
    lag = 1 / (1 + 1j * f[:, None, None] / 50.0)
    slow = replace(plain, amplifier_corner_Hz=50.0).response(2 * np.pi * f)[:, :, :8]
    np.testing.assert_allclose(slow, lag * plain.response(2 * np.pi * f)[:, :, :8], rtol=1e-12)


def test_aliases_matter(avis):
    """Without them the velocity of a mass at 60 Hz is off by 1.2 % (docs/own_effect.md): the images of a held voltage
    sum up to (x/sin x)^2 - 1 with x = w T/2."""
    w = 2 * np.pi * np.array([50.0, 60.0])
    x = w * 1e-3 / 2
    with_them = hold(w, 1e-3, 1e-3) / (1j * w) + aliases(w, 1e-3, 1e-3, "velocity")
    added = with_them / (hold(w, 1e-3, 1e-3) / (1j * w)) - 1
    np.testing.assert_allclose(added, (x / np.sin(x)) ** 2 - 1, rtol=1e-6)
    assert added[1].real == pytest.approx(0.012, abs=5e-4)


@pytest.mark.parametrize("delay", [0.0, 0.3e-3, 1e-3, 1.7e-3])
@pytest.mark.parametrize("pole", [0.0, -2 * np.pi * 300])
def test_sampled_pole_against_the_step_response(delay, pole):
    """The z-transform of the twice differenced samples of the continuous step response, divided by 1 - 1/z."""
    T = 1e-3
    t = np.arange(64) * T
    late = np.maximum(t - delay, 0)
    step = late if pole == 0 else np.expm1(pole * late) / pole
    twice = np.diff(step, n=2, prepend=[0.0, 0.0])
    w = 2 * np.pi * np.array([10.0, 100.0, 333.0])
    expected = np.array([np.sum(twice * np.exp(-1j * x * t)) / (1 - np.exp(-1j * x * T)) for x in w])
    assert np.allclose(sampled_pole(w, T, delay, pole), expected, rtol=1e-9)


@pytest.mark.parametrize(("rig", "names"), [("avis", ALL), ("halcyonics_loaded", HALCYONICS)])
def test_derivatives_against_differences(rig, names):
    rng = np.random.default_rng(1)
    model = ResponseModel.of(load_rig(rig), names)
    w = 2 * np.pi * np.geomspace(0.4, 90, 25)
    n_in = len(model.inputs) + 12
    U = rng.normal(size=(25, n_in, 2)) + 1j * rng.normal(size=(25, n_in, 2))
    dY = model.driven(w, U).dY
    for j, value in enumerate(model.values):
        step = np.zeros(len(names))
        step[j] = 1e-5 * abs(value) or 1e-6
        up, down = (model.at(model.values + sign * step).driven(w, U, False).Y for sign in (1, -1))
        numeric = (up - down) / (2 * step[j])
        assert np.max(np.abs(numeric - dY[j])) < 3e-6 * np.max(np.abs(dY[j])), names[j]


@pytest.mark.parametrize(("order", "corner"), [(0, None), (1, 80.0), (3, 200.0), (8, 300.0)])
def test_a_record_is_response_and_transient(avis, order, corner):
    """Noise-free record that starts at rest: what the model leaves is rounding, though the transient is large. With an
    anti-alias filter, its states have a transient, too."""
    rng = np.random.default_rng(2)
    avis = avis.with_electronics(replace(avis.electronics, anti_alias_order=order, anti_alias_corner_Hz=corner))
    u = multisine(rng, 0.3)
    measured = record(avis, u, np.zeros((len(u), 3)), rng, noise_V=0.0, quantised=False)
    model = ResponseModel.of(avis, ["mass"])
    block = record_block(measured, model, (0.5, 60.0))
    plain = block.Y - model.driven(block.omega, block.U, False).Y
    columns = transient_columns(model, block.omega)[0].reshape(plain.size, -1)
    both = np.vstack([columns.real, columns.imag])
    e = np.concatenate([plain.ravel().real, plain.ravel().imag])
    left = e - both @ np.linalg.lstsq(both, e, rcond=1e-12)[0]
    assert np.sqrt(np.mean(e**2)) > 0.1 and np.max(np.abs(left)) < 2e-5


def test_results_on_lines_are_kept_while_their_model_lives(avis):
    calls = []

    @kept_lines
    def size(model, omega):
        calls.append(model.names)
        return np.empty((len(omega), 1000))

    omega, model, other = np.ones(10), ResponseModel.of(avis, ["mass"]), ResponseModel.of(avis, ["J1"])
    kept = weakref.ref(size(model, omega))
    assert size(model, omega) is kept() and size(other, omega) is size(other, omega)
    assert size(model, omega) is kept() and size(model, omega.copy()) is not kept()
    assert calls == [("mass",), ("J1",), ("mass",)]
    kept = weakref.ref(size(model, omega))
    del model
    assert kept() is None


def test_ideal_sensors_and_static_floor(avis):
    """At low frequency the payload follows the floor, and a voltage stretches the springs."""
    w = np.array([1e-3])
    displacement = ResponseModel.of(avis, ["mass"], unit="m", sampled=False).response(w)[0]
    eom, R = avis.equations_of_motion(), avis.sensor_rows()[1]
    assert np.allclose(displacement[:, :8], R @ np.linalg.solve(eom.K, eom.T), rtol=1e-6)
    assert np.allclose(displacement[:, 8:] * 1j * w, R[:, :3], atol=1e-5)


@pytest.mark.parametrize(
    "change", [{"names": ["weight"]}, {"sensors": ["Sz9"]}, {"actuators": ["Aq1"]}, {"unit": "furlong"}]
)
def test_wrong_names_are_answered(avis, change):
    with pytest.raises(InputError) as error:
        ResponseModel.of(avis, **({"names": ["mass"]} | change))
    assert "\n" not in str(error.value)
