"""Cluttered tables: tolerances, traces and richer laws, against closed forms, the package's matrices and statistics."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from avis_ctrl.rigs import IsolatorTable

from . import cases, clutter
from .cases import best_prediction, build_plant, draw_case, rig, run, simulate_case, tolerances
from .clutter import DEFAULTS, TRACES, disturb, far
from .kernel import FIRST_EFFECT_STATE
from .library_mechanics import LADDER_HZ
from .signals import multisine, noise
from .table import Plant, draw_plant, matrices
from .test_truth import RATE, misfit, response_to
from .variants import VARIANTS

pytestmark = pytest.mark.filterwarnings("ignore::numba.NumbaPerformanceWarning")


@pytest.fixture(autouse=True)
def _needs_rig(shared: Path) -> None:
    """The rig file lies in the shared folder."""


@pytest.fixture
def no_traces(monkeypatch):
    """Drawing them takes seconds."""
    monkeypatch.setattr(cases, "_pilot_of", lambda case: None)
    monkeypatch.setattr(cases, "draw_traces", lambda *given: ())


@pytest.fixture(scope="module")
def traced() -> cases.Case:
    return draw_case(5, kind="none", clutter=True)


def loose(times: float = 8.0, without: str = "") -> Plant:
    """A table with every tolerance drawn, so much larger that each can be seen; strongly damped."""
    plant = draw_plant(rig(), np.random.default_rng(3))
    limits = {name: 0.0 if name == without else times * value for name, value in tolerances(rig()).items()}
    disturb(plant, limits, np.random.default_rng(4))
    plant.c = plant.c * 5
    return plant


def of_variant(effect: str, variant: str, strength: str = "gross", seed: int = 5, damping: float = 1.0) -> tuple:
    """The plant, and the hidden effect."""
    case = draw_case(seed, effect=effect, strength=strength, clutter=True, variant=variant)
    assert case.effects[0].details["variant"] == variant
    plant = build_plant(case)
    plant.c = plant.c * damping
    return plant, case.effects[0]


# --- tolerances


@pytest.mark.parametrize("effect", [None, "base_compliance"])
def test_without_tolerances_and_traces_the_table_is_the_clean_one(monkeypatch, effect):
    monkeypatch.setattr(cases, "tolerances", lambda rig: dict.fromkeys(DEFAULTS, 0.0))
    case = draw_case(7, kind=None if effect else "none", effect=effect, duration_s=2.0)
    for clean, cluttered in zip(
        simulate_case(case).records, simulate_case(replace(case, clutter=True)).records, strict=True
    ):
        np.testing.assert_array_equal(cluttered.y, clean.y)


def test_response_with_every_tolerance_in_closed_form():
    plant = loose()
    assert misfit(plant, plant).max() < 1.5e-4


@pytest.mark.parametrize("name", [name for name in DEFAULTS if name != "place_m"])
def test_the_closed_form_tells_each_tolerance(name):
    assert misfit(loose(), loose(without=name)).max() > 5e-3


@pytest.mark.parametrize("places", ["points", "motor_p", "sensor_p"])
def test_the_closed_form_tells_each_kind_of_place(places):
    other = loose()
    setattr(other, places, getattr(loose(without="place_m"), places))
    assert misfit(loose(), other).max() > 5e-3


def test_values_far_beyond_their_tolerance_are_known():
    """One in 370 of normal numbers lies beyond three standard deviations, one in 90 of angles in two directions."""
    before, after = (draw_plant(rig(), np.random.default_rng(3)) for _ in range(2))
    assert far(before, after, tolerances(rig()), 0.0) == []
    after.zn[4] *= 1.1
    after.motor[2] *= 0.96
    after.J[0, 2] = after.J[2, 0] = after.J[0, 2] + 1.0
    assert far(before, after, tolerances(rig()), 3.0) == [
        ("geophone_corner", "Sy3"),
        ("actuator_gain", after.motors[2]),
        ("product_of_inertia", "Jxz"),
    ]
    found = [one for seed in range(400) for one in cases.far_values(seed, 3.0)]
    # Per table 6 + 2 * 6 + 8 + 3 + 3 normal numbers and 6 angles.
    assert 0.7 < len(found) / (400 * (32 * 0.0027 + 6 * np.exp(-4.5))) < 1.3


def test_matrices_of_a_cluttered_table_are_those_of_the_package():
    plant, table = loose(), rig()
    isolators = tuple(
        replace(one, position=tuple(p), stiffness=tuple(k), damping=tuple(c))
        for one, p, k, c in zip(table.isolators, plant.points, plant.k, plant.c, strict=True)
    )
    drives = tuple(
        replace(one, position=tuple(p), direction=tuple(d), constant_N_per_V=float(tau))
        for one, p, d, tau in zip(table.all_drives, plant.motor_p, plant.motor_d, plant.motor, strict=True)
    )
    J = plant.J
    same: IsolatorTable = replace(
        table,
        mass=plant.m,
        inertia=(*np.diag(J), J[0, 1], J[0, 2], J[1, 2]),
        motors=(),
        centre_of_mass=tuple(plant.com),
        isolators=isolators,
        drives=drives,
    )
    motion = same.equations_of_motion()
    # The package's coordinates may sit elsewhere than in the centre of mass: compare what does not depend on it.
    M, C, K, T = matrices(plant)
    for s in (8j, 20j, 3 + 90j):
        ours = T.T @ np.linalg.solve(s * s * M + s * C + K, T)
        theirs = motion.T.T @ np.linalg.solve(s * s * motion.M + s * motion.C + motion.K, motion.T)
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-10 * np.abs(ours).max())


def test_tolerances_have_the_spread_that_the_contract_says():
    limits, drawn = tolerances(rig()), {name: [] for name in DEFAULTS}
    for seed in range(150):
        plant = draw_plant(rig(), np.random.default_rng(0), spread=0.0)
        bare = draw_plant(rig(), np.random.default_rng(0), spread=0.0)
        disturb(plant, limits, np.random.default_rng(seed))
        for places in ("points", "chassis_points", "motor_p", "sensor_p"):
            drawn["place_m"].append(getattr(plant, places) - getattr(bare, places))
        for axes in ("motor_d", "sensor_n"):
            now, before = getattr(plant, axes), getattr(bare, axes)
            np.testing.assert_allclose(np.linalg.norm(now, axis=1), 1.0)
            drawn["direction_rad"].append(now[before == 0])  # the two small components of each
        drawn["actuator_gain_percent"].append(plant.motor / bare.motor - 1)
        drawn["sensor_gain_percent"].append(plant.S / bare.S - 1)
        drawn["sensor_corner_percent"].append(plant.wn / bare.wn - 1)
        drawn["sensor_damping_percent"].append(plant.zn / bare.zn - 1)
        drawn["centre_of_mass_m"].append(plant.com)
        drawn["product_of_inertia_kgm2"].append(plant.J[np.triu_indices(3, 1)])
        np.testing.assert_array_equal(plant.J, plant.J.T)
    for name, values in drawn.items():
        z = np.concatenate([np.ravel(one) for one in values]) / limits[name]
        assert abs(np.mean(z)) < 4 / np.sqrt(len(z)), name
        assert abs(np.std(z) - 1) < 4 / np.sqrt(2 * len(z)), name


def test_contract_and_rig_file_state_the_tolerances(shared):
    text = (shared / "contracts" / "gap.md").read_text()
    for name, value in DEFAULTS.items():
        assert f"\n{name} = {value:g}" in text.replace(f"{name} = {value:.1f}", f"{name} = {value:g}")
    file = replace(rig(), tolerances=type("Stated", (), {"place_m": 0.004, "sensor_gain_percent": 2.5})())
    assert tolerances(file) == {
        name: value / (100 if "percent" in name else 1)
        for name, value in (DEFAULTS | {"place_m": 0.004, "sensor_gain_percent": 2.5}).items()
    }


def departure(plant: Plant, h: cases.Hidden) -> tuple[float, float, str]:
    """One and the departure from the rig file in what the effect moves; what the case says; the tolerance's name."""
    p, g, bare = h.parameters, rig().geophones, draw_plant(rig(), np.random.default_rng(0), spread=0.0)
    j = plant.sensors.index(h.location) if h.location in plant.sensors else 0
    if h.name == "sensor_gain":
        return plant.S[j] / bare.S[j], p["gain"], "sensor_gain_percent"
    if h.name == "actuator_gain":
        j = plant.motors.index(h.location)
        return plant.motor[j] / bare.motor[j], p["gain"], "actuator_gain_percent"
    if h.name == "geophone_corner":
        return plant.wn[j] / bare.wn[j], p["corner_Hz"] / g.suspension_Hz, "sensor_corner_percent"
    if h.name == "sensor_misalignment":
        return 1 + np.arccos(plant.sensor_n[j] @ bare.sensor_n[j]), 1 + p["angle_rad"], "direction_rad"
    if h.name == "com_offset":
        said = np.linalg.norm([p["x_m"], p["y_m"], p["z_m"]])
        return 1 + np.linalg.norm(plant.com), 1 + said, "centre_of_mass_m"
    a, b = ("xyz".index(letter) for letter in h.location[1:])
    return 1 + plant.J[a, b], 1 + p["product_kgm2"], "product_of_inertia_kgm2"


