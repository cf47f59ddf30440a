"""A folder written by `avis design`, read for export."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.export.realisation import processor_form
from avis_ctrl.export.sampled_controller import Arithmetic, SampledController
from avis_ctrl.lti.statespace import StateSpace
from avis_ctrl.rigs.file_errors import read_json
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.simulation.discrete import digital_controller
from avis_ctrl.simulation.sampled_loop import SampledLoop
from avis_ctrl.study.design_file import Design
from avis_ctrl.study.other_axes import Companion
from avis_ctrl.study.plant import DesignPlant, build_plant
from avis_ctrl.study.simulation import bare_loop
from avis_ctrl.study.study_file import read_saved


@dataclass(frozen=True, eq=False)
class Added:
    """A controller of the logical axes that was derived from those of the folder.

    orders : number of states and upper bound of the design's mu (continuous, at all frequencies) of the original
    controller, of the intermediate ones, and finally of this one.
    """

    K: StateSpace
    orders: tuple[tuple[int, float], ...] = ()


@dataclass(frozen=True, eq=False)
class DesignFolder:
    """Contents of a design folder.

    result : result.json. plant : the generalized plant of the design, built from its inputs.
    added : further controllers, by name.
    """

    path: Path
    design: Design
    rig: Rig
    result: dict[str, Any]
    plant: DesignPlant
    added: Mapping[str, Added] = field(default_factory=dict)

    @property
    def names(self) -> list[str]:
        """Names of the controllers that have a file."""
        return [row["name"] for row in self.result["controllers"] if row.get("file")]

    @property
    def inputs_sha256(self) -> str | None:
        """Hash of the design's inputs, as written by avis design."""
        return self.result.get("provenance", {}).get("inputs_sha256")

    def controller(self, name: str) -> StateSpace:
        """The continuous controller of the logical axes. Raises InputError, which lists the known names."""
        if name in self.added:
            return self.added[name].K
        if name not in self.names:
            raise InputError(f"expected one of {', '.join(self.names)}", field="--controller", value=name)
        return self.controller_in(self.path / "controllers" / f"{name}.json")

    def controller_in(self, path: Path) -> StateSpace:
        """The controller of the logical axes in a file. Raises InputError."""
        content = read_json(path, "avis-controller")
        try:
            A, B, C, D = (np.array(content[part], float) for part in "ABCD")
            K = StateSpace(A, B, C, D, float(content["dt"]), tuple(content["inputs"]), tuple(content["outputs"]))
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"expected a controller as avis design writes it; {error!r}", file=path) from None
        if K.D.shape != (len(self.design.keep),) * 2:
            raise InputError(f"expected {len(self.design.keep)} inputs and outputs", file=path, value=K.D.shape)
        return K

    def loop(self, K: StateSpace) -> SampledLoop:
        """The controller on its nominal rig; the other axes have the loops that the design checked."""
        loops = {one.axis: one.loop() for one in map(_companion, self.result["all_axes"].get("companions", ()))}
        return replace(bare_loop(self.design, self.rig, self.plant, K), loops=loops)

    def sampled(self, name: str, arithmetic: Arithmetic = "float64") -> SampledController:
        """The controller from sensor volts to drive volts, in the form and with the numbers that the processor uses."""
        loop = self.loop(self.controller(name))
        system = processor_form(digital_controller(loop))
        names = loop.rig.sensor_rows()[0], loop.rig.equations_of_motion().actuators
        return SampledController(
            name, system.renamed(*names), arithmetic, loop.limits_V, loop.loop_delay_s * loop.sample_rate_Hz
        ).rounded(arithmetic)


def _companion(row: dict[str, Any]) -> Companion:
    return Companion(
        row["axis"],
        row["gain"],
        row["tilt_corner_Hz"],
        row["roll_off_Hz"],
        row["modulus_margin"] if row["modulus_margin"] is not None else np.nan,
    )


def open_design(path: Path) -> DesignFolder:
    """Read a folder of `avis design`.

    Raises
    ------
    InputError : no such folder, or files that are missing or wrong.
    ComputationError : the design's own simulation was unstable: such a controller is not exported.
    """
    if not path.is_dir():
        raise InputError("expected a folder that avis design wrote", field="DESIGN_DIR", value=str(path))
    if not (path / "result.json").exists():
        other = "; this is a folder of avis export: are DESIGN_DIR and --out swapped?"
        raise InputError(
            "expected a folder that avis design wrote; result.json is missing in it"
            + other * (path / "certificate.json").exists(),
            field="DESIGN_DIR",
            value=str(path),
        )
    result = read_json(path / "result.json", "avis-design")
    design, rig = read_saved(path)
    if result.get("stable") is not True:
        raise ComputationError(
            "the closed loop of this design was unstable in simulation, so it is not exported",
            cause=str(result.get("verdict", "")),
            next_step="design again with other weights",
        )
    if not isinstance(result.get("controllers"), list) or not isinstance(result.get("all_axes"), dict):
        raise InputError("expected controllers and all_axes", file=path / "result.json")
    return DesignFolder(path, design, rig, result, build_plant(design, rig))
