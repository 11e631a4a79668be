"""The Keithley 2000."""
