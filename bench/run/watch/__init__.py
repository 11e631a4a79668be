"""Each reading held against what the readings before it make expected, as it comes."""
