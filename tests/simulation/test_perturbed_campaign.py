"""A truth beside its campaign and not in it."""

import numpy as np
import pytest

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import digest
from avis_ctrl.rigs import load_rig
from avis_ctrl.simulation.campaign_data import simulate_campaign
from avis_ctrl.simulation.campaign_plan import CampaignPlan
from avis_ctrl.simulation.perturbed_campaign import perturbed_campaign, perturbed_truth

PLAN = {
    "duration_s": 5.0,
    "settle_s": 0.0,
    "ambient": {"velocity_rms_m_per_s": 2e-6},
    "truth": {"perturb_percent": 5.0, "perturb_damping_percent": 20.0},
    "record": [{"excitation": "noise", "level_V": 0.1}],
}


@pytest.mark.parametrize(
    ("name", "stiff", "damped"), [("avis", 4 + 12, 12), ("halcyonics", 3 + 7, 5), ("halcyonics_loaded", 7, 5)]
)
def test_truths_spread_as_far_as_asked_and_no_farther(name, stiff, damped):
    rig = load_rig(name)
    known = {key: one.value for key, one in rig.parameters().items() if key != "k_s"}
    ratios = []
    for seed in range(40):
        values = perturbed_truth(rig, 5.0, 20.0, seed).parameters()
        ratios.append([values[key].value / old if old else 1.0 for key, old in known.items()])
    largest = np.abs(np.array(ratios) - 1).max(axis=0)
    assert np.count_nonzero((largest > 0.04) & (largest <= 0.05)) == stiff
    assert np.count_nonzero((largest > 0.15) & (largest <= 0.2)) == damped
    assert np.count_nonzero(largest == 0) == len(known) - stiff - damped
    assert perturbed_truth(rig, 0.0, 0.0, 1) == rig
    assert perturbed_truth(rig, 5.0, 20.0, 7) == perturbed_truth(rig, 5.0, 20.0, 7)


def test_a_perturbed_campaign(tmp_path):
    rig, plan = load_rig("avis"), CampaignPlan.model_validate(PLAN)
    done = perturbed_campaign(rig, plan, 4)
    assert done.truth == perturbed_truth(rig, 5.0, 20.0, 4) and len(done.true_values) == 4 + 12 + 12
    assert digest(done.campaign) == digest(simulate_campaign(rig, plan, 4, truth=done.truth))
    assert digest(done.campaign) != digest(simulate_campaign(rig, plan, 4))
    assert done.campaign.rig == "avis"
    told = repr([done.campaign.notes, done.campaign.source, [r.header for r in done.campaign.records]])
    assert not any(f"{value:.5g}" in told for value in done.true_values.values())
    path = tmp_path / "truth.toml"
    path.write_text(done.truth_toml(), encoding="utf-8")
    assert load_rig(path) == done.truth
    assert f"mass x {done.true_values['mass'] / 500.0:.6f}" in path.read_text()


def test_spreads_that_no_rig_can_have():
    with pytest.raises(InputError, match="perturb_percent"):
        perturbed_truth(load_rig("avis"), 100.0, 20.0)
    with pytest.raises(InputError, match="perturb_damping_percent"):
        perturbed_truth(load_rig("avis"), 5.0, -1.0)
