"""Gaps of one axis: truths integrated in time, apart from the models under test, and real instruments.

EMPS drive: Janot, Gautier, Brunot 2019. Silverbox: Wigren, Schoukens 2013.
"""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from avis_ctrl.errors import InputError
from avis_ctrl.gap.axis import Signals, find_axis_gap, find_axis_gap_in
from avis_ctrl.gap.axis.find import Reading, signals_in
from avis_ctrl.gap.axis.simulation import predicted
from avis_ctrl.identification.single_axis.seismometer import Responses
from avis_ctrl.report import axis_gap_reports
from avis_ctrl.study.gap_axis import write_axis_gap, write_axis_predictions

RATE = 600.0


def names(gap):
    return [effect.name for effect in gap.effects]


# --- oscillator

def oscillator(extra, seed, n=24_576, noise=1e-3):
    """u and y of y''/w^2 + 2 zeta y'/w + y + extra(y, y') = u, w = 2 pi 60, zeta 5 %, by Runge-Kutta in steps of a
    sixteenth sample with the band-limited u at every half step; the level swells and falls twice."""
    rng, over = np.random.default_rng(seed), 8
    f = np.fft.rfftfreq(n, 1 / RATE)
    U = np.where((f > 1) & (f < 200), np.exp(2j * np.pi * rng.random(len(f))), 0)
    fine = np.fft.irfft(np.r_[U, np.zeros(n * over - len(U) + 1)], 2 * n * over)
    fine *= 0.6 + 0.4 * np.sin(np.linspace(0, 5 * np.pi, len(fine)))
    fine = [*(fine / fine.std()).tolist(), 0.0, 0.0]
    w, h = 2 * np.pi * 60, 1 / RATE / over

    def a(y, v, u):
        return (u - 0.1 / w * v - y - extra(y, v)) * w * w
    y = v = 0.0
    found = np.empty(n)
    for i in range(n * over):
        if i % over == 0:
            found[i // over] = y
        u0, um, u1 = fine[2 * i:2 * i + 3]
        a1 = a(y, v, u0)
        a2 = a(y + h / 2 * v, v + h / 2 * a1, um)
        a3 = a(y + h / 2 * (v + h / 2 * a1), v + h / 2 * a2, um)
        a4 = a(y + h * (v + h / 2 * a2), v + h * a3, u1)
        y, v = y + h * v + h * h / 6 * (a1 + a2 + a3), v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
    return np.array(fine[:2 * over * n:2 * over]), found + noise * found.std() * rng.standard_normal(n)


def searched(extra, seed, **how):
    u, y = oscillator(extra, seed, **how)
    return find_axis_gap("oscillator", records=[Signals("a", u, y)], rate=RATE, band_Hz=(2.0, 180.0))


@pytest.mark.parametrize(("name", "extra", "true"), [
    ("cubic_stiffness", lambda y, v: 0.01 * y ** 3, 0.01),
    ("quadratic_stiffness", lambda y, v: 0.02 * y * y, 0.02),
    ("quadratic_damping", lambda y, v: 2e-6 * abs(v) * v, 2e-6),
    ("coulomb_friction", lambda y, v: 0.1 * math.tanh(v / 5), 0.1)])
def test_the_right_force_is_named(name, extra, true):
    gap = searched(extra, 1)
    assert names(gap) == [name] and gap.verdict == "explained" and gap.effects[0].probability == 0.99
    assert next(iter(gap.effects[0].parameters.values())).value == pytest.approx(true, rel=0.01)


@pytest.mark.parametrize("noise", [1e-3, 0.1])
def test_nothing_is_named_where_nothing_is_missing(noise):
    gap = searched(lambda y, v: 0.0, 4, n=16_384, noise=noise)
    assert gap.verdict == "none" and not gap.effects


def test_a_periodic_force_is_outside_the_library():
    gap = searched(lambda y, v: 0.3 * math.sin(2 * y), 1)
    assert gap.verdict == "unexplained" and not gap.effects


def drive(friction, seed=0, duration=24.0, noise=0.3):
    """Closed loop along a chain of moves forth and back, in time; 20 kg, 60 N s/m and friction(v)."""
    rng, rate, over = np.random.default_rng(seed), 1000, 16
    n = int(duration * rate)
    t = np.arange(n * over) / (rate * over)
    reference = 0.12 * (1 - np.cos(2 * np.pi * t / 6)) + 0.005 * (1 - np.cos(2 * np.pi * t * 1.5))
    slope = np.gradient(reference, t)
    q = v = 0.0
    position, force = np.empty(n), np.empty(n)
    wanted, rate_of = reference.tolist(), slope.tolist()
    for i in range(n * over):
        F = 40_000 * (wanted[i] - q) + 1_500 * (rate_of[i] - v)  # a held force would be a delay of half a sample
        if i % over == 0:
            position[i // over], force[i // over] = q, F
        v += (F - 60 * v - friction(v)) / 20 / (rate * over)
        q += v / (rate * over)
    return {"time": np.arange(n) / rate, "position": position + 1e-7 * rng.standard_normal(n),
            "force": force + noise * rng.standard_normal(n), "reference": reference[::over]}


def coulomb(v):
    return 15 * math.tanh(v / 1e-3)


def joint(seed, Fc=12.0, offset=9.0, duration=20.0):
    """Robot joint in a loop along slow sines: 2.4 kg m^2, 4 N m s/rad, friction and a constant moment, 500 Hz."""
    rng, rate, over = np.random.default_rng(seed), 500, 8
    n = int(duration * rate)
    t = np.arange(n * over) / (rate * over)
    phases = rng.uniform(0, 2 * np.pi, 4)
    path = sum(a * np.sin(2 * np.pi * f * t + p) for a, f, p in
               zip((0.5, 0.2, 0.08, 0.03), (0.1, 0.25, 0.55, 1.3), phases, strict=True))
    wanted, slope = path.tolist(), np.gradient(path, t).tolist()
    q, v, angle, moment = wanted[0], slope[0], np.empty(n), np.empty(n)
    for i in range(n * over):
        M = 4000 * (wanted[i] - q) + 200 * (slope[i] - v)
        if i % over == 0:
            angle[i // over], moment[i // over] = q, M
        v += (M - 4 * v - Fc * math.tanh(v / 2e-3) - offset) / 2.4 / (rate * over)
        q += v / (rate * over)
    return {"time": np.arange(n) / rate, "position": angle + 2e-6 * rng.standard_normal(n),
            "force": moment + 0.8 * rng.standard_normal(n)}


def friction_gap(data, rate=1000.0):
    return find_axis_gap("drive", records=[Signals("a", data["force"], data["position"])], rate=rate)


def test_drive_without_a_gap_names_nothing():
    gap = friction_gap(drive(lambda v: 0.0))
    assert gap.verdict == "none" and not gap.effects


def test_drive_with_friction_and_an_offset():
    gap = friction_gap(drive(lambda v: coulomb(v) + 4))
    assert names(gap) == ["coulomb_friction", "force_offset"]
    assert gap.effects[0].parameters["Fc"].value == pytest.approx(15, rel=0.05)
    assert gap.effects[1].parameters["offset"].value == pytest.approx(4, rel=0.05)
    assert "coulomb_asymmetry@drive" in gap.effects[1].indistinguishable_from and "at rest" in gap.next_experiment


@pytest.mark.parametrize("seed", [0, 1, 2, 3, 4])
def test_joint_with_friction_and_a_constant_force(seed):
    gap = friction_gap(joint(seed), 500.0)
    assert set(names(gap)) == {"coulomb_friction", "force_offset"}
    friction = next(e for e in gap.effects if e.name == "coulomb_friction")
    assert friction.parameters["Fc"].value == pytest.approx(12, rel=.1)


def test_exchanged_columns_and_a_flipped_sign_are_refused():
    data = drive(coulomb)
    with pytest.raises(InputError, match="exchanged"):
        friction_gap({"force": data["position"], "position": data["force"]})
    with pytest.raises(InputError, match="flipped"):
        friction_gap(data | {"force": -data["force"]})


@pytest.mark.parametrize(("name", "factor"), [("delay", lambda s: np.exp(-2.4e-3 * s)),
                                              ("first_order_lag", lambda s: 1 / (1 + 2.4e-3 * s))])
def test_laser_of_a_seismometer_that_is_late(name, factor):
    rng, f = np.random.default_rng(0), np.geomspace(0.1, 12, 18)
    s = 2j * np.pi * f
    D = s ** 2 + 1.4 * np.pi * s + np.pi ** 2
    H = {"coil": 4.0 * s / D, "displacement": 0.02 / D * factor(s)}
    H = {kind: h * (1 + 3e-4 * (rng.standard_normal(18) + 1j * rng.standard_normal(18))) for kind, h in H.items()}
    gap = find_axis_gap("seismometer", responses=Responses(f, H, {k: 1.8e-7 * np.abs(h) ** 2 for k, h in H.items()}))
    assert [(e.name, e.location) for e in gap.effects] == [(name, "displacement")]
    assert next(iter(gap.effects[0].parameters.values())).value == pytest.approx(2.4e-3, rel=0.01)


def file_of(data, name):
    path = data / name
    if not path.exists():
        pytest.skip(f"measured data absent: {path}")
    return path


EMPS = {"force": "vir", "position": "qm", "t": "t"}


@pytest.mark.parametrize("cutoff", [30.0, 100.0, None])
def test_emps_with_pulses_has_a_pure_delay_at_every_cutoff(data, cutoff):
    options = {} if cutoff is None else {"cutoff_Hz": cutoff}
    gap = find_axis_gap_in("drive", file_of(data, "emps/DATA_EMPS_PULSES.mat"), EMPS, scale={"force": 35.15}, **options)
    assert set(names(gap)) == {"coulomb_friction", "viscous_asymmetry", "delay"}
    late = next(e for e in gap.effects if e.name == "delay")
    # 0.77 ms by the phase of force over acceleration above 100 Hz.
    assert late.parameters["delay_s"].value == pytest.approx(0.78e-3, rel=0.05) and late.probability > 0.9


def test_emps_has_friction(data):
    gap = find_axis_gap_in("drive", file_of(data, "emps/DATA_EMPS.mat"), EMPS, scale={"force": 35.15})
    assert names(gap)[:2] == ["coulomb_friction", "viscous_asymmetry"]
    assert gap.parameters["M"].value == pytest.approx(95.109, rel=0.01)  # published
    assert json.loads(json.dumps(gap.to_json(), allow_nan=False))["effects"]


def test_silverbox_and_what_its_model_predicts(data, tmp_path):
    path = file_of(data, "silverbox/Schroeder80mV.mat")
    how = {"sample_rate_Hz": 1e7 / 2 ** 14}
    gap = find_axis_gap_in("oscillator", path, {"u": "V1", "y": "V2"}, band_Hz=(1.0, 200.0),
                           range_s=(37.0, 115.0), **how)
    assert names(gap) == ["cubic_stiffness"] and gap.verdict == "explained"
    ratio = gap.ratios["k3/k"]
    assert 3.983 < ratio.value < 4.002 and ratio.std > 0.0095  # other stretches scatter over this range
    (record,), rate = signals_in("oscillator", [path],
                                Reading({"u": "V1", "y": "V2"}, {}, range_s=(130.0, 140.0), **how))
    left = [np.std((predicted(gap.model, which, record, rate) - record.position)[500:-100]) / np.std(record.position)
            for which in ("baseline", "updated")]
    assert left[1] < 0.01 < 0.1 < left[0]
    files = write_axis_gap(tmp_path, gap, path.name, {}, axis_gap_reports)
    assert set(files) == {"gap.json", "gap.html", "gap.pdf", "axis_model.json"}
    assert json.loads((tmp_path / "gap.json").read_text())["effects"][0]["name"] == "cubic_stiffness"
    (_, baseline, updated), = write_axis_predictions(tmp_path, [path], tmp_path / "p.h5")
    assert updated < 0.1 * baseline


def test_mirror_depends_on_the_level_and_no_single_effect_explains_it(data):
    gap = find_axis_gap_in("levels", file_of(data, "fine_steering_mirror"), sample_rate_Hz=6400.0)
    assert gap.verdict == "unexplained" and gap.effects == () and gap.over_noise > 3
    text = " ".join(gap.sentences)
    assert "responses change by 34.9 %" in text
    # The first mode by the fit of each level in the tests of identification.
    assert "814.11 +- 0.051 Hz to 806.29 +- 0.058 Hz (-0.96 %)" in text


def test_laser_of_the_sm3_is_late(data):
    folder = file_of(data, "seismometer_sm3")
    rows = (line.split(",") for line in (folder / "calcontrol.cal").read_text().split())
    adc = dict(zip(*rows, strict=True))
    laser = float(adc["ch3cal"]) * 1e-9 * float(adc["laserres"]) * float(adc["lcalconst"])
    gap = find_axis_gap_in("seismometer", folder, {"drive": "FuncGen", "coil": "Current", "displacement": "Laser",
                                                   "t": "Seconds"},
                           scale={"drive": float(adc["ch1cal"]) * 1e-6, "coil": float(adc["ch2cal"]) * 1e-6,
                                  "displacement": laser})
    assert [(e.name, e.location) for e in gap.effects] == [("delay", "displacement")]
    # 2.44 ms from the phases alone.
    assert gap.effects[0].parameters["delay_s"].value == pytest.approx(2.44e-3, abs=0.01e-3)
    assert gap.effects[0].probability == max([gap.effects[0].probability, *(r.probability for r in gap.runners_up)])
    assert gap.stages[1].nrmse < 0.5 * gap.stages[0].nrmse
    text = " ".join(gap.sentences)
    assert "Harmonics of the motion" in text and "record 0_2Hz, displacement" in text
