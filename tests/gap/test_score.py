"""The score test: what it is on noise alone, what it cannot see, and that a refit gains what it says."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy import stats

from avis_ctrl.gap.effects.base import Effect, EffectParameter
from avis_ctrl.gap.effects.impedance import recoils
from avis_ctrl.gap.effects.library import library
from avis_ctrl.gap.effects.sensors import receptance
from avis_ctrl.gap.score import Part, Score, reduction
from avis_ctrl.gap.starting_values import seeds
from avis_ctrl.gap.table_model import TableModel, active
from avis_ctrl.identification.maximum_likelihood import fit
from avis_ctrl.identification.parameter_sets import default_parameters
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.identification.spectral_block import SpectralBlock
from avis_ctrl.rigs import load_rig

RIG = load_rig("avis")
MODEL = TableModel(ResponseModel.of(RIG, default_parameters(RIG)))
OMEGA = 2 * np.pi * np.geomspace(0.5, 60.0, 60)
SIGMA = 2e-2
# Probability of a false alarm of one score.
CHANCE = 1e-4


def gaussian(rng, *shape):
    """Circular, E|z|^2 = 1."""
    return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)


def covariance():
    """Correlated noise, one for all lines."""
    A = np.eye(6) + 0.3 * np.random.default_rng(9).standard_normal((6, 6))
    return SIGMA**2 * A @ A.T


C = covariance()
ROOT = np.linalg.cholesky(C)


def block(truth, rng, transient=False, noise=1.0, name="00"):
    """What a model reads of a random drive, with noise of covariance C, and the ends of a record."""
    U = np.zeros((len(OMEGA), 11, 1), complex)
    U[:, :8] = 0.3 * gaussian(np.random.default_rng([7, int(name)]), len(OMEGA), 8, 1)
    made = SpectralBlock(name, OMEGA, U, np.zeros((len(OMEGA), 6, 1), complex), transient=transient)
    body = None
    if transient:
        body = np.broadcast_to(rng.standard_normal((12, 1)), (len(OMEGA), 12, 1)) * 0.5
    Y = truth.answer(made, body, False).Y + noise * ROOT @ gaussian(rng, len(OMEGA), 6, 1)
    return replace(made, Y=Y).with_noise(np.broadcast_to(C, (len(OMEGA), 6, 6)).copy())


def effect(name, place, values=None, model=MODEL):
    return active(library()[name], model, place, values)


ABSENT = [
    ("com_offset", "payload", None),
    ("sensor_gain", "Sz2", None),
    ("loop_delay", "loop", None),
    ("mount_relaxation", "isolators z", (0.0, 3.0)),
]


@pytest.mark.parametrize("transient", [False, True], ids=["periodic", "with ends"])
def test_of_noise_alone_a_reduction_is_chi_square(transient):
    """As many degrees of freedom as directions: at the truth, which no fit has to find first."""
    rng, draws = np.random.default_rng(1), 120
    found = {name: [] for name, _, _ in ABSENT}
    ranks = {}
    for _ in range(draws):
        score = Score(MODEL, [block(MODEL, rng, transient)])
        for name, place, values in ABSENT:
            took = score.reduction(score.of_effect(effect(name, place, values)))
            found[name].append(took.chi2)
            ranks[name] = took.rank
    assert ranks == {"com_offset": 3, "sensor_gain": 1, "mount_relaxation": 1, "loop_delay": 1}
    for name, values in found.items():
        rank = ranks[name]
        assert abs(np.mean(values) - rank) < 4 * np.sqrt(2 * rank / draws), name
        assert stats.kstest(values, stats.chi2(rank).cdf).pvalue > 1e-3, name


def test_the_residual_itself_is_chi_square():
    rng = np.random.default_rng(2)
    scores = [Score(MODEL, [block(MODEL, rng, True, name=name) for name in ("00", "01")]) for _ in range(30)]
    dof = scores[0].dof
    assert dof <= 2 * 2 * 60 * 6 - 24 - 20  # the ends of two records, and combinations of parameters
    assert abs(np.mean([one.chi2 for one in scores]) - dof) < 4 * np.sqrt(2 * dof / 30)


def test_what_re_identification_absorbs_is_never_significant():
    """A sensitivity that is free itself, while another effect leaves a residual a hundred times the noise."""
    free = TableModel(ResponseModel.of(RIG, (*default_parameters(RIG), "sensor.Sz2", "actuator.Az1")))
    truth = free.with_effect(effect("actuator_lag", "actuators", [20e-3], free))
    score = Score(free, [block(truth, np.random.default_rng(3))])
    assert score.chi2 / score.dof > 100
    for name, place in (("sensor_gain", "Sz2"), ("actuator_gain", "Az1")):
        took = score.reduction(score.of_effect(effect(name, place, None, free)))
        assert took.chi2 < 1e-6 * score.chi2
        assert took.rank == 0
    assert all(seed.p_value > CHANCE for seed in seeds(library()["sensor_gain"], score, ["Sz2"])[0])


def test_parameter_errors_alone_are_found_by_no_effect():
    """Parameters off by a per cent or two: after the fit no score is significant."""
    rng = np.random.default_rng(4)
    truth = MODEL.at(MODEL.values * (1 + 0.02 * rng.standard_normal(len(MODEL.values))))
    blocks = [block(truth, rng, True, name=name) for name in ("00", "01")]
    fitted = fit(MODEL, blocks).model
    score = Score(fitted, blocks)
    found = [
        seed.p_value
        for one in library().values()
        if not one.nonlinear
        for at_place in seeds(one, score, one.places(fitted))
        for seed in at_place
    ]
    assert len(found) > 10
    assert min(found) > CHANCE


SMALL = [
    ("actuator_gain", "Az3", [1.02], ()),
    ("com_offset", "payload", [4e-4, -2e-4, 4e-4], ()),
    ("sensor_misalignment", "Sy1", [0.1, -0.05], ()),
    ("actuator_lag", "actuators", [3e-4], ()),
    ("mount_relaxation", "isolators z", [3e-3, 4.0], ("corner_Hz",)),
    ("attached_oscillator", "payload/z", [0.1, 12.0, 0.05, 0.3, 0.2], ("frequency_Hz", "damping", "x_m", "y_m")),
    ("tilt_coupling", "horizontal geophones", [0.3], ()),
    ("structural_damping", "isolators/causal", [5e-4], ()),
]


WITH_STATES = [
    ("leveling_loop", "isolators 1-3 z/plain", (0.05,)),
    ("leveling_loop", "isolators 1-3 z/lag", (0.05, 0.5)),
    ("mount_relaxation", "isolators z", (0.2, 2.0)),
    ("mount_surge", "isolators z", (22.0, 0.4, 0.05, 0.0, 0.1, -0.1)),
    ("attached_oscillator", "payload/xyz", (3.0, 9.0, 0.05, 0.2, -0.1, 0.1)),
    ("base_compliance", "chassis/z", None),
    ("payload_flexible_mode", "payload", (24.0, 0.02, *np.linspace(-0.05, 0.06, 12))),
]


@pytest.mark.parametrize(
    ("name", "place"),
    [
        ("structural_damping", "isolators/causal"),
        ("mount_relaxation", "isolators z"),
        ("leveling_loop", "isolators 1-3 z/plain"),
        ("attached_oscillator", "payload/z"),
        ("sensor_gain", "Sz2"),
    ],
)
@pytest.mark.parametrize(("known", "at", "values"), WITH_STATES, ids=[f"{one[0]} {one[1]}" for one in WITH_STATES])
def test_a_direction_is_the_derivative_of_the_response_to_all_initial_states(known, at, values, name, place):
    """Beside an effect with internal states, the responses to their initial values and to those of the table may be
    large and nearly cancel each other. By differences of the whole response."""
    if name == known:
        pytest.skip("the model has this effect")
    rng = np.random.default_rng(8)
    model = MODEL.with_effect(effect(known, at, values))
    made = block(model, rng, True)
    states = model.inner_transients(OMEGA).shape[2]
    assert states
    body = np.broadcast_to(rng.standard_normal((12, 1)), (len(OMEGA), 12, 1))
    made = replace(made, Y=model.answer(made, body, False, rng.standard_normal(states)).Y)
    part = Score(model, [made]).parts[0]
    one = effect(name, place, None, model)
    linear = next(k for k, parameter in enumerate(one.parameters) if parameter.linear)
    zero, step = list(one.values), 1e-5 * one.parameters[linear].size
    zero[linear] = one.parameters[linear].none
    small = one.at([*zero[:linear], zero[linear] + step, *zero[linear + 1 :]])

    def response(strength):
        """With zero initial values of the added effect's own states, which are the last of their kind."""
        added = model.with_effect(strength)
        own = added.inner_transients(OMEGA).shape[2] - states
        if not own:
            inner = part.inner
        elif name == "attached_oscillator":  # impulses and steps, before the first-order states
            decays = sum(x.shape[2] for x in model.assembled(OMEGA).ops.decays)
            impulses, steps, rest = np.split(part.inner, [(states - decays) // 2, states - decays])
            inner = np.concatenate([impulses, [0.0], steps, [0.0], rest])
        else:  # first-order states
            inner = np.concatenate([part.inner, np.zeros(own)])
        return added.answer(made, part.body, False, inner).Y

    expected = (response(small) - response(one.at(zero))) / step
    np.testing.assert_allclose(part.change(small) / step, expected, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize("heavy", [False, True], ids=["bare payload", "beside 30 kg on springs"])
def test_the_direction_of_a_chassis_is_its_whole_recoil(heavy):
    """A chassis of 1e9 kg: its recoil is small, so that the response is proportional to it. The force on it includes
    that of elements attached to the payload."""
    model = MODEL
    if heavy:
        model = model.with_effect(effect("attached_oscillator", "payload/z", [30.0, 12.0, 0.05, 0.3, 0.2]))
    score, mass, each = Score(model, [block(model, np.random.default_rng(2))]), 1e9, (12.0, 17.0, 25.0)
    chassis = effect("base_compliance", "chassis/translation", [mass, 0.06, *each], model)
    whole = score.directions([part.whole_change(chassis)[None] for part in score.parts])[0]
    found = sum(recoils(score, partial(receptance, frequency_Hz=f, damping=0.06))[k] / mass for k, f in enumerate(each))
    np.testing.assert_allclose(found, whole, atol=1e-4 * np.abs(whole).max())


class MassInHorizontalMounts(Effect):
    """An effect of a user that precedes the masses in the vertical mounts."""

    name, title, looks_like, at = (
        "horizontal_surge",
        "a mass inside the mounts along x",
        "a resonance",
        ("isolators x",),
    )

    def parameters(self, model, place):
        return (EffectParameter.shape("frequency_Hz", "Hz", "of the mass", 1.0, 1e9, 10.0, (40.0,)),)

    def change(self, ops, place, values):
        ops.internal_omega = np.where(ops.mounts.along("x"), 2 * np.pi * values["frequency_Hz"], ops.internal_omega)


def test_initial_states_of_other_mounts_keep_their_mounts():
    """A very small mass in other mounts changes nothing, with any initial motion of those in the vertical mounts."""
    rng, (known, at, values) = np.random.default_rng(8), WITH_STATES[3]
    model = MODEL.with_effect(effect(known, at, values))
    made, states = block(model, rng), model.inner_transients(OMEGA).shape[2]
    part = Part(model, made, None, rng.standard_normal(states))
    assert np.abs(part.response.Y - model.answer(made, None, False).Y).max() > 0.1 * np.abs(part.response.Y).max()
    change = part.whole_change(active(MassInHorizontalMounts(), model, "isolators x", [1e7]))
    assert np.abs(change).max() < 1e-6 * np.abs(part.response.Y).max()


def inner_states(score: Score, one) -> list[np.ndarray]:
    """(m, N) a block: what unit initial states of an effect leave in it, which a refit takes out with the transient."""
    with_it, found = score.model.with_effect(one), []
    columns = [np.moveaxis(with_it.inner_transients(part.block.omega), -1, 0)[..., None] for part in score.parts]
    for k in range(len(columns)):
        own = [c if j == k else np.zeros_like(c) for j, c in enumerate(columns)]
        if own[k].size:
            found.append(score.directions(own))
    return found


@pytest.mark.parametrize(("name", "place", "values", "held"), SMALL, ids=[one[0] for one in SMALL])
def test_a_refit_gains_what_the_score_predicts(name, place, values, held):
    rng = np.random.default_rng(5)
    true = effect(name, place, values)
    blocks = [block(MODEL.with_effect(true), rng, True, name=one) for one in ("00", "01")]
    before = fit(MODEL, blocks, max_iterations=40)
    score = Score(before.model, blocks)
    assert score.chi2 == pytest.approx(before.chi2, rel=1e-6)
    none = true.at([v if one.name in held else one.none for one, v in zip(true.parameters, values, strict=True)])
    A = score.of_effect(none)
    assert score.reduction(A).chi2 > 30  # well beyond chance
    took = score.reduction(np.vstack([A, *inner_states(score, none)]))
    model = before.model.with_effect(none)
    after = fit(model, blocks, {f"{true.label}.{one}": (none.by_name[one], 1e-6) for one in held}, max_iterations=40)
    assert took.chi2 == pytest.approx(before.chi2 - after.chi2, rel=0.02)
    linear = [k for k, one in enumerate(true.parameters) if one.linear]
    found = np.array(after.model.effects[0].values)[linear]
    wanted = np.array([true.parameters[k].none for k in linear]) + took.coefficients[: len(linear)]
    sizes = np.abs(np.array(values)[linear] - [true.parameters[k].none for k in linear])
    np.testing.assert_allclose(found, wanted, atol=0.05 * np.max(sizes))


@pytest.mark.parametrize("variant", ["axes", "oblique"])
def test_a_refit_moves_a_cable_with_stiffnesses_that_are_zero(variant):
    """A cable along one direction: along some axis it has none."""
    along = np.array([0.0, 0.4525, -0.89]) if variant == "oblique" else np.array([0.0, 0.0, 1.0])
    K, place, near = 2e4 * np.outer(along, along), [-0.1, -0.18, 0.2], [0.0, -0.3, 0.3]
    own = [K[0, 0], K[1, 1], K[2, 2]] if variant == "axes" else list(np.sqrt(2e4) * along)
    where = f"payload/{variant}"
    truth = MODEL.with_effect(effect("cable_stiffness", where, [*own, 2e-3, *place]))
    blocks = [block(truth, np.random.default_rng(8), name=one) for one in ("00", "01")]
    start = MODEL.with_effect(effect("cable_stiffness", where, [*(0.9 * k for k in own), 0.0, *near]))
    found = fit(start, blocks, max_iterations=60)
    assert found.iterations > 3
    assert found.chi2_per_dof < 1.1
    values = np.array(found.model.effects[0].values)
    if variant == "oblique":
        assert values[1] * values[2] < -5e3
    # A place along the cable's own line makes no difference.
    np.testing.assert_allclose(np.cross(values[-3:] - place, along), 0, atol=0.05)  # 0.13 at the start


def test_reduction_is_least_squares():
    rng = np.random.default_rng(6)
    A, e = rng.standard_normal((3, 50)) * [[1.0], [1e-6], [1e4]], rng.standard_normal(50)
    took = reduction(A @ A.T, A @ e)
    x, rest, *_ = np.linalg.lstsq(A.T, e, rcond=None)
    assert took.rank == 3
    assert took.chi2 == pytest.approx(e @ e - rest[0])
    np.testing.assert_allclose(took.coefficients, x, rtol=1e-5)
    twice = np.vstack([A, A[:1] + 1e4 * A[1:2]])  # one that the others make up changes nothing
    again = reduction(twice @ twice.T, twice @ e)
    assert (again.rank, again.chi2) == (3, pytest.approx(took.chi2, rel=1e-6))
