"""Foundations of all packages: units, formatted numbers, files, tables, validated YAML files."""
