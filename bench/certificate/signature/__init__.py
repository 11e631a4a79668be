"""Signatures of certificates: XAdES in the XML, PAdES in the PDF, by one key with its X.509 chain."""
