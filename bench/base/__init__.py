"""What every room stands on: units, numbers in words, forms that read files that people write."""
