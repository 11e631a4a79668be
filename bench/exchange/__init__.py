"""A calibration in the forms that others read: data, source text, parameters of autopilots, a workbook."""
