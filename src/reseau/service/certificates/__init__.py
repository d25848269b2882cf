"""Certificates of calibrations: uncertainty, traceability; PDF, HTML and DCC; signature and verification."""

from .budget import measurement_budget
from .certificate import certify
from .data import CertificateData
from .page import html_of
from .verify import verify

__all__ = ["CertificateData", "certify", "html_of", "measurement_budget", "verify"]
