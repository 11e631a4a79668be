"""Coefficients over temperature: polynomials with uncertainty, compensation, tables for a computer on board."""
