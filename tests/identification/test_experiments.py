"""Predicted information against the fit's own on simulated spectra, and what experiments can and cannot bring."""

from dataclasses import replace

import numpy as np
import pytest

from avis_ctrl.errors import InputError
from avis_ctrl.identification.experiment_plan import (
    Experiment,
    candidates,
    compared,
    needed_experiment,
    planned,
    predicted,
)
from avis_ctrl.identification.experiments import Added, Drive, Noise, changed, predicted_information
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.rigs.rigid_body import cross_matrix

MOUNTS = [f"isolator{i}.{kind}_{axis}" for i in (1, 2, 3, 4) for kind in "kc" for axis in "xyz"]
BODY = ["mass", "J1", "J2", "J3"]
CORNER = (0.4, 0.3, 0.1)
NOISE = Noise(np.array([1.0]), 1e-6 * np.eye(6)[None])
DRIVE = Drive(0.3, 60.0)


def all_parameters(rig):
    return [*BODY, *MOUNTS, *(f"actuator.{m.name}" for m in rig.motors), *(f"sensor.{n}" for n in rig.geophones.names)]


def test_a_known_mass_breaks_the_common_factor_and_only_that(avis):
    model = ResponseModel.of(avis, all_parameters(avis))
    now = predicted_information(model, DRIVE, NOISE)
    with_mass = now.plus(predicted_information(changed(model, masses=[(50.0, CORNER)]), DRIVE, NOISE))
    assert (now.rank, with_mass.rank) == (32, 33)
    assert not now.known[model.names.index("mass")] and with_mass.known[model.names.index("mass")]
    assert not with_mass.known[model.names.index("isolator1.k_x")]


def test_the_added_mass_is_that_of_a_body_with_it(avis):
    """A point mass by hand: mass, centre of mass and inertia of the sum."""
    model = ResponseModel.of(avis, ["mass"])
    m, p = 50.0, np.array(CORNER)
    total = avis.mass + m
    centre = m * p / total
    S = [cross_matrix(v) for v in (-centre, p - centre)]
    J = avis.inertia_matrix() - avis.mass * S[0] @ S[0] - m * S[1] @ S[1]
    rig = replace(
        avis, mass=total, centre_of_mass=tuple(centre), inertia=(J[0, 0], J[1, 1], J[2, 2], J[0, 1], J[0, 2], J[1, 2])
    )
    omega = np.linspace(5, 200, 20)
    assert np.allclose(
        changed(model, masses=[(m, CORNER)]).response(omega),
        ResponseModel.of(rig, ["mass"]).response(omega),
        rtol=1e-10,
    )


def test_derivatives_of_a_changed_rig(avis):
    model = ResponseModel.of(avis, ["mass", "J1", "isolator1.k_x", "actuator.Ay1", "sensor.Sy1"])
    new = Added("new", (0.0, 0.1, 0.2), (1.0, 0.0, 0.0))
    other = changed(model, {"isolator1.p_z": 0.05}, [(50.0, CORNER)], [new])
    omega = np.linspace(5, 100, 7)
    U = np.broadcast_to(np.eye(11, dtype=complex), (7, 11, 11))
    found = other.driven(omega, U)
    assert found.Y.shape == (7, 7, 11)
    for j, value in enumerate(other.values):
        step = 1e-4 * value * np.eye(5)[j]
        slope = (other.at(other.values + step).response(omega) - other.at(other.values - step).response(omega)) / (
            2 * step[j]
        )
        assert np.allclose(found.dY[j], slope, rtol=1e-5, atol=1e-6 * np.max(np.abs(slope)))


def test_floor_shaking_brings_no_stiffness_but_calibrates_the_sensors(avis):
    drive = Drive(0.0, 60.0, floor_m_per_s={"vx": 1e-4, "vy": 1e-4, "vz": 1e-4})
    plain = ResponseModel.of(avis, [*BODY, *MOUNTS])
    now = predicted_information(plain, DRIVE, NOISE)
    assert now.plus(predicted_information(plain, drive, NOISE)).rank == now.rank == 20
    full = ResponseModel.of(avis, all_parameters(avis))
    now = predicted_information(full, DRIVE, NOISE)
    after = now.plus(predicted_information(full, drive, NOISE))
    assert after.rank == 33
    assert {n for n, known in zip(full.names, after.known, strict=True) if known} == {
        f"sensor.{n}" for n in avis.geophones.names
    }


