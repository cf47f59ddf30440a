"""Results of the public functions: a summary, plots, and the files of the corresponding command."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from avis_ctrl import plot, uncertain_value
from avis_ctrl.errors import AvisError
from avis_ctrl.gap.result import Gap
from avis_ctrl.lti.statespace import StateSpace
from avis_ctrl.plot.axes import axes_of, finish
from avis_ctrl.report import content, rendered
from avis_ctrl.report.gap import content as gap_content
from avis_ctrl.report.identification import content as identification
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.study.design_file import Design, design_from_table
from avis_ctrl.study.design_result import DesignResult, Requirement
from avis_ctrl.study.file_names import DESIGN_FOLDER, GAP_FILES, IDENTIFICATION_FILES, RIG_FILE
from avis_ctrl.study.files import open_folder
from avis_ctrl.study.gap import GapFinding
from avis_ctrl.study.gap_files import write_gap
from avis_ctrl.study.identification import Identification
from avis_ctrl.study.identification_design import default_design, default_keep, design_start
from avis_ctrl.study.identification_output import identified_toml, write_identification
from avis_ctrl.study.output import FILES, FOLDERS, write_study
from avis_ctrl.study.verdict import all_axes, first_sentence, requirement_rows
from avis_ctrl.summary import html_table, wrapped


@dataclass(frozen=True, eq=False, repr=False)
class DesignStudy:
    """Result of `design`, as `avis design` computes it: controllers, bounds, simulation, verdict.

    result : the complete `DesignResult`.
    """

    result: DesignResult

    @property
    def controller(self) -> StateSpace:
        """The delivered controller u = K y of the axes in `keep`."""
        K = self.result.controller("mu").K
        assert K is not None  # only the passive table has no controller
        return K

    @property
    def sampled_controller(self) -> StateSpace | None:
        """The controller for the processor, sensor volts to drive volts, all axes; None without a simulation."""
        return self.result.loop.digital if self.result.loop is not None else None

    @property
    def requirements(self) -> tuple[Requirement, ...]:
        """Rows of the verdict table."""
        return self.result.requirements

    @property
    def met(self) -> bool:
        """Whether every requirement is met and every simulated plant is stable."""
        return self.result.stable and all(one.met for one in self.requirements)

    def summary(self) -> str:
        """The verdict in words, and one line for each requirement."""
        lines = [wrapped(first_sentence(self.result))]
        if self.result.stable:
            lines.append(wrapped(all_axes(self.result)))
        rows = self._rows()
        widths = [max((len(row[k]) for row in rows), default=0) for k in range(3)]
        lines += [
            "  " + "  ".join([name.ljust(widths[0]), limit.rjust(widths[1]), value.rjust(widths[2]), met])
            for name, limit, value, met in rows
        ]
        return "\n".join([*lines, *map(wrapped, self.result.remarks)])

    def _rows(self) -> list[tuple[str, ...]]:
        return [(*row, "met" if met else "not met") for *row, met in requirement_rows(self.result)]

    def plot_transmissibility(self, ax: Any = None, controllers: Any = None) -> Any:
        """Transmissibility from floor to payload of every controller; see `plot.transmissibility`."""
        return plot.transmissibility(self.result, ax, controllers=controllers)

    def plot_mu(self, ax: Any = None, controller: str = "mu") -> Any:
        """Bounds of mu of the loop with one controller; see `plot.mu`."""
        return plot.mu(self.result.controller(controller).mu, ax)

    def plot_dk_history(self, ax: Any = None) -> Any:
        """Progress of the D-K iteration; see `plot.dk_history`."""
        return plot.dk_history(self.result.dk_history, ax)

    def plot_controller(self, ax: Any = None) -> Any:
        """Singular values of the controller; see `plot.sigma`."""
        return plot.sigma(self.controller, ax=ax)

    def plot_vibration(self, ax: Any = None) -> Any:
        """Third-octave velocity of floor and payload (worst axis) with the vibration criteria."""
        site = self.result.controller("mu").site
        f = site.third_octave_Hz
        return plot.vc_curves(
            {"floor": (f, site.floor_third_octaves), "payload, mu": (f, np.max(site.payload_third_octaves, axis=1))}, ax
        )

    def save(self, folder: str | Path) -> list[Path]:
        """Write the files of `avis design`, all or none: reports, controllers, plant.json, result.json.

        Raises InputError for a folder that cannot be written, ComputationError for a full disk.
        """
        out = open_folder(folder, FILES, FOLDERS)
        return write_study(self.result, out, *rendered(content.document(self.result)))

    def __repr__(self) -> str:
        met = sum(one.met for one in self.requirements)
        return f"DesignStudy({self.result.design.title!r}: {met} of {len(self.requirements)} requirements met)"

    def _repr_html_(self) -> str:
        return html_table(self._rows(), ("requirement", "limit", "result", ""), first_sentence(self.result))


@dataclass(frozen=True, eq=False, repr=False)
class IdentificationStudy:
    """Result of `identify`, as `avis identify` computes it: identified table, uncertainty, verdict on held-out records.

    found : the complete `Identification`.
    """

    found: Identification

    @property
    def rig(self) -> Rig:
        """The table with the identified values."""
        return self.found.rig

    @property
    def values(self) -> dict[str, tuple[float, float, str]]:
        """(value, standard deviation, unit) by parameter; std is inf for a parameter determined only in combination."""
        i = self.found.information
        return {
            name: (float(v), float(s), u)
            for name, v, s, u in zip(i.names, i.values, i.standard_deviation, i.units, strict=True)
        }

    def _rows(self) -> list[tuple[str, str, str]]:
        return [
            (
                name,
                uncertain_value.text(value, sigma) if np.isfinite(sigma) else f"{value:.6g}, only in combination",
                unit,
            )
            for name, (value, sigma, unit) in self.values.items()
        ]

    def summary(self) -> str:
        """The identified values, the verdict on held-out records, and what the data do not determine."""
        verdict, *more = self.found.validation.sentences
        rest = (*self.found.campaign_fit.notes, *more, *self.found.identifiability.sentences)
        return "\n".join(
            [
                wrapped(f"{verdict[:1].upper()}{verdict[1:]}."),
                *(f"  {name:20s} {value:>26s} {unit}" for name, value, unit in self._rows()),
                *map(wrapped, rest),
            ]
        )

    def plot_values(self, ax: Any = None) -> Any:
        """Relative change of each parameter from its starting value, with its standard deviation."""
        ax = axes_of(ax)
        start = self.found.start.parameters()
        rows = [
            (name, v, s, start[name].value)
            for name, (v, s, _) in self.values.items()
            if name in start and start[name].value
        ]
        change = [100 * (v / old - 1) for _, v, _, old in rows]
        bars = [100 * abs(s / old) if np.isfinite(s) else 0.0 for _, _, s, old in rows]
        places = np.arange(len(rows))[::-1]
        ax.errorbar(change, places, xerr=bars, fmt="o", color="#0072b2", markersize=4, capsize=2)
        ax.axvline(0.0, color="#7a7a7a", linewidth=0.8)
        ax.set_yticks(places, [name for name, *_ in rows], fontsize="x-small")
        return finish(ax, "identified against starting value [%]", "", log=False)

    def files(self, sections: Mapping[str, Any] | None = None) -> dict[str, str]:
        """Contents of rig.toml, uncertainty.json and design.toml by name: the input of a design.

        sections : sections of the design that replace the proposed ones. Raises as `design`.
        """
        made, _ = design_start(self.found, self._template(sections))
        return {RIG_FILE: identified_toml(self.found), **made}

    def _template(self, sections: Mapping[str, Any] | None) -> Design | None:
        if not sections:
            return None
        given = dict(sections)
        keep = given.get("keep") or default_keep(self.rig)
        title = f"{self.rig.name}, identified: {' and '.join(keep)} under one controller"
        proposed = default_design(self.rig, title).model_dump(exclude_none=True)
        return design_from_table({**proposed, "keep": keep, **given, "rig": RIG_FILE})

    def save(self, folder: str | Path, **sections: Any) -> list[Path]:
        """Write the files of `avis identify`, all or none; sections : of design.toml, as for `files`.

        Raises InputError for a folder that cannot be written or sections that do not fit.
        """
        out = open_folder(folder, IDENTIFICATION_FILES)
        template, made = self._template(sections), None
        more: dict[str, str] = {}
        try:
            more, made = design_start(self.found, template)
        except AvisError:
            # As in the command: the identification is valid without the design files.
            if sections:
                raise
        return write_identification(self.found, out, *rendered(identification.document(self.found, made)), more)

    def __repr__(self) -> str:
        information = self.found.information
        return (
            f"IdentificationStudy({self.rig.name!r}: {information.rank} of {len(information.names)} combinations "
            "of parameters determined)"
        )

    def _repr_html_(self) -> str:
        return html_table(self._rows(), ("parameter", "value +- standard deviation", "unit"), self.rig.name)


@dataclass(frozen=True, eq=False, repr=False)
class GapStudy:
    """Result of `gap`, as `avis gap` computes it: the verdict, the named effects, both models.

    found : the complete `GapFinding`.
    """

    found: GapFinding

    @property
    def gap(self) -> Gap:
        """The gap, its effects and both models."""
        return self.found.gap

    @property
    def effects(self) -> tuple[Any, ...]:
        """The named effects."""
        return tuple(self.gap.effects)

    @property
    def verdict(self) -> str:
        """One of none, explained, partly explained, unexplained."""
        return self.gap.verdict

    def summary(self) -> str:
        """The verdict and the sentences of the report."""
        first, *more = self.gap.sentences
        return "\n".join(map(wrapped, (f"{self.verdict}: {first}", *more)))

    def _rows(self) -> list[tuple[str, str]]:
        rows = [(stage.name, f"{100 * stage.nrmse:.3g} %") for stage in self.gap.stages]
        return [*rows, ("noise alone", f"{100 * self.gap.noise_nrmse:.3g} %")]

    def plot_stages(self, ax: Any = None) -> Any:
        """Prediction error of the sensor signals on held-out records [%] by stage, with the noise level."""
        ax = axes_of(ax)
        names = [stage.name for stage in self.gap.stages]
        places = np.arange(len(names))[::-1]
        ax.barh(places, [100 * stage.nrmse for stage in self.gap.stages], color="#0072b2", height=0.5)
        ax.axvline(100 * self.gap.noise_nrmse, color="#b3261e", linestyle="--", linewidth=1, label="noise alone")
        ax.set_yticks(places, names)
        return finish(ax, "error of held-out signals, r.m.s. [%]", "", log=False)

    def save(self, folder: str | Path) -> list[Path]:
        """Write the files of `avis gap`, all or none. Raises InputError for a folder that cannot be written."""
        design = self.found.design.files if self.found.design else None
        out = open_folder(folder, GAP_FILES, (DESIGN_FOLDER,) if design else ())
        return write_gap(out, self.gap, *rendered(gap_content.document(self.found)), self.found.to_json(), design)

    def __repr__(self) -> str:
        named = ", ".join(one.name for one in self.effects) or "no effect named"
        return f"GapStudy({self.verdict}: {named})"

    def _repr_html_(self) -> str:
        return html_table(self._rows(), ("stage", "error on held-out records"), repr(self))


__all__ = ["DesignStudy", "GapStudy", "IdentificationStudy"]
