"""Which records are held out: never one without which a combination of the drives is not excited."""

from __future__ import annotations

import numpy as np
import pytest

from avis_ctrl.gap.campaign_spectra import divide
from avis_ctrl.identification.campaign_fit import split_campaign
from avis_ctrl.measurement.campaign import Campaign, Record, RecordHeader

PATTERNS = np.linalg.qr(np.random.default_rng(1).standard_normal((3, 3)))[0]


def campaign(directions: list[np.ndarray]) -> Campaign:
    """One record of noise for each matrix (k, 3) of directions over three drives; every record drives all three."""
    records = []
    for k, rows in enumerate(directions):
        u = np.random.default_rng((2, k)).standard_normal((600, len(rows))) @ rows
        header = RecordHeader(f"{k:02d}", 100.0, 600, ("u1", "u2", "u3"), ("y",), "noise", 1.0, 10.0 * k)
        records.append(Record(header, u, u[:, :1]))
    return Campaign("", tuple(records))


@pytest.mark.parametrize("lean", [False, True])
@pytest.mark.parametrize("of", [split_campaign, divide])
def test_a_direction_of_its_own_is_not_held_out(of, lean):
    axes = [PATTERNS[[k]] for k in range(3)]
    # Voltages of logical axes are not orthogonal: each pushes along the others, too, and yet has a part of its own.
    leaning = axes[2] + 0.7 * axes[0]
    found = of(campaign([*axes[:2], leaning if lean else axes[2]]))
    assert len(found.fitted.records) == len(found.held_out.records) == 3 and "last third of every record" in found.how


@pytest.mark.parametrize("of", [split_campaign, divide])
def test_a_record_is_held_out_where_the_others_excite_what_it_excites(of):
    found = of(campaign([PATTERNS[[k]] for k in (0, 1, 2, 0, 1, 2)]))
    names = [record.header.name for record in found.held_out.records]
    assert "05" in names and set(names) <= {"03", "04", "05"}
    assert [r.header.name for r in of(campaign([PATTERNS] * 4)).held_out.records] == ["03"]


@pytest.mark.parametrize(("amplitude", "held"), [(0.05, 0), (0.3, 1)])
def test_weak_excitation_beside_others_is_not_enough(amplitude, held):
    """The third direction at a twentieth of the amplitude in the others: a four-hundredth of its power."""
    weak = PATTERNS * np.array([1.0, 1.0, amplitude])[:, None]
    found = split_campaign(campaign([weak, weak, PATTERNS]))
    assert (found.held_out.records[-1].header.name == "02") == held
    assert len(found.held_out.records) in (1, 3)
