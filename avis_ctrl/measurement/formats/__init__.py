"""Files of measurement campaigns: HDF5, MATLAB, UFF 58, CSV."""

from avis_ctrl.measurement.formats.hdf5 import write_campaign
from avis_ctrl.measurement.formats.reader import FORMATS, parse_columns, read_measurements
from avis_ctrl.measurement.formats.stored_response import write_frequency_response

__all__ = ["FORMATS", "parse_columns", "read_measurements", "write_campaign", "write_frequency_response"]
