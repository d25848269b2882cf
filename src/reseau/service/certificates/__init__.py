"""Certificates of calibrations: uncertainty, traceability; PDF, HTML and DCC; signature and verification."""

from .budget import CalibrationUncertainty, measurement_budget, simulate_measurement, uncertainty_of
from .certificate import Certificate, certify
from .data import CertificateData
from .dcc import dcc_of
from .page import html_of, pdf_of
from .signature import sign
from .verify import Verdict, verify

__all__ = [
    "CalibrationUncertainty",
    "Certificate",
    "CertificateData",
    "Verdict",
    "certify",
    "dcc_of",
    "html_of",
    "measurement_budget",
    "pdf_of",
    "sign",
    "simulate_measurement",
    "uncertainty_of",
    "verify",
]
