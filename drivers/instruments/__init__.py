"""The instrument drivers, one module for each make or model."""
