"""Tables of readings: in memory, as a readings file, several joined."""
