"""Identification of a rig from measurements: gates (checks of the records), fits, identifiability, validation."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from avis_ctrl.errors import AvisError, InputError
from avis_ctrl.identification.campaign_fit import (
    CampaignFit,
    Split,
    driven_inputs,
    excited_band,
    fit_campaign,
    fits_tolerances,
    split_campaign,
)
from avis_ctrl.identification.ekf import identify_ekf
from avis_ctrl.identification.ekf_result import EkfResult
from avis_ctrl.identification.ekf_settings import HONEST_SETTINGS
from avis_ctrl.identification.excited_space import excited_space
from avis_ctrl.identification.experiment_plan import needed_experiment
from avis_ctrl.identification.experiments import Drive, campaign_noise
from avis_ctrl.identification.fit_settings import SETTINGS as FIT
from avis_ctrl.identification.identifiability import IdentifiabilityReport, identifiability_report
from avis_ctrl.identification.information import Information
from avis_ctrl.identification.maximum_likelihood import Prior
from avis_ctrl.identification.parameter_sets import default_parameters, named_parameters
from avis_ctrl.identification.priors import tolerances_of
from avis_ctrl.identification.response import INERTIAL, ResponseModel
from avis_ctrl.identification.validation import Validation, validate
from avis_ctrl.measurement.campaign import Campaign, digest
from avis_ctrl.measurement.frequency_response import FrequencyResponse
from avis_ctrl.measurement.gates import Finding
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.simulation.campaign_data import SETTINGS as CAMPAIGN
from avis_ctrl.study.provenance import provenance
from avis_ctrl.study.record_checks import check_campaign
from avis_ctrl.study.rig_channels import with_rig_names

Progress = Callable[[str], None]
CAUTION = (
    "the standard deviations include only the noise of these records; values that were not fitted (such as "
    "force constants, sensitivities, positions) count as exact"
)
TOLERANT = (
    "the standard deviations include noise, the tolerances of the rig file, and errors of the response that "
    "nothing in the model explains"
)


@dataclass(frozen=True)
class IdentifyOptions:
    """User options.

    parameters : names or wildcards of the free parameters; by default the rig's usual ones.
    priors : (mean, standard deviation) by parameter.
    hold_out : records that are not used in any fit; chosen automatically if None. band_Hz : of the fit; the excited
        band if None.
    amplifier_corner_Hz : first-order lag of the amplifiers, which no rig file states; see `amplifier_corner`.
    starts : number of starting points of the maximum likelihood fit. kalman : also run the extended Kalman filter.
    despite_gates : continue if a gate reports a stop.
    """

    parameters: tuple[str, ...] = ()
    priors: Mapping[str, Prior] = field(default_factory=dict)
    hold_out: tuple[str, ...] | None = None
    band_Hz: tuple[float, float] | None = None
    starts: int = 3
    kalman: bool = False
    despite_gates: bool = False
    seed: int = 1
    amplifier_corner_Hz: float | None = None


@dataclass(frozen=True, eq=False)
class Identification:
    """Complete result of `avis identify`.

    rig : with the identified values; start : the starting rig. split : None for frequency responses without records.
    advice : further records that would determine what is missing, with predicted standard deviations.
    kalman : result of the extended Kalman filter, if requested; kalman_note : why there is none.
    """

    start: Rig
    rig: Rig
    options: IdentifyOptions
    measured: Campaign | FrequencyResponse
    findings: tuple[Finding, ...]
    split: Split | None
    campaign_fit: CampaignFit
    identifiability: IdentifiabilityReport
    advice: tuple[str, ...]
    validation: Validation
    kalman: EkfResult | None
    kalman_note: str
    provenance: Mapping[str, Any]
    seconds: float

    @property
    def model(self) -> ResponseModel:
        """The model with the identified parameters free."""
        return self.campaign_fit.model

    @property
    def caution(self) -> str:
        """What the standard deviations include."""
        return TOLERANT if self.campaign_fit.tolerances else CAUTION

    @property
    def information(self) -> Information:
        """Information on the identified parameters, marginal over the tolerances."""
        return self.campaign_fit.information


def identify(
    measured: Campaign | FrequencyResponse,
    rig: Rig,
    options: IdentifyOptions | None = None,
    progress: Progress = lambda text: None,
) -> Identification:
    """Identify a rig.

    Raises
    ------
    InputError : records of another rig, a gate that reports a stop, options that do not fit.
    ComputationError : no fit is possible. A fit that does not converge gives a warning through `progress`.
    """
    options, began = options or IdentifyOptions(), time.monotonic()
    measured = with_rig_names(rig, measured)
    _check(measured, options)
    with threadpool_limits(1):
        model = start_model(measured, rig, options)
        findings = _gates(measured, model, options, progress)
        progress("choosing the records to fit, the records to hold out, and the band")
        split, fitted, held_out, band = _divide(measured, options)
        unplayed = excited_space(split.fitted, band).sentence if split else ""
        if unplayed:
            progress(unplayed)
        if model.amplifier_corner_Hz:
            fitted_lag = fits_tolerances(measured, rig)
            progress(amplifier_words(model.amplifier_corner_Hz, options.amplifier_corner_Hz, fitted=fitted_lag))
        progress(
            f"maximum likelihood: {len(model.names)} parameters, {band[0]:.3g} to {band[1]:.3g} Hz"
            + (f"; {split.how}" if split else "")
        )
        found = fit_campaign(
            fitted,
            model,
            band,
            options.priors,
            options.starts,
            options.seed,
            progress=progress,
            tolerances=tolerances_of(rig),
        )
        if not found.fit.converged:
            progress("  warning: the fit did not converge; check the verdict on the held-out records")
        far = far_from_file(model, found.information)
        for sentence in far:
            progress(f"  warning: {sentence}")
        found = replace(found, notes=(*far, *found.notes, *([unplayed] if unplayed else [])))
        floor = any(block.block.kind == "floor measured" for block in found.fit.residuals)
        report = identifiability_report(
            found.information, found.structure, floor, {name: sigma for name, (_, sigma) in options.priors.items()}
        )
        progress(f"the data determine {found.information.rank} of {len(model.names)} combinations of parameters")
        advice = _advice(found, fitted, progress)
        kalman, note = _kalman(split.fitted if split else measured, rig, model.names, options, progress)
        progress("validation on held-out data")
        validation = validate(found, fitted, held_out)
    identified = found.fit.model.rig
    seconds = time.monotonic() - began
    return Identification(
        rig,
        identified,
        options,
        measured,
        findings,
        split,
        found,
        report,
        advice,
        validation,
        kalman,
        note,
        identification_provenance(measured, rig, options, seconds),
        seconds,
    )


def _check(measured: Campaign | FrequencyResponse, options: IdentifyOptions) -> None:
    """Checks that are possible before any slow computation."""
    if options.band_Hz is not None and not 0 <= options.band_Hz[0] < options.band_Hz[1]:
        raise InputError("expected the lower limit first, then the upper one", field="band_Hz", value=options.band_Hz)
    if isinstance(measured, Campaign):
        for name in options.hold_out or ():
            measured.named(name)
        if options.band_Hz is not None:
            low, high = excited_band(measured)
            if options.band_Hz[0] >= high or options.band_Hz[1] <= low:
                raise InputError(
                    f"the records are excited from {low:.3g} to {high:.3g} Hz; expected a band that overlaps this one",
                    field="band_Hz",
                    value=options.band_Hz,
                )


@dataclass(frozen=True)
class FitPlausibility:
    """Criteria for identified masses and moments of inertia that are far from the rig file's.

    far : ratio of the two values, or its inverse, from which they are far apart; drawings and scales are accurate to a
        few per cent.
    alike : the identified values differ from the file's by a common factor if the largest ratio is less than this many
        times the smallest.
    known : relative standard deviation above which a parameter is not considered.
    """

    far: float = 1.5
    alike: float = 1.5
    known: float = 0.1


def far_from_file(
    start: ResponseModel, information: Information, settings: FitPlausibility = FitPlausibility()
) -> tuple[str, ...]:
    """A sentence with the likely cause if an identified mass or moment of inertia is far from the rig file's, which is
    roughly correct; otherwise empty."""
    before = dict(zip(start.names, start.values, strict=True))
    found = [
        (name, float(value / before[name]), float(value), unit)
        for name, value, unit, sigma in zip(
            information.names, information.values, information.units, information.standard_deviation, strict=True
        )
        if before[name] > 0 and value > 0 and sigma <= settings.known * value
    ]
    far = [one for one in found if one[0] in INERTIAL and not 1 / settings.far < one[1] < settings.far]
    if not far:
        return ()
    name, ratio, value, unit = far[0]
    said = f"{name} is identified as {value:.4g} {unit}, {ratio:.3g} times the rig file's {value / ratio:.4g} {unit}"
    others = [one[1] for one in found if one[0] in INERTIAL or ".k_" in one[0] or one[0].startswith("k_")]
    if len(others) > 2 and max(others) / min(others) < settings.alike:
        middle = float(np.median(others))
        return (
            f"{said}, and all masses, moments of inertia and stiffnesses that are well determined are about "
            f"{middle:.2g} times those of the file. A response to the drives depends only on their ratio to the "
            f"force constants and sensitivities: check these for a factor of {middle:.2g} or {1 / middle:.2g}",
        )
    more = f"; also far from the file: {', '.join(one[0] for one in far[1:])}" if len(far) > 1 else ""
    return (f"{said}{more}. Check the rig file, and whether these data determine the value",)


def amplifier_corner(rig: Rig, stated_Hz: float | None) -> float | None:
    """The stated corner of the amplifiers [Hz]; if None, a default for tables with accelerometers.

    The default is that of simulated campaigns and designs. Without a lag an accelerometer would measure a force that
    jumps exactly at the sampling instant.
    """
    if stated_Hz is None and any(one.quantity == "acceleration" for one in rig.sensors()):
        return CAMPAIGN.amplifier_corner_Hz
    return stated_Hz


def amplifier_words(corner_Hz: float, stated_Hz: float | None, fitted: bool) -> str:
    """The corner in words, and whether it was stated and is fitted."""
    found = f"amplifiers with a first-order lag of {corner_Hz:g} Hz"
    if not stated_Hz:
        found += ", the default for tables with accelerometers (--amplifier-corner sets another corner)"
    return found + (f"; their time constant is fitted, with a tolerance of {FIT.lag_percent:g} %" if fitted else "")


def start_model(measured: Campaign | FrequencyResponse, rig: Rig, options: IdentifyOptions) -> ResponseModel:
    """The rig as in its file, with the channels of the measurement.

    Raises InputError if channels, units or parameters are not those of the rig.
    """
    if isinstance(measured, Campaign):
        unit, sensors, actuators, sampled = measured.y_unit, measured.y_names, measured.u_names, True
        if measured.records[0].header.u_unit != "V":
            raise InputError(
                "expected commanded voltages in V", field="unit of u", value=measured.records[0].header.u_unit
            )
    else:
        unit, sensors, sampled = measured.output_unit, measured.outputs, False
        actuators = tuple(name for name in measured.inputs if name not in ("vx", "vy", "vz"))
    names = named_parameters(rig, options.parameters, unit) if options.parameters else default_parameters(rig)
    if homeless := [name for name in names if name.startswith(("corner.", "damping."))]:
        raise InputError(
            "a rig file states one suspension for all geophones, so that these could not be written",
            field="parameters",
            value=homeless,
        )
    corner = amplifier_corner(rig, options.amplifier_corner_Hz)
    return ResponseModel.of(rig, names, unit, sensors, actuators, sampled, corner)


def _gates(
    measured: Campaign | FrequencyResponse, model: ResponseModel, options: IdentifyOptions, progress: Progress
) -> tuple[Finding, ...]:
    """Findings in the records before any fit; none for frequency responses."""
    if not isinstance(measured, Campaign):
        return ()
    kinds = ", ".join(sorted({record.header.excitation for record in measured.records}))
    progress(f"gates: {len(measured.records)} records of {kinds}")
    return check_campaign(measured, model, options.despite_gates, progress)


def _divide(
    measured: Campaign | FrequencyResponse, options: IdentifyOptions
) -> tuple[Split | None, Campaign | FrequencyResponse, Campaign | FrequencyResponse, tuple[float, float]]:
    """Split, data to fit, held-out data, and the band."""
    if isinstance(measured, FrequencyResponse):
        band = options.band_Hz or (float(measured.frequency_Hz[0]), float(measured.frequency_Hz[-1]))
        return None, *_divided_lines(measured.between(*band)), band
    split = split_campaign(measured, options.hold_out)
    band = options.band_Hz or excited_band(split.fitted)
    return split, split.fitted, split.held_out, band


def _divided_lines(measured: FrequencyResponse) -> tuple[FrequencyResponse, FrequencyResponse]:
    """Fitted and held-out lines: every fourth stretch is held out, and adjacent lines with shared data are omitted."""
    gap = int(np.ceil(measured.shared)) if measured.shared > 1 else 0
    stretch = max(3, 3 * gap)
    place = np.arange(len(measured.frequency_Hz))
    held = (place // stretch) % 4 == 3
    near = np.convolve(held, np.ones(2 * gap + 1), mode="same") > 0
    if not np.any(held) or np.all(near):
        raise InputError(
            f"expected more than {4 * stretch} lines, of which a quarter is held out",
            value=len(place),
            field="lines of the frequency response",
        )
    return measured.at(~near), measured.at(held)


def _advice(found: CampaignFit, fitted: Campaign | FrequencyResponse, progress: Progress) -> tuple[str, ...]:
    """Benefit of a further record like the fitted ones, or of another kind."""
    model = found.structure
    if found.information.rank == len(model.names) or not isinstance(fitted, Campaign):
        return ()
    progress("searching for a further record that would determine the rest")
    driven = [record.header for record in fitted.records if record.header.level_V > 0]
    if not driven:
        return ("No record drives the actuators; add such a record first.",)
    level = float(np.mean([h.level_V for h in driven]))
    try:
        drive = Drive(level, sum(h.duration_s for h in driven), found.band_Hz)
        noise = campaign_noise([one.block for one in found.fit.residuals])
        return needed_experiment(found.information, model, drive, noise)
    except AvisError as error:
        return (f"No advice on further records: {error}",)


def _kalman(
    fitted: Campaign | FrequencyResponse, rig: Rig, names: Sequence[str], options: IdentifyOptions, progress: Progress
) -> tuple[EkfResult | None, str]:
    if not options.kalman:
        return None, "the extended Kalman filter was not requested"
    if not isinstance(fitted, Campaign):
        return None, "the extended Kalman filter needs records; these are frequency responses"
    # The filter treats a measured floor as noise; a shaken floor would be a disturbance far above its assumptions.
    driven = tuple(record.header.name for record in fitted.records if driven_inputs(record))
    if not driven:
        return None, "the extended Kalman filter needs records that drive the actuators"
    progress(f"extended Kalman filter over the records {', '.join(driven)}")
    try:
        return identify_ekf(rig, fitted.only(driven), HONEST_SETTINGS, names, progress), ""
    except AvisError as error:
        return None, f"the extended Kalman filter failed: {error}"


def identification_provenance(
    measured: Campaign | FrequencyResponse, rig: Rig, options: IdentifyOptions, seconds: float
) -> dict[str, Any]:
    """Provenance of an identification, with the hash of the measurement."""
    if isinstance(measured, Campaign):
        data, source = digest(measured), measured.source
    else:
        data = hashlib.sha256(measured.frequency_Hz.tobytes() + measured.value.tobytes()).hexdigest()
        source = measured.method
    return provenance(
        rig,
        repr(replace(options, priors={})) + repr(sorted(options.priors.items())) + data,
        options.seed,
        seconds,
        ("numpy", "scipy", "numba", "h5py"),
        measurement=source,
        measurement_sha256=data,
    )
