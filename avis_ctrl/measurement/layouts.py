"""Supported file formats, as text for `--help`. This module imports nothing, so that help appears at once."""

FORMATS = """\
Measurement files, recognised by their content:

HDF5 campaign: /records/NN with u, y, floor; or /frf with frequency_Hz, value and variance or coherence.

MATLAB .mat (v5 to v7.3), flat: u, y (samples by channels, or transposed) and t or fs (sample_rate_Hz, Fs, Ts, dt).
Optional: u_names, y_names (cell arrays), u_unit, y_unit, floor (three velocities), excitation, period_s, level_V,
start_s, rig.

MATLAB .mat, records: a struct array `records` with the fields of the flat layout, one element per record; u, y and t or
sample_rate_Hz (or fs) are required. Optional: excitation (multisine, noise, rest, floor or sine; by default multisine
with period_s, rest if u is zero, otherwise noise), period_s (empty, 0 or NaN if not periodic), start_s (by default one
record after the other), level_V (by default from u), name. Names, units and rate that apply to all records may be
variables next to `records`, where rig is, too.

MATLAB .mat, frequency responses: frequency_Hz, H (lines, outputs, inputs) and variance, or coherence with averages;
optional: inputs, outputs, input_unit, output_unit.

UFF 58 and 58b: time responses, or frequency responses with their coherence; ASCII or binary.

CSV: header line with channel names such as "Sz1 [V]", column t or "# sample_rate_Hz = 1000"; a directory of CSV files
is a campaign, one record each.

--columns assigns variables, channels or columns to roles: u=vir,y=qm,t=t (roles t, u, y, floor, sample_rate_Hz; several
for one role: u=A1+A2). It also names the channels: y_names=Sy1+Sz1 (the variable with the names, or the names
themselves in the order of the file's channels).
"""
