"""What a verdict of none is worth: the limits are those of a fit with the effect, and what lies above them is seen."""

from __future__ import annotations

import numpy as np
import pytest
from noise_fit import fitted
from test_score import MODEL, block, effect

from avis_ctrl.gap.detection_limits import detection_limits
from avis_ctrl.gap.effects.library import library
from avis_ctrl.gap.score import Score
from avis_ctrl.gap.table_model import TableModel
from avis_ctrl.identification.parameter_sets import default_parameters
from avis_ctrl.identification.response import ResponseModel

OWN = library()


def limits(model, blocks, effects):
    """Of five standard deviations by noise."""
    return detection_limits(Score(model, blocks), effects)


def nothing_missing(seed=1):
    blocks = [block(MODEL, np.random.default_rng(seed), name=name) for name in ("00", "01")]
    return fitted(MODEL, blocks).model, blocks


def test_limits_are_five_deviations_of_a_fit_with_the_effect():
    """By another path: a fit of all parameters, from whose information the rig's are eliminated."""
    model, blocks = nothing_missing()
    names = ("sensor_gain", "com_offset", "loop_delay", "structural_damping")
    rows = {(one.name, one.location, one.parameter): one for one in limits(model, blocks, [OWN[n] for n in names])}
    for name, place, shown in (("sensor_gain", "Sz2", "Sz2"), ("com_offset", "payload", "payload")):
        added = model.with_effect(effect(name, place, None, model))
        found = fitted(added, blocks, 0)
        whole = np.linalg.inv(found.information.relative) * np.outer(*[found.information.scale] * 2)
        std = np.sqrt(np.diag(whole)[-len(found.model.effects[-1].parameters) :])
        for parameter, own in zip(found.model.effects[-1].parameters, std, strict=True):
            row = rows[name, shown, parameter.name]
            assert row.value == pytest.approx(5 * own, rel=1e-2)
            assert row.unit == parameter.unit
    # Of two laws of one effect one row, at the place that is reported.
    assert [key for key in rows if key[0] == "structural_damping"] == [
        ("structural_damping", "isolators", "loss_factor")
    ]


def test_what_lies_well_above_its_limit_is_seen():
    model, blocks = nothing_missing()
    limit = next(one.value for one in limits(model, blocks, [OWN["sensor_gain"]]) if one.location == "Sz3")
    for factor, seen in ((3.0, True), (0.1, False)):
        truth = MODEL.with_effect(effect("sensor_gain", "Sz3", [1 + factor * limit]))
        made = [block(truth, np.random.default_rng(7), name=name) for name in ("00", "01")]
        score = Score(fitted(MODEL, made).model, made)
        took = score.reduction(score.of_effect(effect("sensor_gain", "Sz3", None, score.model)))
        assert (took.chi2 > 25.0) == seen


def test_what_re_identification_absorbs_has_no_limit():
    free = TableModel(ResponseModel.of(MODEL.rig, (*default_parameters(MODEL.rig), "sensor.Sz2")))
    blocks = [block(MODEL, np.random.default_rng(2))]
    rows = {one.location: one.value for one in limits(free, blocks, [OWN["sensor_gain"]])}
    assert rows.pop("Sz2") == np.inf
    assert np.all(np.isfinite(list(rows.values())))


def test_effects_that_have_a_shape_are_left_out():
    model, blocks = nothing_missing()
    assert limits(model, blocks, [OWN["mount_relaxation"], OWN["actuator_saturation"]]) == ()
