"""What is compared and delivered: the tuned skyhook against classical ones, the mu controller against its rivals."""

from __future__ import annotations

from dataclasses import fields, replace
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from avis_ctrl.classical.skyhook import Skyhook
from avis_ctrl.classical.tuning import Merit, TuningRange
from avis_ctrl.lti import gain, lft_lower, lft_upper
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.rigs.rig_file import load_rig
from avis_ctrl.robust.mu_peak import worst_case_gain
from avis_ctrl.study.controllers import best_of, mu_optimal
from avis_ctrl.study.design_file import Design, read_study
from avis_ctrl.study.design_result import Bound, Candidate, ControllerResult
from avis_ctrl.study.new_files import NewDesign, NewRig, new_design, rig_text
from avis_ctrl.study.plant import DesignPlant, build_plant
from avis_ctrl.study.skyhooks import (
    SETTINGS,
    SkyhookSettings,
    WorstCaseTuning,
    at_limits,
    classical_skyhook,
    critical_gains,
    tuned_skyhook,
)

DESIGN = Path(__file__).resolve().parents[2] / "designs" / "avis_z_phix.toml"


@pytest.fixture(scope="module")
def one_axis() -> tuple[Design, DesignPlant]:
    """z alone; mass and the stiffness of one isolator uncertain, no chains."""
    design, _ = read_study(DESIGN)
    uncertainty = design.uncertainty.model_copy(
        update={"parameters_percent": {"mass": 10.0, "isolator1.k_z": 15.0}, "actuator_chains": None}
    )
    synthesis = design.synthesis.model_copy(update={"max_iterations": 1, "time_limit_s": 1e-3})
    design = design.model_copy(update={"keep": ["z"], "uncertainty": uncertainty, "synthesis": synthesis})
    return design, build_plant(design, load_rig("avis"))


def bounds(design: Design, plant: DesignPlant, K) -> tuple[float, float]:
    """Worst-case transmissibility over all frequencies and in the band, over the whole set."""
    closed = plant.full.restricted(plant.floor_velocities, plant.velocities).closed(K)
    band = tuple(2 * np.pi * f for f in design.transmissibility.band_Hz)
    return (
        worst_case_gain(closed, plant.full.blocks, slack=5e-3, points=8).upper,
        worst_case_gain(closed, plant.full.blocks, band=band, slack=5e-3, points=8).upper,
    )


def test_the_worst_case_of_a_bound_is_a_plant_whose_stability_counts(one_axis):
    """A perturbation that destabilises a tuning makes its instability count, not only its largest gain."""
    design, plant = one_axis
    evaluation = WorstCaseTuning(plant, design, 2.0, SkyhookSettings(samples=2))
    task = evaluation.search(load_rig("avis"))
    delta = np.zeros((plant.full.blocks.n_w, plant.full.blocks.n_z))
    more = evaluation.with_worst_case(task, SimpleNamespace(omega=2 * np.pi * 3.3, delta=delta))
    assert more.scenarios.plants == task.scenarios.plants + 1 == len(more.scenarios.deltas)
    assert 2 * np.pi * 3.3 in more.scenarios.omega


@pytest.fixture(scope="module")
def light_table(tmp_path_factory) -> tuple[Design, DesignPlant, Rig]:
    """z and phi_y of a table on mounts of 3 % damping: peaks narrower than the grid of the search."""
    file = tmp_path_factory.mktemp("light") / "rig.toml"
    file.write_text(rig_text(NewRig("light", 180.0, (0.9, 0.7, 0.25), 3, 4.0, 3.2, sample_rate_Hz=2000.0)))
    rig = load_rig(str(file))
    design = new_design(
        NewDesign("light", keep=("z", "phi_y"), band_Hz=(3.0, 15.0), band_dB=-8.0, peak_dB=4.0), rig, "rig.toml"
    )
    return design, build_plant(design, rig), rig


def test_lightly_damped_modes_are_not_taken_for_instability(light_table):
    """They turn the phase of det(I - P K) by 180 degrees between two frequencies of the grid."""
    design, plant, rig = light_table
    search = WorstCaseTuning(plant, design, 2.0, SkyhookSettings()).search(rig)
    motion = search.scenarios.plant
    for factor in (0.3, 1.0, 2.5):
        point = search.search.point(factor, SETTINGS.corners_Hz)
        K = search.search.skyhook(search.axes, point).controller()
        for delta in search.scenarios.deltas[:, 0].real:
            assert lft_lower(lft_upper(motion.P, delta), K).is_stable()
        assert search.merit(point, 2.0).unstable == 0


@pytest.mark.slow
def test_no_multiple_of_the_tuned_gains_is_better(light_table):
    """By the bounds over the whole set: least transmissibility in the band of all that keep the limit on the peak."""
    design, plant, rig = light_table
    limit = 10 ** (4 / 20)
    tuned = tuned_skyhook(plant, rig, design, limit, SkyhookSettings(samples=4))
    assert "from 3 to 15 Hz with a worst-case peak of at most +4.00 dB" in " ".join(tuned.notes)
    merits = {
        factor: Merit(*bounds(design, plant, tuned.K.scaled(left=factor)), limit)
        for factor in (1.0, 0.5, 1.25, 1.6, 2.5, 4.0)
    }
    assert merits[1.0].meets
    assert min(merits, key=lambda factor: merits[factor].key()) == 1.0


