"""mu synthesis at a fixed order: slopes by differences, bounds by AB13MD, against truncation of the full controller."""

from dataclasses import replace

import numpy as np
import pytest

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.lti import StateSpace, append, balanced_truncation, discretise, lft_lower
from avis_ctrl.robust.controller_entries import ControllerEntries
from avis_ctrl.robust.fixed_order import fixed_order, with_mode
from avis_ctrl.robust.frequency_grid import frequency_grid
from avis_ctrl.robust.mu_descent import SETTINGS, GainLimit, Objective, Task
from avis_ctrl.robust.mu_upper import upper_bound
from avis_ctrl.robust.musyn import musyn
from avis_ctrl.robust.reduction import split_stable
from avis_ctrl.robust.slycot_adapter import mu_upper_slicot
from avis_ctrl.uncertainty.blocks import BlockStructure, ComplexFull, ComplexScalar
from tests.robust.test_musyn import UNCERTAIN_DRIVE, barely_known_table, table

ONE_DRIVE = BlockStructure.of([ComplexScalar(), ComplexFull(2)])
TABLE = BlockStructure.of([ComplexScalar(), ComplexScalar(), ComplexFull(2)])


def peak_by_slicot(loop: StateSpace, structure: BlockStructure = ONE_DRIVE) -> float:
    """Complex mu of a table's loop on a dense grid with its poles; inf where it is unstable."""
    poles = loop.poles()
    if np.max(np.abs(poles) - 1 if loop.dt else poles.real) >= 0:
        return np.inf
    omega = (
        np.concatenate([np.geomspace(1e-2, np.pi / loop.dt, 400), np.abs(np.angle(poles)) / loop.dt])
        if loop.dt
        else np.concatenate([np.geomspace(1e-2, 1e5, 400), np.abs(poles)])
    )
    return max(mu_upper_slicot(M, structure) for M in loop.frequency_response(omega))


@pytest.mark.slow
def test_complex_mu_of_a_controller_of_low_order_is_not_the_norm_with_poor_scalings():
    """Scalings that were fitted to the full controller are poor for one of two states: their norm is far above mu."""
    result = musyn(*table(), 1, 1, max_iterations=3, polish=False, order=2)
    omega = np.concatenate([np.geomspace(1e-2, 1e5, 400), np.abs(result.closed_loop.poles())])
    complex_blocks = result.blocks.complexified()
    on_grid = np.max(upper_bound(result.closed_loop.frequency_response(omega)[:, None], complex_blocks).beta)
    assert on_grid * (1 - 1e-6) <= result.mu_upper_complex <= 1.01 * on_grid


@pytest.fixture(scope="module")
def full():
    """A table with one uncertain drive: six states, mu 1.02; truncated to one state 6.7."""
    P = barely_known_table(0.5)
    return P, UNCERTAIN_DRIVE, musyn(P, UNCERTAIN_DRIVE, 1, 1, max_iterations=4)


@pytest.mark.parametrize(("states", "most"), [(3, None), (4, None), (4, [30.0, 3.0])])
def test_slope_is_that_of_differences(full, states, most):
    """In random directions, for a controller with real and complex poles; with a limit that its gain exceeds, too."""
    P, _, made = full
    stable, unstable = split_stable(made.K)
    K = balanced_truncation(stable, states - unstable.nstates) + unstable
    form = ControllerEntries.of(K)
    omega = frequency_grid(lft_lower(P, K))
    assert np.allclose(form.controller(form.start).frequency_response(omega), K.frequency_response(omega), rtol=1e-6)
    limit = GainLimit(np.array([200.0, 1000.0]), np.array(most)) if most else None
    task = Task(P, ONE_DRIVE, limit=limit, settings=replace(SETTINGS, accuracy=1e-5))
    problem = Objective(task, form, omega, 20.0)
    _, slope = problem.value(form.start)
    rng = np.random.default_rng(0)
    for _ in range(5):
        d = rng.standard_normal(form.start.size)
        d /= np.linalg.norm(d)
        numeric = (problem.value(form.start + 1e-4 * d)[0] - problem.value(form.start - 1e-4 * d)[0]) / 2e-4
        assert slope @ d == pytest.approx(numeric, rel=0.02, abs=1e-3 * np.linalg.norm(slope))


@pytest.fixture(scope="module")
def one_state(full):
    """The last step towards the best controller of one state."""
    P, _, made = full
    *_, step = fixed_order(Task(P, ONE_DRIVE), made.K, 1)
    return step


@pytest.mark.parametrize("order", [1, pytest.param(2, marks=pytest.mark.slow), pytest.param(3, marks=pytest.mark.slow)])
def test_less_states_than_the_full_controller_and_less_mu_than_its_truncation(full, one_state, order):
    P, _, made = full
    step = one_state if order == 1 else [*fixed_order(Task(P, ONE_DRIVE), made.K, order)][-1]
    K, on_grid = step.K, step.peak
    assert K.nstates <= order
    reached = peak_by_slicot(lft_lower(P, K))
    assert reached == pytest.approx(on_grid, rel=0.01)
    stable, unstable = split_stable(made.K)
    truncated = balanced_truncation(stable, order - unstable.nstates) + unstable
    assert reached <= peak_by_slicot(lft_lower(P, truncated)) * (1 + 1e-6)
    assert reached <= 1.03 * made.mu_upper_complex