@pytest.mark.parametrize(
    "effect",
    ["sensor_gain", "actuator_gain", "geophone_corner", "sensor_misalignment", "com_offset", "product_of_inertia"],
)
def test_a_hidden_departure_lies_beyond_its_tolerance_and_is_told_in_all(no_traces, effect):
    for seed in range(6):
        case = draw_case(seed, effect=effect, strength="faint", clutter=True)
        found, said, tolerance = departure(build_plant(case), case.effects[0])
        assert found == pytest.approx(said, abs=1e-12)
        assert abs(found - 1) > 2.999 * tolerances(rig())[tolerance]


# --- traces


def relative_rms(change: np.ndarray, y: np.ndarray) -> float:
    """Each channel of (level, sample, channel) in units of its own r.m.s."""
    return float(np.sqrt(np.mean((change / y.std(axis=(0, 1))) ** 2)))


def test_each_trace_changes_the_response_by_what_it_says(traced):
    """In noise, where it was sized in a multisine; how much a nonlinear trace does differs between records."""
    u = noise(np.random.default_rng(17), 24000, 8, traced.band_Hz, RATE, 1.0)
    levels = sorted(traced.levels_V)[::2]

    def responses(*traces) -> np.ndarray:
        plant = build_plant(replace(traced, traces=traces))
        return np.array([response_to(plant, level * u)[0] for level in levels])

    y = responses()
    said = {one.name: one.details["unexplained"] for one in traced.traces}
    assert set(said) == set(TRACES)
    for one in traced.traces:
        assert 0.6 < relative_rms(responses(one) - y, y) / said[one.name] < 1.6, one.name
    total = np.sqrt(sum(np.square(list(said.values()))))
    assert 0.003 <= total <= 0.01
    assert 0.6 < relative_rms(responses(*traced.traces) - y, y) / total < 1.6