@pytest.mark.slow
@pytest.mark.parametrize(("limit_dB", "keep_it"), [(3.2, 1), (5.5, 4)])
def test_tuned_skyhook_loses_to_no_classical_one(one_axis, limit_dB, keep_it):
    """Multiples of critical damping, customary and other corners: none that keeps the limit is lower in the band."""
    design, plant = one_axis
    limit = 10 ** (limit_dB / 20)
    tuned = tuned_skyhook(plant, load_rig("avis"), design, limit)
    peak, band = bounds(design, plant, tuned.K)
    assert peak <= limit
    assert not any("no skyhook tuning found" in note for note in tuned.notes)
    (critical,) = critical_gains(load_rig("avis"), ["z"])
    met = 0
    for factor, (tilt, roll) in product((0.5, 1.0, 2.0), ((0.1, 100.0), (0.03, 30.0))):
        other = bounds(design, plant, Skyhook(plant.axes, (factor * critical,), tilt, roll).controller())
        met += other[0] <= limit
        assert other[0] > limit or band <= 1.005 * other[1]
    assert met == keep_it


@pytest.mark.slow
def test_a_limit_out_of_reach_is_said_and_the_least_peak_is_taken(one_axis):
    """The payload follows the floor at low frequency: no loop keeps a peak of -1 dB."""
    design, plant = one_axis
    tuned = tuned_skyhook(plant, load_rig("avis"), design, 10 ** (-1.0 / 20))
    assert any("no skyhook tuning found has a worst-case peak below -1.00 dB" in note for note in tuned.notes)
    peak, _ = bounds(design, plant, tuned.K)
    assert 1.0 <= peak <= bounds(design, plant, classical_skyhook(plant, load_rig("avis"), design).K)[0]


@pytest.mark.parametrize(
    ("gain", "roll", "said"),
    [
        (1.0, 100.0, []),
        (0.05, 100.0, ["the gain of z is at"]),
        (20.0, 400.0, ["the gain of z and the roll-off are at"]),
    ],
)
def test_values_at_an_end_of_the_range_searched_are_told(gain, roll, said):
    found = at_limits(Skyhook(("z",), (gain * 300.0,), 0.1, roll), TuningRange((300.0,)))
    assert [text[: len(start)] for text, start in zip(found, said, strict=True)] == said


def test_mu_controller_is_never_worse_than_a_rival(one_axis):
    """A rival that the iteration starts from is kept; the old time limit decides nothing, and a note says so."""
    design, plant = one_axis
    rig = load_rig("avis")
    _, alone = mu_optimal(design, plant, rig)
    assert len(alone.history) == 2  # H-infinity, nominal: not one of them was cut off after a millisecond
    longer = design.model_copy(update={"synthesis": design.synthesis.model_copy(update={"max_iterations": 3})})
    better, _ = mu_optimal(longer, plant, rig)
    kept, made = mu_optimal(design, plant, rig, rivals=[better, Candidate("passive", "passive", "passive", None)])
    assert any("time_limit_s is ignored" in note for note in kept.notes)
    assert made.history[-1].kind == "given"
    assert made.history[-1].mu_upper < min(row.mu_upper for row in alone.history)
    assert made.best.mu <= alone.best.mu


def result(name: str, title: str, mu: float, K, stable: bool = True, notes: tuple[str, ...] = ()) -> ControllerResult:
    """A result with the parts that `best_of` does not look at left empty."""
    given = {
        "name": name,
        "title": title,
        "kind": name,
        "K": K,
        "stable": stable,
        "notes": notes,
        "mu": Bound(mu, 0.9 * mu, 1.0, None, True, "", np.zeros(0), np.zeros(0), np.zeros(0)),
    }
    return ControllerResult(**{field.name: given.get(field.name) for field in fields(ControllerResult)})


def test_best_of_delivers_the_controller_of_least_mu():
    """A nominal controller with 0.956 beside a mu controller of 1.29 is what is delivered, and the notes say so."""
    K = gain([[-1.0]])
    weak = result("mu", "mu synthesis", 1.29, K, notes=("12 iterations done",))
    rival = result("hinf", "H-infinity, nominal", 0.956, K.scaled(2.0))
    assert best_of(replace(weak, mu=rival.mu), [rival]).K is weak.K
    others = [result("passive", "passive", 0.1, None), result("skyhook", "skyhook", 0.2, K, stable=False), rival]
    delivered = best_of(weak, others)
    assert (delivered.name, delivered.kind, delivered.mu, delivered.K) == ("mu", "mu", rival.mu, rival.K)
    assert "'H-infinity, nominal'" in delivered.notes[0] and "12 iterations done" in delivered.notes
    assert best_of(result("mu", "mu synthesis", np.inf, K), [rival]).K is rival.K