@pytest.mark.slow
def test_a_gain_above_its_limit_is_lowered(full):
    """Without a limit the controller of two states has a direct term; gains on a dense grid beyond the limit's two."""
    P, _, made = full
    *_, free = fixed_order(Task(P, ONE_DRIVE), made.K, 2)
    dense = np.geomspace(1e3, 1e5, 300)
    gain = np.max(np.linalg.norm(free.K.frequency_response(dense), 2, (1, 2)))
    limit = GainLimit(np.array([1e3, 1e5]), np.full(2, 0.5 * gain))
    *_, bound = fixed_order(Task(P, ONE_DRIVE, limit=limit), made.K, 2)
    assert np.max(np.linalg.norm(bound.K.frequency_response(dense), 2, (1, 2))) <= 0.5 * gain * bound.peak * (1 + 1e-3)
    assert peak_by_slicot(lft_lower(P, bound.K)) <= bound.peak * 1.01


def test_no_frequency_is_bounded_twice_in_a_step(full, monkeypatch):
    P, _, made = full
    form, seen = ControllerEntries.of(made.K), []

    def counted(M, *arguments):
        seen.append(M)
        return upper_bound(M, *arguments)

    monkeypatch.setattr("avis_ctrl.robust.mu_descent.upper_bound", counted)
    value, _ = Objective(Task(P, ONE_DRIVE), form, frequency_grid(lft_lower(P, made.K)), 20.0).value(form.start)
    every = np.concatenate(seen)
    assert len(every) > SETTINGS.first and len(np.unique(every.reshape(len(every), -1), axis=0)) == len(every)
    assert np.exp(value) >= made.mu_upper_complex * 0.98


@pytest.mark.slow
def test_starts_of_fewer_states_are_tried(full):
    """Descent that is cut short does not reach the best of three states; it does if it may start from that."""
    P, _, made = full
    *_, best = fixed_order(Task(P, ONE_DRIVE), made.K, 3)
    hasty = Task(P, ONE_DRIVE, settings=replace(SETTINGS, iterations=2))
    *_, alone = fixed_order(hasty, made.K, 3)
    *_, found = fixed_order(hasty, made.K, 3, [best.K])
    assert found.peak <= best.peak * (1 + 1e-6) < alone.peak


