"""Tables of readings: in memory, in a readings file, several tables joined, corrections."""