def test_no_refit_takes_a_trace_away(traced):
    """Mass, inertia, stiffness and damping have given what they could already."""
    pilot = cases._pilot_of(traced)
    for one in traced.traces:
        bare = pilot.after_refit(lambda plant, one=one: cases.LIBRARY[one.name].apply(plant, one))[0]
        left = pilot.after_refit(lambda plant, one=one: clutter.add_trace(plant, one, cases.LIBRARY))[0]
        plant = pilot.build()
        clutter.add_trace(plant, one, cases.LIBRARY)
        changed = np.array([response_to(plant, level * pilot.u)[0] for level in pilot.levels]) - pilot.y
        assert bare == pytest.approx(one.details["unexplained"], rel=0.02)
        assert 0.95 * relative_rms(changed, pilot.y) < left < 1.05 * bare


def test_traces_are_left_out_where_their_effect_is_hidden(monkeypatch):
    monkeypatch.setattr(clutter, "PILOT_S", 1.0)
    case = draw_case(5, effect="mains_hum", clutter=True, duration_s=2.0)
    assert {one.name for one in case.traces} == set(TRACES) - {"mains_hum"}
    assert all(one.strength == "trace" for one in case.traces)
    hum = next(one for one in draw_case(6, kind="none", clutter=True, duration_s=2.0).traces if one.name == "mains_hum")
    assert min(abs(hum.parameters["frequency_Hz"] - f) for f in (50.0, 60.0)) <= 0.1
    assert len(hum.details["harmonics"]) >= 3