@pytest.mark.parametrize("most", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_an_added_mode_lowers_the_smoothed_peak(full, one_state, most):
    """By AB13MD, from the best controller of one state."""
    P, _, _ = full
    task, one = Task(P, ONE_DRIVE), one_state
    longer = with_mode(task, one.K, most)
    assert one.K.nstates < longer.nstates <= one.K.nstates + most
    omega = frequency_grid(lft_lower(P, one.K))

    def smoothed(K):
        return sum(
            mu_upper_slicot(M, ONE_DRIVE) ** SETTINGS.sharpness[0] for M in lft_lower(P, K).frequency_response(omega)
        )

    assert smoothed(longer) < smoothed(one.K)


@pytest.mark.slow
def test_a_start_of_fewer_states_gets_all_states_that_are_asked_for(full, one_state):
    P, _, made = full
    *_, three = fixed_order(Task(P, ONE_DRIVE), one_state.K, 3)
    assert one_state.K.nstates < three.K.nstates <= 3
    assert peak_by_slicot(lft_lower(P, three.K)) <= min(1.03 * made.mu_upper_complex, one_state.peak)


@pytest.mark.slow
def test_a_slightly_different_start_ends_at_the_same_peak(full):
    """Rounding must not decide between local minima: entries of the start are changed by a thousandth."""
    P, _, made = full
    rng, form, peaks = np.random.default_rng(0), ControllerEntries.of(made.K), []
    for _ in range(4):
        K = form.controller(form.start * (1 + 1e-3 * rng.standard_normal(form.start.size)))
        *_, step = fixed_order(Task(P, ONE_DRIVE), K, 2)
        peaks.append(peak_by_slicot(lft_lower(P, step.K)))
    assert max(peaks) <= 1.01 * min(peaks)


@pytest.mark.slow
def test_the_result_is_that_of_the_short_controller(full):
    P, blocks, made = full
    short = musyn(P, blocks, 1, 1, order=2, max_iterations=4, state=made.saved_state)
    assert short.K.nstates <= 2 < made.K.nstates and short.guaranteed
    assert short.K.inputs == made.K.inputs and short.K.outputs == made.K.outputs
    loop = lft_lower(P, short.K)
    assert 0.98 * short.mu_upper_complex <= peak_by_slicot(loop) <= short.mu_upper_complex * (1 + 1e-6)
    assert short.mu_lower <= short.mu_upper <= short.mu_upper_complex
    M = loop.frequency_response(np.array([short.omega_peak]))[0]
    assert np.min(np.abs(np.linalg.eigvals(M @ short.delta) - 1)) < 1e-5
    assert any("order 2 instead of" in note for note in short.notes)
    same = musyn(P, blocks, 1, 1, max_iterations=4, order=made.K.nstates, state=made.saved_state)
    assert np.array_equal(same.K.A, made.K.A)


@pytest.mark.slow
def test_a_sampled_plant_gets_a_short_sampled_controller():
    P, blocks = table()
    sampled = discretise(P, 1e-3, "zoh")
    short = musyn(sampled, blocks, 1, 1, order=3)
    assert short.K.dt == 1e-3 and short.K.nstates <= 3 and short.guaranteed
    reached = peak_by_slicot(lft_lower(sampled, short.K), TABLE)
    assert 0.97 * short.mu_upper_complex <= reached <= short.mu_upper_complex * (1 + 1e-6)


def test_an_order_that_cannot_stabilise_is_refused():
    """1/(s^2 - 1) measured by position alone: no gain stabilises it, and one state less than one is none."""
    P = StateSpace(
        [[0.0, 1.0], [1.0, 0.0]],
        [[0, 0, 0], [0.1, 1.0, 1.0]],
        [[0.1, 0.0], [1.0, 0.0], [1.0, 0.0]],
        [[0, 0, 0.01], [0, 0, 0.1], [0, 0.1, 0]],
    )
    with pytest.raises(ComputationError, match="every mode is needed for stability"):
        musyn(P, [ComplexScalar()], 1, 1, order=0, max_iterations=2)


@pytest.mark.parametrize("order", [-1, 1.5, True, "3"])
def test_wrong_order(order):
    P, blocks = table()
    with pytest.raises(InputError, match="order"):
        musyn(P, blocks, 1, 1, order=order)


@pytest.mark.slow
def test_decentralised_loops_see_their_own_signal_alone():
    """Two tables whose sensors hear each other by a tenth; off the diagonal K is exactly zero."""
    one, two = barely_known_table(0.5), barely_known_table(0.4)
    both = append(
        one.renamed(["d1", "w1", "n1", "u1"], ["e1", "z1", "f1", "y1"]),
        two.renamed(["d2", "w2", "n2", "u2"], ["e2", "z2", "f2", "y2"]),
    )
    mixed = both.select(
        ["e1", "e2", "z1", "f1", "z2", "f2", "y1", "y2"], ["d1", "d2", "w1", "n1", "w2", "n2", "u1", "u2"]
    )
    left = np.eye(8)
    left[6, 7] = left[7, 6] = 0.1
    P = mixed.scaled(left=left)
    blocks = [ComplexFull(1, 1), ComplexFull(1, 1)]
    made = musyn(P, blocks, 2, 2, max_iterations=3, order=4, structure="decentralised")
    K = made.K
    assert K.nstates <= 4 and made.guaranteed and any("decentralised" in note for note in made.notes)
    response = K.frequency_response(np.geomspace(0.1, 1e4, 50))
    assert np.max(np.abs(response[:, 0, 1])) == np.max(np.abs(response[:, 1, 0])) == 0.0
    assert np.min(np.abs(response[:, [0, 1], [0, 1]])) > 0
    loop = lft_lower(P, K)
    square = BlockStructure.of([ComplexScalar(), ComplexScalar(), ComplexFull(4)])
    assert 0.97 * made.mu_upper <= peak_by_slicot(loop, square) <= made.mu_upper * (1 + 1e-6)
    with pytest.raises(InputError, match="as many outputs"):
        musyn(P.select(slice(0, 7), slice(0, 8)), blocks, 1, 2, structure="decentralised")
    with pytest.raises(InputError, match="'full' or 'decentralised'"):
        musyn(P, blocks, 2, 2, structure="diagonal")


@pytest.mark.parametrize("order", [2, 3])
def test_entries_of_a_controller_with_repeated_poles(order):
    """A chain of equal lags has one eigenvector; the entries represent a controller with nearly the same response."""
    A = 100.0 * np.kron(np.eye(order, k=-1) - np.eye(order), np.eye(2))
    K = StateSpace(A, np.eye(2 * order, 2), np.eye(2, 2 * order, 2 * order - 2), np.zeros((2, 2)))
    form = ControllerEntries.of(K)
    omega = np.geomspace(1.0, 1e4, 30)
    expected = K.frequency_response(omega)
    error = np.linalg.norm(form.controller(form.start).frequency_response(omega) - expected, axis=(1, 2))
    assert np.max(error / np.linalg.norm(expected, axis=(1, 2))) < 1e-3


def test_the_grid_does_not_depend_on_the_unit_of_time():
    system = StateSpace(-np.diag([1.0, 30.0]), np.ones((2, 1)), np.ones((1, 2)), [[0.0]])
    slow = replace(system, A=1e-12 * system.A, B=1e-12 * system.B)
    assert np.allclose(frequency_grid(slow), 1e-12 * frequency_grid(system), rtol=1e-9)
