"""Foundations of all packages: units, formatted numbers, files and tables, checked reading of YAML."""
