"""From a campaign to a controller. Each function corresponds to a command of `avis` and returns its result in memory.

Only the `save` method of a result writes files, the same ones as the command.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from avis_ctrl.errors import InputError
from avis_ctrl.files import write_together
from avis_ctrl.identification.single_axis.identify import identify_single_axis as single_axis
from avis_ctrl.interface.results import DesignStudy, GapStudy, IdentificationStudy
from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.measurement.formats import read_measurements
from avis_ctrl.measurement.frequency_response import FrequencyResponse
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.rigs.rig_file import load_rig
from avis_ctrl.study.design_file import Design, design_from_table, read_study
from avis_ctrl.study.gap import GapOptions, find_gap
from avis_ctrl.study.hidden_effects import campaign_with_effects
from avis_ctrl.study.identification import IdentifyOptions
from avis_ctrl.study.identification import identify as identify_rig
from avis_ctrl.study.plan_file import default_plan, plan_from_table, read_plan
from avis_ctrl.study.runner import run_design

Progress = Callable[[str], Any]


def rig(source: str | Path = "avis", loaded: bool = False) -> Rig:
    """A table: a built-in one ("avis", "halcyonics", "halcyonics_loaded") or one from a rig file (docs/rig_file.md).

    loaded : add the load of the file's [load] section. Raises InputError: one line that names file, field and value.

    Examples
    --------
    >>> table = ac.rig("avis")
    >>> table.parameters()["mass"].value
    500.0
    """
    return load_rig(source, loaded)


def campaign(path: str | Path, columns: Mapping[str, Any] | None = None, **hints: Any) -> Campaign | FrequencyResponse:
    """Records or frequency responses from a measurement file: HDF5, MATLAB .mat, UFF 58 or CSV.

    Parameters
    ----------
    columns : which variable of the file is which signal, such as {"u": ["V1", "V2"], "y": "S1", "t": "time"}.
    hints : what the file does not state: period_s, excitation, sample_rate_Hz, y_unit.

    Raises
    ------
    InputError : one line that names the file, the field, its value and what was expected.

    Examples
    --------
    >>> volts = np.random.default_rng(1).normal(size=(1000, 3))
    >>> np.savetxt("record.csv", volts, header="V1,V2,S1", delimiter=",", comments="")
    >>> measured = ac.campaign("record.csv", {"u": ["V1", "V2"], "y": "S1"}, sample_rate_Hz=1000.0)
    >>> measured.u_names, measured.records[0].header.samples
    (('V1', 'V2'), 1000)
    """
    return read_measurements(path, columns, **hints)


def simulate_campaign(
    table: Rig | str,
    plan: Mapping[str, Any] | str | Path | None = None,
    *,
    seed: int = 1,
    progress: Progress | None = None,
) -> Campaign:
    """Simulate a campaign with the nonlinear table, as `avis simulate-campaign` does, to try an identification.

    plan : file or keys of docs/campaign_plan.md; by default multisines at three levels, noise, rest, a shaken floor.
        Its `effect` sections add effects that the rig file does not contain.
    Raises InputError for an invalid plan.

    Examples
    --------
    >>> plan = {"duration_s": 2.0, "record": [{"excitation": "noise", "level_percent": 50.0, "records": 2}]}
    >>> measured = ac.simulate_campaign("avis", plan, seed=3)
    >>> len(measured.records), measured.y_names[:2]
    (2, ('Sy1', 'Sz1'))
    """
    table = _rig(table)
    chosen = (
        default_plan(table)
        if plan is None
        else plan_from_table(dict(plan))
        if isinstance(plan, Mapping)
        else read_plan(plan)
    )
    record_done = None if progress is None else lambda k, total, name: progress(f"record {name}, {k} of {total}")
    return campaign_with_effects(table, chosen, seed, record_done).campaign


def identify(
    measured: Campaign | FrequencyResponse | str | Path,
    table: Rig | str,
    *,
    progress: Progress | None = None,
    **options: Any,
) -> IdentificationStudy:
    """Identify a table and its uncertainty from measurements; as `avis identify`.

    Parameters
    ----------
    measured : result of `campaign`, or a file. table : starting model.
    options : parameters, priors, hold_out, band_Hz, starts, kalman, despite_gates, seed, amplifier_corner_Hz; see
        `avis_ctrl.study.identification.IdentifyOptions`.

    Raises
    ------
    InputError : records of another table, a gate (check of the records) with severity "stop", options that do not fit.
    ComputationError : no fit is possible. A fit that does not converge gives a warning through `progress`.

    Examples
    --------
    >>> plan = {"duration_s": 20.0, "truth": {"perturb_percent": 5.0}, "record": [
    ...     {"excitation": "noise", "level_percent": 50.0, "records": 3, "band_Hz": [0.5, 60.0]}]}
    >>> identified = ac.identify(ac.simulate_campaign("avis", plan, seed=3), "avis", starts=1)
    >>> value, standard_deviation, unit = identified.values["mass"]
    >>> abs(value - 500.0) < 50.0, standard_deviation < 25.0, unit
    (True, True, 'kg')
    """
    found = identify_rig(_measured(measured), _rig(table), _options(IdentifyOptions, options), progress or _silent)
    return IdentificationStudy(found)


def gap(
    measured: Campaign | FrequencyResponse | str | Path,
    table: Rig | str,
    *,
    progress: Progress | None = None,
    **options: Any,
) -> GapStudy:
    """Find where a table's model and its measurement disagree, and name the missing effect; as `avis gap`.

    options : band_Hz, seed, gates, despite_gates, amplifier_corner_Hz, design, design_file, own_effects; see
        `avis_ctrl.study.gap.GapOptions`. Raises as `identify`.

    Examples
    --------
    >>> measured = ac.simulate_campaign("avis", "designs/plans/lagging_amplifiers.toml")
    >>> found = ac.gap(measured, "avis")
    >>> found.verdict, [effect.name for effect in found.effects]
    ('explained', ['actuator_lag'])
    """
    return GapStudy(find_gap(_measured(measured), _rig(table), _options(GapOptions, options), progress or _silent))


def design(
    source: Design | IdentificationStudy | Rig | str | Path, *, progress: Progress | None = None, **sections: Any
) -> DesignStudy:
    """Design certified controllers, compare them with skyhook, check them in simulation; as `avis design`.

    Parameters
    ----------
    source : a design file; a table (`rig`, or the name of a built-in one); an identification.
    sections : keep, transmissibility, control_effort, uncertainty, ... with the keys of docs/design_file.md. They
        replace those of the design file, or those of the design that an identification proposes.
    progress : called with a line of text at each step, such as `print`.

    Raises
    ------
    InputError : a key, value or parameter that does not fit, in one line. ComputationError : no controller was found.

    Examples
    --------
    >>> study = ac.design("designs/avis_z_phix.toml", keep=["z"], synthesis={"max_iterations": 2},
    ...                   simulation={"duration_s": 15.0, "random_plants": 0})
    >>> study.met
    True
    >>> files = study.save("reports/z")
    >>> "report.html" in {path.name for path in files}
    True
    """
    return DesignStudy(run_design(*study_inputs(source, **sections), progress or _silent))


def study_inputs(source: Any, **sections: Any) -> tuple[Design, Rig]:
    """The checked design and its rig from the arguments of `design`."""
    if isinstance(source, IdentificationStudy):
        return _identified(source, sections)
    path = Path(source) if isinstance(source, (str, Path)) else None
    if path is not None and path.suffix == ".toml":
        made, table = read_study(path)
        made = _changed(made, sections) if sections else made
        return made, made.equipped(table)
    table = _rig(source)
    name = str(source) if path is not None else table.name
    made = design_from_table({"rig": name, **sections})
    return made, made.equipped(table)


def _identified(source: IdentificationStudy, sections: dict[str, Any]) -> tuple[Design, Rig]:
    # Goes through the command's files, so that both give the same controller.
    with tempfile.TemporaryDirectory() as folder:
        write_together(Path(folder), {name: text.encode() for name, text in source.files(sections or None).items()})
        return read_study(Path(folder, "design.toml"))


def _changed(made: Design, sections: dict[str, Any]) -> Design:
    """A design with other sections. A mapping replaces single keys of a section, any other value the whole section."""
    # The content of an uncertainty file is not a key of a design file.
    bare = made.model_copy(update={"uncertainty": made.uncertainty.model_copy(update={"identified": None})})
    table = bare.model_dump(exclude_none=True)
    for name, value in sections.items():
        table[name] = {**table.get(name, {}), **value} if isinstance(value, Mapping) else value
    changed = design_from_table(table)
    known = changed.uncertainty.identified or made.uncertainty.identified
    return changed.model_copy(update={"uncertainty": changed.uncertainty.model_copy(update={"identified": known})})


def _rig(table: Any) -> Rig:
    if isinstance(table, Rig):
        return table
    if isinstance(table, (str, Path)):
        return load_rig(table)
    raise InputError(
        "expected a rig, the name of a shipped one, or a rig file", field="rig", value=type(table).__name__
    )


def _measured(measured: Any) -> Campaign | FrequencyResponse:
    if isinstance(measured, (str, Path)):
        return read_measurements(measured)
    if not isinstance(measured, (Campaign, FrequencyResponse)):
        raise InputError(
            "expected a campaign, a frequency response or a file", field="measured", value=type(measured).__name__
        )
    return measured


def _options(kind: Any, given: dict[str, Any]) -> Any:
    known = kind.__dataclass_fields__
    if unknown := [name for name in given if name not in known]:
        raise InputError(f"expected some of {', '.join(known)}", field="option", value=unknown[0])
    lists = {name: tuple(value) if isinstance(value, list) else value for name, value in given.items()}
    return kind(**lists)


def _silent(text: str) -> None:
    pass


__all__ = ["campaign", "design", "gap", "identify", "rig", "simulate_campaign", "single_axis", "study_inputs"]
