"""Designs on tables of a user's own: the plant against what each drive and each sensor does by itself."""

import tomllib
from pathlib import Path

import numpy as np
import pytest

from avis_ctrl.errors import InputError
from avis_ctrl.rigs import COORDINATES, load_rig
from avis_ctrl.rigs.delay_models import pade_delay
from avis_ctrl.rigs.logical_axes import actuator_axes, sensor_axes
from avis_ctrl.rigs.sensing import conditioning
from avis_ctrl.study.design_file import design_from_table
from avis_ctrl.study.plant import build_plant

ROOT = Path(__file__).parents[2]
NAMES = ("tripod", "four_vertical", "twelve_sensors", "skewed", "granite")
KEEP = ["z", "phi_x"]


def design_of(keep=KEEP):
    table = tomllib.loads((ROOT / "designs" / "avis_z_phix.toml").read_text())
    return design_from_table({**table, "keep": keep})


def direct(rig, design, omega, axes):
    """(n, n_axes, 2 n_axes) seen velocities by floor velocity and force commands, channel by channel.

    The other coordinates rest. Volts of every sensor by its own formula, divided by its gain, filtered, decoded.
    """
    kept = [COORDINATES.index(name) for name in axes]
    lever = np.array([rig.edge_m if name.startswith("phi") else 1.0 for name in axes])
    eom, s = rig.equations_of_motion(), 1j * omega
    pick = np.ix_(kept, kept)
    allocation, decoder = actuator_axes(rig, axes).allocation * lever, sensor_axes(rig, axes)
    filters, (_, H) = conditioning(rig, design.loop.integrator_corner_Hz), rig.sensor_rows()
    found = np.empty((len(omega), len(axes), 2 * len(axes)), complex)
    delay = pade_delay(rig.loop_delay_s + 0.5 / rig.sample_rate_Hz, 2).frequency_response(omega)[:, 0, 0]
    for k, one in enumerate(s):
        D = eom.K[pick] + one * eom.C[pick] + one**2 * eom.M[pick]
        floor = np.diag(1 / lever) / one
        q_floor = np.linalg.solve(D, (eom.K_floor[pick] + one * eom.C_floor[pick]) @ floor)
        lag = delay[k] / (1 + one / (2 * np.pi * design.loop.amplifier_corner_Hz))
        q_drive = np.linalg.solve(D, eom.T[kept] @ allocation) * lag
        q = np.hstack([q_floor, q_drive])
        against = q - np.hstack([floor, np.zeros_like(floor)])
        seen = np.zeros((len(H), q.shape[1]), complex)
        for j, (sensor, filter_) in enumerate(zip(rig.sensors(), filters, strict=True)):
            volts = sensor.gain * sensor.as_velocity(np.array([omega[k]]))[0] * one
            moved = H[j, kept] @ (against if sensor.quantity == "displacement" else q)
            digital = (
                filter_.leading * np.prod([one - z for z in filter_.zeros]) / np.prod([one - p for p in filter_.poles])
            )
            if sensor.inertial:
                # A tilt phi turns the direction d by phi x d: the mass feels g e_z . (phi x d) as acceleration.
                turned = np.zeros((6, q.shape[1]), complex)
                turned[kept] = q
                moved = moved + 9.80665 * np.cross(sensor.direction, [0.0, 0.0, 1.0]) @ turned[3:] / one**2
            seen[j] = digital * volts / sensor.gain * moved
        found[k] = lever[:, None] * (decoder.decoding @ seen)
    return found


@pytest.mark.parametrize("name", NAMES)
def test_the_plant_is_what_drives_and_sensors_make_of_it(name):
    rig, design = load_rig(ROOT / "designs" / "rigs" / f"{name}.toml"), design_of()
    plant = build_plant(design, rig)
    omega = 2 * np.pi * np.array([0.2, 1.5, 4.0, 20.0, 90.0])
    inputs = [*plant.floor_velocities, *(f"command_{axis}" for axis in plant.axes)]
    nominal = plant.full.nominal().P.select([f"seen_{axis}_dot" for axis in plant.axes], inputs)
    expected = direct(rig, design, omega, KEEP)
    assert np.allclose(nominal.frequency_response(omega), expected, rtol=1e-8, atol=1e-10 * np.abs(expected).max())
    assert plant.relative == (("phi_x_edge",) if name == "granite" else ())


@pytest.mark.parametrize("name", NAMES)
def test_noise_of_an_axis_is_that_of_its_sensors(name):
    """Power of the seen velocity by noise at 3 Hz: each sensor's own density, filtered and decoded, in power."""
    rig, design = load_rig(ROOT / "designs" / "rigs" / f"{name}.toml"), design_of()
    plant = build_plant(design, rig)
    omega, fs = np.array([2 * np.pi * 3.0]), rig.sample_rate_Hz
    response = plant.full.nominal().P.select([f"seen_{axis}_dot" for axis in plant.axes], list(plant.noises))
    power = np.sum(np.abs(response.frequency_response(omega)[0] * plant.floor_density) ** 2, axis=1)
    decoding = sensor_axes(rig, KEEP).decoding * np.array([1.0, rig.edge_m])[:, None]
    lsb = 2 * rig.acquisition.adc_range_V / 2**rig.acquisition.adc_bits
    expected = np.zeros(2)
    for one, filter_, column in zip(rig.sensors(), conditioning(rig, 0.1), decoding.T, strict=True):
        volts = np.hypot(one.noise_rms_V, lsb / np.sqrt(12)) * np.sqrt(2 / fs)
        passed = np.ones(1) if filter_.is_one else np.abs(filter_.system().frequency_response(omega)[:, 0, 0])
        expected += (column * volts / one.gain * passed[0]) ** 2
    assert np.allclose(power, expected, rtol=1e-5)


def test_what_cannot_be_driven_is_refused_by_name_and_nothing_else_is():
    rig = load_rig(ROOT / "designs" / "rigs" / "four_vertical.toml")
    assert build_plant(design_of(["z"]), rig).actuators == ("V1", "V2", "V3", "V4")
    with pytest.raises(InputError, match="x and phi_z cannot be pushed independently"):
        build_plant(design_of(["x", "z", "phi_z"]), rig)
