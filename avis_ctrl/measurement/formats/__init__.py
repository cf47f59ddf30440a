"""Files of measurement campaigns: HDF5, MATLAB, UFF 58, CSV."""

from avis_ctrl.measurement.formats.hdf5 import write_campaign, write_frequency_response
from avis_ctrl.measurement.formats.reader import FORMATS, parse_columns, read_measurements

__all__ = ["FORMATS", "parse_columns", "read_measurements", "write_campaign", "write_frequency_response"]
