"""Coefficients over temperature: polynomials with uncertainty, compensation, tables for a computer on board."""

from bench.temperature.estimate import HIGHEST_DEGREE, temperature_model
from bench.temperature.model import Compensated, Hysteresis, PlateauResult, TemperatureModel
from bench.temperature.plateaus import separate_temperatures
from bench.temperature.table import CompensationTable, TableError, make_table

__all__ = [
    "HIGHEST_DEGREE",
    "Compensated",
    "CompensationTable",
    "Hysteresis",
    "PlateauResult",
    "TableError",
    "TemperatureModel",
    "make_table",
    "separate_temperatures",
    "temperature_model",
]
