"""What is true of a Voltwerk 9, a meter of the time before SCPI. Source: its manual, pages 3 and 21."""

IDENTITY = "VOLTWERK 9"
READ_TERMINATION = "\r\n"
WRITE_TERMINATION = "\n"
BAUD_RATES = (2400, 9600)
SERIAL = {
    "baud_rate": 9600,
    "data_bits": 8,
    "parity": "none",
    "stop_bits": 1,
    "flow": "none",
    "device_clear": b"",
}
RANGES_V = (0.3, 3.0, 30.0)
OVER_RANGE = 1.01
NPLC = (0.1, 1.0, 10.0)
MEMORY_READINGS = 100
LEAST_SAMPLES = 1
ACCURACY_90_DAYS = {0.3: (40e-6, 30e-6), 3.0: (25e-6, 10e-6), 30.0: (35e-6, 20e-6)}
LINEARITY = (10e-6, 10e-6)
READING = r"[+-]\d\d\.\d{5}E0"  # volts in every range
OVERLOAD = "+99.99999E9"
SWITCHED_ON = "R0N2"  # range and integration time after switching on
