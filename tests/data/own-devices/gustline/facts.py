"""What is true of a Gustline 2, which shows temperature and pressure. Source: its manual, page 7."""

IDENTITY = "GUSTLINE"
READ_TERMINATION = "\r"
WRITE_TERMINATION = "\r"
BAUD_RATES = (4800, 9600)
SERIAL = {
    "baud_rate": 4800,
    "data_bits": 8,
    "parity": "none",
    "stop_bits": 1,
    "flow": "none",
    "device_clear": b"",
}
REPLY = r"T=([+-]\d+\.\d\d) C P=\d+\.\d hPa"
NO_SENSOR = "T=------ C"
LIMIT_K = 0.1  # largest error between 0 °C and 50 °C
