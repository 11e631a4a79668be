"""Building a release: wheel, sdist, bill of materials, offline bundle, signed manifest; the matrix of versions."""