def test_cluttered_cases_repeat(monkeypatch):
    monkeypatch.setattr(clutter, "PILOT_S", 1.0)
    case = draw_case(3, kind="two", duration_s=2.0, clutter=True)
    assert case == draw_case(3, kind="two", duration_s=2.0, clutter=True)
    json.dumps(asdict(case))
    clean = draw_case(3, kind="two", duration_s=2.0)
    assert (case.names, case.levels_V, case.starts_s) == (clean.names, clean.levels_V, clean.starts_s)
    for a, b in zip(simulate_case(case).records, simulate_case(case).records, strict=True):
        np.testing.assert_array_equal(a.y, b.y)
    one, other = (build_plant(draw_case(seed, kind="none", clutter=True)) for seed in (3, 4))
    assert np.abs(one.sensor_p - other.sensor_p).min() > 0


def test_best_prediction_leaves_noise_and_traces(traced):
    floor = next(seed for seed in range(20) if draw_case(seed, kind="none").floor_recorded)
    clean = draw_case(floor, kind="none", duration_s=20.0)
    step = 20 / 2**14  # both are rounded
    measured = simulate_case(clean, unseen=True).records
    for record, best in zip(measured, best_prediction(clean, unseen=True), strict=True):
        off = record.y - best
        # The first seconds hold the motion that the table had before the record.
        np.testing.assert_allclose(off[-4000:].std(axis=0), np.sqrt(1e-6 + 2 * step**2 / 12), rtol=0.05)
        assert np.all(off[:4000].std(axis=0) > 1.2 * off[-4000:].std(axis=0))
    short = replace(traced, duration_s=8.0, floor_recorded=True)
    loud = int(np.argmax(short.levels_V))
    off = simulate_case(short).records[loud].y - best_prediction(short)[loud]
    y = simulate_case(short).records[loud].y
    assert 0.003 < np.sqrt(np.mean(off.var(axis=0) / y.var(axis=0))) < 0.05


# --- laws


LINEAR_LAWS = (
    "geophone_corner",
    "sensor_gain",
    "sensor_misalignment",
    "tilt_coupling",
    "actuator_gain",
    "actuator_lag",
    "com_offset",
    "product_of_inertia",
    "payload_flexible_mode",
    "attached_oscillator",
    "base_compliance",
    "mount_relaxation",
    "structural_damping",
    "mount_surge",
    "leveling_loop",
    "cable_stiffness",
)
NOT_LINEAR = ("orifice", "drifting")


@pytest.mark.parametrize(
    ("effect", "variant"),
    [(effect, law.__name__) for effect in LINEAR_LAWS for law in VARIANTS[effect] if law.__name__ not in NOT_LINEAR],
)
def test_linear_laws_in_closed_form(no_traces, effect, variant):
    plant, _ = of_variant(effect, variant, strength="clear", damping=5.0)
    assert misfit(plant, plant).max() < 1.5e-4


def test_every_effect_of_the_library_has_its_laws(no_traces):
    assert set(VARIANTS) == set(cases.LIBRARY)
    for effect, laws in VARIANTS.items():
        drawn = {draw_case(seed, effect=effect, clutter=True).effects[0].details["variant"] for seed in range(16)}
        assert drawn <= {law.__name__ for law in laws} and len(drawn) > (len(laws) > 1)


def test_geophone_laws(no_traces):
    """Damping ratio c / (2 sqrt(k m)) of a spring or a mass that gives the new corner."""
    for variant, power in (("softer_spring", -1), ("other_coil_mass", 1)):
        plant, h = of_variant("geophone_corner", variant)
        ratio = h.parameters["corner_Hz"] / rig().geophones.suspension_Hz
        zeta = plant.zn[plant.sensors.index(h.location)]
        assert zeta == pytest.approx(rig().geophones.suspension_damping * ratio**power)


def test_drifting_gains_have_their_mean(no_traces):
    t = np.linspace(0.0, 1.0, 1001)
    for effect, hooks in (("sensor_gain", "analogue"), ("actuator_gain", "drive")):
        plant, h = of_variant(effect, "drifting")
        n = 6 if effect == "sensor_gain" else 8
        factor = getattr(plant, hooks)[0](np.ones((1001, n)), t * h.details["span_s"], None)
        j = (plant.sensors if n == 6 else plant.motors).index(h.location)
        assert (
            factor[:, j].mean() == pytest.approx(1.0)
            and np.ptp(factor[:, j]) == pytest.approx(abs(h.details["drift"]))
            and np.ptp(np.delete(factor, j, axis=1)) == 0
        )


