"""Coefficients over temperature: polynomials with uncertainty, compensation, tables for a computer on board."""

from bench.analysis.temperature.estimate import HIGHEST_DEGREE, temperature_model
from bench.analysis.temperature.model import Compensated, PlateauResult, TemperatureModel, ThermalHysteresis
from bench.analysis.temperature.plateaus import separate_temperatures
from bench.analysis.temperature.table import CompensationTable, TableError, make_table

__all__ = [
    "HIGHEST_DEGREE",
    "Compensated",
    "CompensationTable",
    "PlateauResult",
    "TableError",
    "TemperatureModel",
    "ThermalHysteresis",
    "make_table",
    "separate_temperatures",
    "temperature_model",
]
