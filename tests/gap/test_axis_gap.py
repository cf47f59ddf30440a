"""Gaps of one axis with a truth that is known: integrated in time, apart from the models under test."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from scipy import signal

from avis_ctrl.cli.gap_axis import gap_axis
from avis_ctrl.errors import InputError
from avis_ctrl.gap.axis import Signals, analysis, find_axis_gap, find_axis_gap_in
from avis_ctrl.gap.axis.find import Reading, signals_in
from avis_ctrl.gap.axis.level_dependence import level_effects
from avis_ctrl.gap.axis.mass_effects import Scale, drive_effects, oscillator_effects
from avis_ctrl.gap.axis.model import Effect, Parameter
from avis_ctrl.gap.axis.search import Explored
from avis_ctrl.gap.axis.seismometer import sensor_effects
from avis_ctrl.identification.single_axis.seismometer import Responses
from avis_ctrl.measurement.campaign import Campaign, Record, RecordHeader

RATE = 600.0


def names(gap):
    return [effect.name for effect in gap.effects]


def value(effect):
    return next(iter(effect.parameters.values())).value


# --- oscillator


def oscillator(extra, seed, n=24_576, noise=1e-3, drive=lambda u: u):
    """u and y of y''/w^2 + 2 zeta y'/w + y + extra(y, y') = drive(u), w = 2 pi 60, zeta 5 %, by Runge-Kutta in steps of
    a sixteenth sample with the band-limited u at every half step; the level swells and falls twice."""
    rng, over = np.random.default_rng(seed), 8
    f = np.fft.rfftfreq(n, 1 / RATE)
    U = np.where((f > 1) & (f < 200), np.exp(2j * np.pi * rng.random(len(f))), 0)
    fine = np.fft.irfft(np.r_[U, np.zeros(n * over - len(U) + 1)], 2 * n * over)
    fine *= 0.6 + 0.4 * np.sin(np.linspace(0, 5 * np.pi, len(fine)))
    fine = [*(fine / fine.std()).tolist(), 0.0, 0.0]
    w, h = 2 * np.pi * 60, 1 / RATE / over

    def a(y, v, u):
        return (drive(u) - 0.1 / w * v - y - extra(y, v)) * w * w

    y = v = 0.0
    found = np.empty(n)
    for i in range(n * over):
        if i % over == 0:
            found[i // over] = y
        u0, um, u1 = fine[2 * i : 2 * i + 3]
        a1 = a(y, v, u0)
        a2 = a(y + h / 2 * v, v + h / 2 * a1, um)
        a3 = a(y + h / 2 * (v + h / 2 * a1), v + h / 2 * a2, um)
        a4 = a(y + h * (v + h / 2 * a2), v + h * a3, u1)
        y, v = y + h * v + h * h / 6 * (a1 + a2 + a3), v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
    return np.array(fine[: 2 * over * n : 2 * over]), found + noise * found.std() * rng.standard_normal(n)


def searched(extra, seed, own=(), **how):
    u, y = oscillator(extra, seed, **how)
    return find_axis_gap("oscillator", records=[Signals("a", u, y)], rate=RATE, band_Hz=(2.0, 180.0), own=own)


def slow(*cases):
    """Cases of `make test-slow`: the same search from other seeds or with other forces."""
    return [pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.slow) for case in cases]


def stops(y, v):
    return 0.5 * math.copysign(max(abs(y) - 3.0, 0.0), y)


@pytest.mark.parametrize(
    ("name", "extra", "true"),
    [
        ("cubic_stiffness", lambda y, v: 0.01 * y**3, 0.01),
        *slow(
            ("quadratic_stiffness", lambda y, v: 0.02 * y * y, 0.02),
            ("quadratic_damping", lambda y, v: 2e-6 * abs(v) * v, 2e-6),
            ("coulomb_friction", lambda y, v: 0.1 * math.tanh(v / 5), 0.1),
            ("end_stops", stops, 0.5),
        ),
    ],
)
def test_the_right_force_is_named(name, extra, true):
    gap = searched(extra, 1)
    assert names(gap) == [name] and gap.verdict == "explained"
    effect = gap.effects[0]
    assert effect.probability == 0.99 and not effect.indistinguishable_from
    assert value(effect) == pytest.approx(true, rel=0.01)
    assert gap.stages[1].nrmse < gap.stages[0].nrmse / 5


@pytest.mark.slow
def test_end_stops_begin_behind_their_gap():
    gap = searched(stops, 2)
    assert names(gap) == ["end_stops"] and gap.effects[0].parameters["gap"].value == pytest.approx(3, rel=0.01)


@pytest.mark.slow
def test_two_effects_are_named_both():
    gap = searched(lambda y, v: 0.01 * y**3 + 2e-6 * abs(v) * v, 2)
    found = {one.name: value(one) for one in (*gap.effects, *gap.traces)}
    assert set(found) == {"cubic_stiffness", "quadratic_damping"} and gap.verdict == "explained"
    assert found["cubic_stiffness"] == pytest.approx(0.01, rel=0.02)
    assert found["quadratic_damping"] == pytest.approx(2e-6, rel=0.01)


@pytest.mark.parametrize(("seed", "noise"), [(1, 1e-3), *slow((2, 1e-3), (3, 1e-3)), (4, 0.1)])
def test_nothing_is_named_where_nothing_is_missing(seed, noise):
    gap = searched(lambda y, v: 0.0, seed, n=16_384, noise=noise)
    assert gap.verdict == "none" and not gap.effects and gap.remaining
    assert gap.sentences[0].startswith("No missing effect was found")
    # Nothing repeats: the noise is unknown, and all of the base model's residual remains.
    assert np.isnan(gap.left.over_noise) and gap.left.share == pytest.approx(1)


@pytest.mark.slow
def test_false_alarms_are_few():
    verdicts = [
        searched(lambda y, v: 0.0, seed, n=16_384, noise=10 ** -(1 + seed % 3)).verdict for seed in range(100, 130)
    ]
    assert verdicts.count("none") >= 29, verdicts


@pytest.mark.slow
@pytest.mark.parametrize(
    "extra",
    [
        lambda y, v: 0.03 * y**3 / (1 + 0.05 * y * y),  # stiffens and gives way: near a cubic spring, and near stops
        lambda y, v: 0.3 * math.sin(2 * y),  # a periodic force: near no law
    ],
    ids=["giving way", "periodic"],
)
def test_outside_the_library_nothing_is_named(extra):
    gap = searched(extra, 3)
    assert gap.verdict == "unexplained" and not gap.effects
    assert gap.remaining and "no effect of the library explains it" in gap.sentences[0]
    assert any("another function of the position" in s for s in gap.sentences)


@pytest.mark.slow
def test_an_own_effect_is_one_object():
    mine = Effect(
        "wave",
        "oscillator",
        "a force that is periodic in the position",
        (Parameter("F", "{F}"),),
        shapes=(lambda m: np.sin(2 * m.q),),
        variable="position",
    )
    gap = searched(lambda y, v: 0.3 * math.sin(2 * y), 1, own=[mine])
    assert names(gap) == ["wave"] and value(gap.effects[0]) == pytest.approx(0.3, rel=0.01)
    for wrong in (Effect("cubic_stiffness", "oscillator", "again", (Parameter("k", "1"),)), Effect("", "", "", ())):
        with pytest.raises(InputError, match="no other has"):
            searched(lambda y, v: 0.0, 1, own=[wrong], n=8192)


@pytest.mark.slow
def test_a_drive_that_saturates():
    gap = searched(lambda y, v: 0.0, 6, drive=lambda u: 2 * math.tanh(u / 2))
    assert names(gap) == ["input_saturation"] and gap.verdict == "explained"
    assert gap.effects[0].parameters["level"].value == pytest.approx(2, rel=0.01)


@pytest.mark.slow
def test_the_same_data_give_the_same_numbers_and_held_out_is_held_out():
    u, y = oscillator(lambda y, v: 0.01 * y**3, 3, n=16_384)

    def found(y):
        return find_axis_gap("oscillator", records=[Signals("a", u, y)], rate=RATE, band_Hz=(2.0, 180.0))

    gaps = [found(y), found(y)]
    assert gaps[0].to_json()["effects"] == gaps[1].to_json()["effects"]
    # Noise in the middle of the second sixth, which is held out, spoils the score and not the fit.
    spoiled = y.copy()
    spoiled[3700:4700] += 0.1 * np.random.default_rng(0).standard_normal(1000) * y.std()
    other = found(spoiled)
    assert value(other.effects[0]) == pytest.approx(value(gaps[0].effects[0]), rel=1e-4)
    assert other.stages[-1].nrmse > 5 * gaps[0].stages[-1].nrmse


# --- drive


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
    return {
        "time": np.arange(n) / rate,
        "position": position + 1e-7 * rng.standard_normal(n),
        "force": force + noise * rng.standard_normal(n),
        "reference": reference[::over],
    }


def coulomb(v):
    return 15 * math.tanh(v / 1e-3)


def joint(seed, Fc=12.0, offset=9.0, duration=20.0):
    """Robot joint in a loop along slow sines: 2.4 kg m^2, 4 N m s/rad, friction and a constant moment, 500 Hz."""
    rng, rate, over = np.random.default_rng(seed), 500, 8
    n = int(duration * rate)
    t = np.arange(n * over) / (rate * over)
    phases = rng.uniform(0, 2 * np.pi, 4)
    path = sum(
        a * np.sin(2 * np.pi * f * t + p)
        for a, f, p in zip((0.5, 0.2, 0.08, 0.03), (0.1, 0.25, 0.55, 1.3), phases, strict=True)
    )
    wanted, slope = path.tolist(), np.gradient(path, t).tolist()
    q, v, angle, moment = wanted[0], slope[0], np.empty(n), np.empty(n)
    for i in range(n * over):
        M = 4000 * (wanted[i] - q) + 200 * (slope[i] - v)
        if i % over == 0:
            angle[i // over], moment[i // over] = q, M
        v += (M - 4 * v - Fc * math.tanh(v / 2e-3) - offset) / 2.4 / (rate * over)
        q += v / (rate * over)
    return {
        "time": np.arange(n) / rate,
        "position": angle + 2e-6 * rng.standard_normal(n),
        "force": moment + 0.8 * rng.standard_normal(n),
    }


def friction_gap(data, rate=1000.0, **options):
    return find_axis_gap("drive", records=[Signals("a", data["force"], data["position"])], rate=rate, **options)


@pytest.mark.slow
def test_drive_coulomb_friction():
    gap = friction_gap(drive(coulomb))
    assert names(gap) == ["coulomb_friction"] and gap.verdict == "explained"
    assert value(gap.effects[0]) == pytest.approx(15, rel=0.02) and gap.effects[0].probability == 0.99
    assert gap.parameters["M"].value == pytest.approx(20, rel=0.02)
    assert gap.parameters["Fv"].value == pytest.approx(60, rel=0.03)
    assert any("repeats every 6 s" in s for s in gap.sentences)


def test_drive_without_a_gap_names_nothing():
    gap = friction_gap(drive(lambda v: 0.0))
    assert gap.verdict == "none" and not gap.effects


@pytest.mark.slow
def test_drive_with_friction_and_an_offset():
    """Wherever the drive moves, an offset and friction that differs between the directions are the same force."""
    gap = friction_gap(drive(lambda v: coulomb(v) + 4))
    assert names(gap) == ["coulomb_friction", "force_offset"]
    assert gap.effects[0].parameters["Fc"].value == pytest.approx(15, rel=0.05)
    assert gap.effects[1].parameters["offset"].value == pytest.approx(4, rel=0.05)
    assert "coulomb_asymmetry@drive" in gap.effects[1].indistinguishable_from and "at rest" in gap.next_experiment


@pytest.mark.slow
def test_drive_whose_friction_differs_between_the_directions():
    """Of 15 N ahead and 9 N back, 12 N are friction and 6 N the difference, or 3 N an offset."""
    gap = friction_gap(drive(lambda v: coulomb(v) * (1.0 if v > 0 else 0.6)))
    found = {e.name: value(e) for e in gap.effects}
    assert found.pop("coulomb_friction") == pytest.approx(12, rel=0.02)
    assert found in ({"coulomb_asymmetry": pytest.approx(6, rel=0.05)}, {"force_offset": pytest.approx(3, rel=0.05)})
    assert all(e.probability > 0.9 for e in gap.effects)


@pytest.mark.slow
def test_drive_that_slows_down_in_one_direction_only():
    gap = friction_gap(drive(lambda v: coulomb(v) + (40 * v if v < 0 else 0)))
    assert set(names(gap)) == {"coulomb_friction", "viscous_asymmetry"}
    found = next(e for e in gap.effects if e.name == "viscous_asymmetry")
    assert value(found) == pytest.approx(-40, rel=0.1)


@pytest.mark.parametrize("seed", [0, *slow(1, 2, 3, 4)])
def test_joint_with_friction_and_a_constant_force(seed):
    gap = friction_gap(joint(seed), 500.0)
    assert set(names(gap)) == {"coulomb_friction", "force_offset"}
    found = {e.name: e for e in gap.effects}
    assert value(found["coulomb_friction"]) == pytest.approx(12, rel=0.02)
    assert value(found["force_offset"]) == pytest.approx(9, rel=0.02)
    assert "coulomb_asymmetry@drive" in found["force_offset"].indistinguishable_from
    assert gap.stages[-1].nrmse < gap.stages[0].nrmse / 5


@pytest.mark.slow
@pytest.mark.parametrize(("shift", "seed"), [(5, 0), (5, 1), (10, 2)])
def test_a_force_logged_late_is_a_negative_delay(shift, seed):
    data = drive(coulomb, seed)
    gap = friction_gap(data | {"force": np.roll(data["force"], shift)})
    found = {e.name: value(e) for e in gap.effects}
    assert found["delay"] == pytest.approx(-1e-3 * shift, rel=0.02)
    assert found["coulomb_friction"] == pytest.approx(15, rel=0.02)
    assert any("The delay is negative" in s and "logged late" in s for s in gap.sentences)


def test_exchanged_columns_and_a_flipped_sign_are_refused():
    data = drive(coulomb)
    with pytest.raises(InputError, match="exchanged"):
        friction_gap({"force": data["position"], "position": data["force"]})
    with pytest.raises(InputError, match="wrong sign"):
        friction_gap(data | {"force": -data["force"]})
    u, y = oscillator(lambda y, v: 0.01 * y**3, 1, n=8192)
    for columns, said in (((y, u), "exchanged"), ((-u, y), "wrong sign")):
        with pytest.raises(InputError, match=said):
            find_axis_gap("oscillator", records=[Signals("a", *columns)], rate=RATE, band_Hz=(2.0, 180.0))


# --- seismometer


def seismometer(factor, scatter=3e-4, seed=0):
    """Coil and laser of a mass of 0.5 Hz, damping 0.7; `factor` on the laser."""
    rng = np.random.default_rng(seed)
    f = np.geomspace(0.1, 12, 18)
    s = 2j * np.pi * f
    D = s**2 + 2 * 0.7 * np.pi * s + np.pi**2
    H = {"coil": 4.0 * s / D, "displacement": 0.02 / D * factor(s)}
    H = {kind: h * (1 + scatter * (rng.standard_normal(18) + 1j * rng.standard_normal(18))) for kind, h in H.items()}
    return {"responses": Responses(f, H, {kind: 2 * scatter**2 * np.abs(h) ** 2 for kind, h in H.items()})}


@pytest.mark.parametrize(
    ("name", "factor", "true"),
    [
        ("delay", lambda s: np.exp(-2.4e-3 * s), 2.4e-3),
        ("first_order_lag", lambda s: 1 / (1 + 2.4e-3 * s), 2.4e-3),
        ("mechanical_mode", lambda s: 1 / (1 + 2 * 0.05 * s / (2 * np.pi * 30) + (s / (2 * np.pi * 30)) ** 2), 30.0),
        ("highpass", lambda s: s / (s + 2 * np.pi * 0.02), 0.02),
    ],
)
def test_seismometer_channel(name, factor, true):
    gap = find_axis_gap("seismometer", **seismometer(factor))
    assert [(e.name, e.location) for e in gap.effects] == [(name, "displacement")]
    assert gap.verdict == "explained" and gap.stages[-1].chi2_per_dof < 2
    p = next(iter(gap.effects[0].parameters.values()))
    assert p.value == pytest.approx(true, rel=0.03) and abs(p.value - true) < 5 * p.std


def test_seismometer_small_lags_are_a_group():
    """With a scatter of 1 %, delay and pole of 2.4 ms differ by less than can be seen."""
    gap = find_axis_gap("seismometer", **seismometer(lambda s: np.exp(-2.4e-3 * s), scatter=1e-2))
    group = {gap.effects[0].name, *(n.split("@")[0] for n in gap.effects[0].indistinguishable_from)}
    assert {"delay", "first_order_lag"} <= group and gap.next_experiment


def test_seismometer_without_a_gap():
    verdicts = [find_axis_gap("seismometer", **seismometer(lambda s: 1.0, seed=seed)).verdict for seed in range(8)]
    assert verdicts.count("none") >= 7, verdicts


# --- levels


def two_levels(gain, seed=0):
    """6 experiments of 2 inputs at each of two levels, two periods; `gain` is the static law before a mode at 40 Hz."""
    rng, n, rate, records = np.random.default_rng(seed), 2000, 500.0, []
    b, a = signal.bilinear([1.0], [1 / (2 * np.pi * 40) ** 2, 0.05 / (2 * np.pi * 40), 1.0], rate)
    f = np.fft.rfftfreq(n, 1 / rate)
    for level in (0.1, 0.3):
        for k in range(6):
            U = np.where((f > 2) & (f < 150), np.exp(2j * np.pi * rng.random((2, len(f)))), 0)
            u = np.fft.irfft(U, n)
            u *= level / u.std()
            x = np.tile(gain(u), (1, 6))  # four periods to settle
            y = signal.lfilter(b, a, x)[:, 4 * n :] + 1e-4 * rng.standard_normal((2, 2 * n))
            y = np.array([[1.0, 0.3], [0.2, 1.0]]) @ y
            header = RecordHeader(
                f"{level:g}_{k}", rate, 2 * n, ("u1", "u2"), ("y1", "y2"), "multisine", level, period_s=n / rate
            )
            records.append(Record(header, np.tile(u, (1, 2)).T, y.T))
    return Campaign("two levels", tuple(records))


def test_a_linear_system_is_the_same_at_all_levels():
    verdicts = [
        find_axis_gap("levels", campaign=two_levels(lambda u: u, seed), transient="none").verdict for seed in range(10)
    ]
    assert verdicts.count("none") >= 9, verdicts


def test_a_saturating_drive_is_told_from_a_gain_by_level():
    gap = find_axis_gap("levels", campaign=two_levels(lambda u: u / (1 + 2 * u**2)), transient="none")
    # Bussgang (1952): under a Gaussian input of r.m.s. sigma, the best linear gain of a static law is the mean slope.
    x, w = np.polynomial.hermite_e.hermegauss(80)
    slope = [float(np.sum(w * (1 - 2 * (s * x) ** 2) / (1 + 2 * (s * x) ** 2) ** 2) / np.sum(w)) for s in (0.1, 0.3)]
    (found,) = gap.effects
    lost = found.parameters["gain_lost"]
    assert found.name == "saturation" and abs(lost.value - (1 - slope[1] / slope[0])) < 3 * lost.std < 0.03
    gap = find_axis_gap("levels", campaign=two_levels(lambda u: u * (1.0 if u.std() < 0.2 else 0.8)), transient="none")
    assert names(gap) == ["gain_by_level"] and value(gap.effects[0]) == pytest.approx(0.2, rel=0.01)


# --- hostile input

WAVE = Signals("a", np.sin(np.arange(4000.0)), np.cos(np.arange(4000.0)))


def of(force, position):
    return {"records": [Signals("a", np.asarray(force, float), np.asarray(position, float))], "rate": 1000.0}


@pytest.mark.parametrize(
    ("kind", "data", "said"),
    [
        ("table", {}, "expected one of drive, oscillator, seismometer, levels"),
        ("oscillator", {}, r"kind oscillator needs the data records, rate, \[band_Hz\]"),
        ("oscillator", of(WAVE.force, np.zeros(3)), "4000 finite"),
        ("oscillator", of(WAVE.force, np.full(4000, np.nan)), "finite"),
        ("oscillator", {"records": [WAVE], "rate": -1.0}, "sample rate"),
        ("oscillator", {"records": [], "rate": 600.0}, "at least one record"),
        ("oscillator", {"records": [WAVE], "rate": 600.0, "band_Hz": (300.0, 20.0)}, "low < high"),
        ("oscillator", of(np.zeros(400), np.zeros(400)), "changes"),
        ("drive", of(np.zeros(10), np.zeros(10)), "64 samples"),
        ("drive", of(np.ones(9999), np.zeros(9999)), "changes"),
        ("drive", of(np.ones(9999), np.zeros(3)), "9999 finite"),
        ("drive", of(np.sin(np.arange(100.0)), np.arange(100.0)), "a longer record"),
        (
            "drive",
            of(*(drive(coulomb, duration=2.0)[name] for name in ("force", "position"))) | {"cutoff_Hz": 600.0},
            "cutoff between 0 and 500 Hz",
        ),
        ("levels", {"campaign": Campaign("one", two_levels(lambda u: u).records[:6])}, "two levels"),
    ],
)
def test_wrong_data_are_refused_in_one_line(kind, data, said):
    with pytest.raises(InputError, match=said) as caught:
        find_axis_gap(kind, **data)
    assert "\n" not in str(caught.value)


def test_an_odd_last_frequency_is_left_out_with_a_note():
    data = seismometer(lambda s: 1.0)["responses"]
    for count in (17, 18):
        gap = find_axis_gap("seismometer", responses=data.at(np.arange(18) < count))
        assert any("is not used" in sentence for sentence in gap.sentences) == (count == 17)


def test_a_range_ends_within_the_record(tmp_path):
    x = np.arange(1000.0)
    np.savetxt(
        tmp_path / "a.csv",
        np.column_stack([x / 1000, np.sin(x), np.cos(x)]),
        delimiter=",",
        header="t,F,q",
        comments="",
    )
    columns = {"t": "t", "force": "F", "position": "q"}
    (record,), _ = signals_in("drive", [tmp_path / "a.csv"], Reading(columns, {}, range_s=(0.5, 1.0)))
    assert len(record.force) == 500
    with pytest.raises(InputError, match="inside the record's 1 s"):
        signals_in("drive", [tmp_path / "a.csv"], Reading(columns, {}, range_s=(0.5, 1.001)))


def test_effects_that_are_lost_with_a_failed_fit_are_reported(monkeypatch):
    """One of two effects is refused, and no fit without it succeeds."""
    u, y = oscillator(lambda y, v: 0.01 * y**3, 1, n=4096)
    (first, second) = ("cubic_stiffness", "quadratic_damping")

    def both(explored, progress):
        chosen = [next(one for one in explored.problem.library if one.name == name) for name in (first, second)]
        return explored.with_effects(explored.base, [(one, np.zeros(len(one.parameters))) for one in chosen])

    monkeypatch.setattr(analysis, "search", both)
    monkeypatch.setattr(analysis, "_refusal", lambda *known: "it is refused")
    monkeypatch.setattr(Explored, "without", lambda *known: None)
    gap = find_axis_gap("oscillator", records=[Signals("a", u, y)], rate=RATE, band_Hz=(2.0, 180.0))
    (said,) = (sentence for sentence in gap.sentences if sentence.startswith("Not named"))
    assert gap.effects == () and first in said and second in said and "no fit without" in said


def test_few_frequencies_are_refused():
    data = seismometer(lambda s: 1.0)["responses"]
    with pytest.raises(InputError, match="8 frequencies"):
        find_axis_gap("seismometer", responses=data.at(np.arange(18) < 6))
    with pytest.raises(InputError, match="none negative"):
        find_axis_gap("seismometer", responses=data, distortion=-np.ones(18))


def test_wrong_folders_of_levels_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"u_\*\.npy"):
        find_axis_gap_in("levels", tmp_path)
    np.save(tmp_path / "u_100mV.npy", np.zeros((8, 1, 2, 2)))
    with pytest.raises(InputError, match="sample rate"):
        find_axis_gap_in("levels", tmp_path)
    with pytest.raises(InputError, match=r"y_100mV\.npy"):
        find_axis_gap_in("levels", tmp_path, sample_rate_Hz=10.0)
    (tmp_path / "y_100mV.npy").write_bytes(b"not an array")
    with pytest.raises(InputError, match="expected an array"):
        find_axis_gap_in("levels", tmp_path, sample_rate_Hz=10.0)
    np.save(tmp_path / "y_100mV.npy", np.zeros((9, 1, 2, 2)))
    with pytest.raises(InputError, match="realisations and periods"):
        find_axis_gap_in("levels", tmp_path, sample_rate_Hz=10.0)
    with pytest.raises(InputError, match="no columns"):
        find_axis_gap_in("levels", tmp_path, {"u": "a"})


@pytest.mark.parametrize(
    ("columns", "scale", "said"),
    [
        ({"force": "F"}, None, "a column for position"),
        ({"force": "F", "positon": "q"}, None, "expected one of"),
        ({"force": "F", "position": "q", "t": "t"}, {"force": 0.0}, "finite factor"),
    ],
)
def test_wrong_columns_are_refused(tmp_path, columns, scale, said):
    with pytest.raises(InputError, match=said):
        find_axis_gap_in("drive", tmp_path / "x.csv", columns, scale=scale)


@pytest.mark.parametrize(
    "library",
    [
        drive_effects(Scale(2.0, 1.0, 1.0, 1.0, 1.0, 60.0, (50.0,))),
        oscillator_effects(Scale(2.0, 1.0, 1.0, 1.0, 1.0, 60.0)),
        sensor_effects(np.geomspace(0.1, 10, 12), ("coil", "displacement")),
        level_effects(True),
        level_effects(False),
    ],
    ids=["drive", "oscillator", "seismometer", "static law", "level"],
)
def test_effects_say_what_they_are(library):
    labels = [one.label for one in library]
    assert len(labels) == len(set(labels))
    for one in library:
        assert one.name and one.location and one.title and one.parameters and (one.separated_by or one.outside)
        assert one.variable in ("", "position", "velocity", "input")


def test_the_command_writes_gap_json(tmp_path, capsys):
    """A CSV of a drive through the command's function: the sentence, and the file."""
    data = drive(coulomb)
    table = np.column_stack([data[name] for name in ("time", "position", "force")])
    np.savetxt(tmp_path / "drive.csv", table, delimiter=",", header="t,q,F", comments="")
    gap_axis("drive", tmp_path / "drive.csv", columns="t=t,position=q,force=F", out=tmp_path / "out")
    assert "Coulomb friction" in capsys.readouterr().out
    written = json.loads((tmp_path / "out" / "gap.json").read_text())
    assert written["format"] == "avis-gap-axis" and written["effects"][0]["name"] == "coulomb_friction"
    with pytest.raises(InputError, match="ROLE=NAME"):
        gap_axis("drive", tmp_path / "drive.csv", columns="t")