def test_lags_have_the_mean_delay_of_the_effective_corner(no_traces):
    for variant in ("each_its_own_corner", "second_order"):
        plant, h = of_variant("actuator_lag", variant)
        P = plant.physics()
        delay = 1 / P.lag + (1 / P.lag2 if len(P.lag2) else 0.0)
        assert np.mean(delay) == pytest.approx(1 / (2 * np.pi * h.parameters["corner_Hz"]))


def test_soft_limit_is_nearest_to_its_effective_hard_one(no_traces):
    plant, h = of_variant("actuator_saturation", "soft_knee")
    high = max(draw_case(5, kind="none").levels_V)
    u = high * np.random.default_rng(0).standard_normal((200000, 8))
    soft, limit = plant.drive[0](u, None, None), h.parameters["limit_V"]
    off = [np.mean((soft - np.clip(u, -x, x)) ** 2) for x in (0.97 * limit, limit, 1.03 * limit)]
    assert np.argmin(off) == 1 and np.abs(soft).max() < h.details["asymptote_V"]
    small = 0.01 * limit * np.ones((1, 8))
    np.testing.assert_allclose(plant.drive[0](small, None, None), small, rtol=1e-6)


def test_jitter_keeps_the_mean_delay(no_traces):
    """The phase of a fast line over the table with the mean delay alone, and noise that the mean delay has not."""
    plant, h = of_variant("loop_delay", "jitter", strength="clear")
    t = np.arange(20000) / RATE
    u = np.outer(np.sin(2 * np.pi * 40.0 * t), np.ones(8))
    y = response_to(plant, u)[0][4000:]
    plant.jitter_s = 0.0
    steady = response_to(plant, u)[0][4000:]
    line = np.exp(-2j * np.pi * 40.0 * t[4000:])
    late = -np.angle((line @ y) / (line @ steady)) / (2 * np.pi * 40.0)
    assert np.abs(late).max() < 0.1 * h.details["jitter_s"]
    assert 0 < np.std(y - steady) < 0.2 * np.std(steady)


def test_hum_swings_or_wanders_as_it_says(no_traces):
    t = np.arange(400000) / RATE
    for variant in ("side_bands", "wandering"):
        plant, h = of_variant("mains_hum", variant)
        y = plant.analogue[0](np.zeros((len(t), 6)), t, None)[:, 0]
        carrier = y * np.exp(-2j * np.pi * h.parameters["frequency_Hz"] * t)
        slow = np.convolve(carrier, np.hanning(401) / np.hanning(401).sum(), "same")[1000:-1000]  # the fundamental
        size, f = np.abs(slow), np.diff(np.unwrap(np.angle(slow))) * RATE / (2 * np.pi)
        if variant == "side_bands":
            assert np.ptp(size) / (size.max() + size.min()) == pytest.approx(h.details["swing"], rel=0.25)
        else:
            assert np.abs(f).max() == pytest.approx(h.details["wander_rad"] * h.details["wander_Hz"], rel=0.05)


def test_other_codes(no_traces):
    found = set()
    for seed in range(8):
        plant, h = of_variant("sensor_quantisation", "other_codes", seed=seed)
        j = plant.sensors.index(h.location)
        y = cases.convert(plant, np.tile(np.linspace(-12, 12, 40001)[:, None], 6), 0.0, np.random.default_rng(0))[:, j]
        if "step_V" in h.parameters:
            found.add("step")
            assert np.abs(y).min() == pytest.approx(h.parameters["step_V"] / 2)
        else:
            found.add("range")
            assert (y.max() - y.min()) / 2 == pytest.approx(h.parameters["range_V"], abs=2 * plant.step_V[j])
            off = h.details["uneven_rails"] * h.parameters["range_V"]
            assert (y.max() + y.min()) / 2 == pytest.approx(off, abs=2 * plant.step_V[j])
    assert found == {"step", "range"}