def test_raised_isolators_determine_every_stiffness(avis):
    model = ResponseModel.of(avis, [*BODY, *MOUNTS])
    now = predicted_information(model, DRIVE, NOISE)
    raised = changed(model, {"isolator1.p_z": 0.05, "isolator3.p_z": 0.05})
    assert now.plus(predicted_information(raised, DRIVE, NOISE)).rank == 28


def test_predicted_errors_are_those_of_spectra_of_that_noise(avis):
    """The same record line by line, without the grid: 60 s, 0.5-60 Hz, eight white inputs in expectation."""
    model = ResponseModel.of(avis, ["mass", "J1", "isolator1.k_z", "isolator1.c_z"])
    f = np.arange(1, 60 * 60 + 1) / 60.0
    f = f[(f >= 0.5) & (f <= 60.0)]
    scale = 0.3 * np.sqrt(1000.0 / 2 / 59.5)
    U = np.zeros((len(f), 11, 8), complex)
    U[:, :8] = scale * np.eye(8)
    J = (model.driven(2 * np.pi * f, U).dY * np.sqrt(2) / 1e-3).reshape(4, -1)
    exact = np.sqrt(np.diag(np.linalg.inv(np.real(J.conj() @ J.T))))
    assert np.allclose(predicted_information(model, DRIVE, NOISE).standard_deviation, exact, rtol=0.05)


def test_information_grows_with_time_and_power(avis):
    model = ResponseModel.of(avis, [*BODY, *MOUNTS])
    one = predicted_information(model, DRIVE, NOISE).matrix
    assert np.allclose(predicted_information(model, replace(DRIVE, duration_s=240.0), NOISE).matrix, 4 * one)
    assert np.allclose(predicted_information(model, replace(DRIVE, level_V=0.6), NOISE).matrix, 4 * one)


def test_sentences_and_the_plan(avis):
    model = ResponseModel.of(avis, [*BODY, *MOUNTS])
    now = predicted_information(model, DRIVE, NOISE)
    longer = Experiment("Record twice as long", DRIVE)
    bench = Experiment("Measure isolator1.k_x", bench={"isolator1.k_x": 0.02})
    raised = Experiment("Raise 1 and 3", DRIVE, {"shifts": {"isolator1.p_z": 0.05, "isolator3.p_z": 0.05}})
    added = predicted(model, [longer, bench, raised], NOISE)
    ranked = compared(now, added)
    assert [one.experiment for one in ranked] == [raised, bench, longer]
    assert [one.gained for one in ranked] == [8, 1, 0]
    assert ranked[2].tighter == pytest.approx(np.sqrt(2), rel=1e-6)
    assert ranked[1].alone["isolator1.k_x"] == pytest.approx(0.02, rel=1e-3)
    assert [one.experiment for one in planned(now, added)] == [raised]
    said = needed_experiment(now, model, DRIVE, NOISE, [longer, bench])
    assert any("None of these experiments determines" in s and "isolator3.k_x" in s for s in said)
    assert any("determine no further combination" in s and "record twice as long" in s for s in said)


def test_channels_are_added_at_the_corner_opposite_the_first_mount(avis):
    """A known mass goes on that mount, the new channels point-symmetric to it: far from all that is there."""
    rig = avis.with_parameters({f"isolator1.p_{axis}": value for axis, value in zip("xyz", CORNER, strict=True)})
    said = [one.words for one in candidates(ResponseModel.of(rig, ["mass"]), DRIVE)]
    assert any("known mass of 50 kg fixed at (0.4, 0.3, 0.1) m" in words for words in said)
    for axis in "xyz":
        assert any(f"sensor along {axis} on the payload at (-0.4, -0.3, -0.1) m" in words for words in said)


@pytest.mark.parametrize(
    "make",
    [
        lambda m: Drive(1.0, 1.0, (5.0, 1.0)),
        lambda m: Drive(1.0, 1.0, (0.0, 5.0)),
        lambda m: changed(m, {"isolator9.p_x": 0.1}),
        lambda m: predicted_information(m, Drive(1, 1, (900.0, 950.0)), NOISE),
    ],
)
def test_wrong_calls_are_answered(avis, make):
    with pytest.raises(InputError):
        make(ResponseModel.of(avis, ["mass"]))
