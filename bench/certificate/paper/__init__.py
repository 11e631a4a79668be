"""The paper: a PDF/A-3b that typst sets from what a certificate says."""