def test_jenkins_elements_are_a_spring_at_first_and_slip_one_by_one(no_traces):
    plant, h = of_variant("contact_friction", "jenkins")
    plant.c = plant.c * 12
    P = plant.physics()
    np.testing.assert_allclose(
        [P.fric_s0.sum(axis=0).mean(), P.fric_Fc.sum(axis=0).mean()],
        [h.parameters["stiffness_N_per_m"], h.parameters["coulomb_N"]],
    )
    _, _, K, T = matrices(plant)
    D, small = T.T / plant.motor[:, None], 1e-3 * P.fric_Fc.min() * np.ones(8)
    q = np.linalg.solve(K + D.T @ np.diag(P.fric_s0.sum(axis=0)) @ D, T @ small)
    _, trace = response_to(plant, np.tile(small, (6000, 1)), states=True)
    np.testing.assert_allclose(trace[-1, :3], q[:3], atol=1e-3 * np.abs(q[:3]).max())
    u = multisine(np.random.default_rng(1), 4000, 8, 4000, (0.5, 10.0), RATE, 0.5)
    _, trace = response_to(plant, u, states=True)
    signed = trace[:, FIRST_EFFECT_STATE:].reshape(-1, 3, 8) * P.fric_s0 / P.fric_Fc
    assert np.abs(signed).max() < 1 + np.abs(np.diff(signed, axis=0)).max()  # the motion within one step
    slipping = (np.abs(signed) > 0.99).sum(axis=1)
    assert {0, 1, 2, 3} <= set(np.unique(slipping))


def test_two_modes_and_the_first_is_the_larger(no_traces):
    for variant, low, high in (("two_modes", 1.25, 1.9), ("two_close_modes", 1.03, 1.12)):
        plant, h = of_variant("payload_flexible_mode", variant)
        P = plant.physics()
        assert P.mode_w[0] == pytest.approx(2 * np.pi * h.parameters["frequency_Hz"])
        assert len(P.mode_w) == 2 and low <= P.mode_w[1] / P.mode_w[0] <= high
        assert np.linalg.norm(P.mode_shape[0]) > np.linalg.norm(P.mode_shape[1]) > 0


def test_oscillators_have_their_mean_frequency(no_traces):
    for variant, count in (("along_an_oblique_line", 1), ("along_three_axes", 3), ("along_three_oblique_axes", 3)):
        plant, h = of_variant("attached_oscillator", variant)
        P = plant.physics()
        f = np.sqrt(P.osc_k / P.osc_m) / (2 * np.pi)
        assert np.exp(np.log(f).mean()) == pytest.approx(h.parameters["frequency_Hz"])
        np.testing.assert_allclose(P.osc_d @ P.osc_d.T, np.eye(count), atol=1e-12)
        assert (np.abs(P.osc_d).max(axis=1) < 0.999).all() == ("oblique" in variant)


@pytest.mark.parametrize("variant", [law.__name__ for law in VARIANTS["base_compliance"]])
def test_every_chassis_follows_a_slow_floor(no_traces, variant):
    plant, h = of_variant("base_compliance", variant, damping=5.0)
    t, w = np.arange(20001) / RATE, 2 * np.pi * 0.1
    floor = np.hstack(
        [
            one[:, None] * np.array([1e-3, -2e-3, 1.5e-3])
            for one in (np.sin(w * t), w * np.cos(w * t), -w * w * np.sin(w * t))
        ]
    )
    _, trace = run(plant, np.zeros((20000, 8)), floor, 0, 0.0, np.random.default_rng(0), states=True)
    assert np.abs(trace[15000:, 0:3] - floor[15000:20000, 0:3]).max() < 2 * (0.1 / 1.9) ** 2 * 2e-3
    free = np.ptp(trace[15000:, FIRST_EFFECT_STATE : FIRST_EFFECT_STATE + 6], axis=0) > 0
    np.testing.assert_array_equal(free, np.array(h.details["free"]) > 0)


def test_two_branches_add_up(no_traces):
    plant, h = of_variant("mount_relaxation", "two_branches")
    P, p = plant.physics(), h.parameters
    share = P.max_k / P.k[:, 2] / p["stiffness_ratio"]
    assert share.sum(axis=0).mean() == pytest.approx(1.0) and np.ptp(share.sum(axis=0)) > 0
    corner = P.max_k / P.max_c / (2 * np.pi * p["corner_Hz"])
    assert (corner[1] / corner[0] > 1.9).all()
    assert np.exp((share * np.log(corner)).sum(axis=0) / share.sum(axis=0)).mean() == pytest.approx(1.0)


def test_loss_goes_with_its_power_and_mounts_differ(no_traces):
    def loss(plant: Plant, f: float) -> np.ndarray:
        P, s = plant.physics(), 1j * f
        k = 1 + np.sum(P.ladder_k * s / (s + LADDER_HZ[:, None]), axis=0)
        return k.imag / (1 + np.sum(P.ladder_k * 9 / (9 + LADDER_HZ[:, None] ** 2), axis=0))

    plant, h = of_variant("structural_damping", "falling_or_rising", strength="clear")
    np.testing.assert_allclose(loss(plant, 3.0), h.parameters["loss_factor"], rtol=0.08)
    np.testing.assert_allclose(loss(plant, 9.0) / loss(plant, 1.0), 9.0 ** h.details["exponent"], rtol=0.08)
    plant, h = of_variant("structural_damping", "each_mount_its_own_loss", strength="clear")
    assert loss(plant, 3.0).mean() == pytest.approx(h.parameters["loss_factor"], rel=0.08)
    assert np.ptp(loss(plant, 3.0)) > 0.05 * h.parameters["loss_factor"]


def test_surge_has_its_frequency_wherever_the_mass_sits(no_traces):
    plant, h = of_variant("mount_surge", "off_the_middle")
    P = plant.physics()
    k = np.mean(draw_plant(rig(), np.random.default_rng([5, 0])).k[:, 2])
    w = np.sqrt((k / P.surge_share + k / (1 - P.surge_share)) / P.surge_m)
    np.testing.assert_allclose(w / (2 * np.pi), h.parameters["frequency_Hz"])
    assert np.mean(P.surge_m) == pytest.approx(h.parameters["mass_kg"])


def test_cubic_laws_stiffen_alike_at_the_highest_level(no_traces):
    """The mean stiffness of a Gaussian stretch, by quadrature."""
    z, weight = np.polynomial.hermite_e.hermegauss(20)
    case = draw_case(5, effect="cubic_stiffness", clutter=True)
    stretch = float(
        np.mean(cases.pilot(build_plant(replace(case, effects=())), case.band_Hz, max(case.levels_V)).stretch[:, 2])
    )
    for law in VARIANTS["cubic_stiffness"]:
        plant, h = of_variant("cubic_stiffness", law.__name__)
        P, x = plant.physics(), stretch * z[:, None]
        mean = weight @ (2 * P.k2 * x + 3 * P.k3 * x**2 + 5 * P.k5 * x**4) / weight.sum()
        assert np.mean(mean) == pytest.approx(3 * h.parameters["cubic_N_per_m3"] * stretch**2)
        ratio = np.mean(np.abs(P.k2)) / (h.parameters["cubic_N_per_m3"] * stretch)
        assert 0.1 <= ratio <= 0.4 if law.__name__ == "a_little_asymmetric" else ratio == 0


def test_valves_cables_floor_and_drift_have_their_effective_values(no_traces):
    for law in VARIANTS["leveling_loop"]:
        plant, h = of_variant("leveling_loop", law.__name__)
        P = plant.physics()
        assert np.mean(P.level_w) == pytest.approx(2 * np.pi * h.parameters["rate_Hz"])
        force = P.level_w * P.k[:3, 2]
        assert (np.ptp(force) < 1e-9 * force.max()) == (law.__name__ == "alike_valves")
        assert (P.level_tau > 0) == (law.__name__ == "lagging_valves")
    plant, h = of_variant("cable_stiffness", "two_cables")
    P = plant.physics()
    assert P.cable_k.sum() == pytest.approx(h.parameters["stiffness_N_per_m"])
    assert 0.05 <= np.linalg.norm(P.cable_r[0] - P.cable_r[1]) <= 0.2
    plant, h = of_variant("ground_motion", "each_direction_its_own")
    assert np.sqrt(np.mean(plant.floor_factor**2)) == pytest.approx(h.details["factor"])
    assert np.ptp(plant.floor_factor) > 0
    for law in VARIANTS["stiffness_drift"]:
        plant, h = of_variant("stiffness_drift", law.__name__)
        span = h.details["span_s"]
        swing = h.details.get("swing", 0.0)
        end = plant.stiffness(np.array([0.0, span])) - 1
        assert end[0] == 0 and abs(end[1] / h.parameters["change"] - 1) <= swing + 1e-9
