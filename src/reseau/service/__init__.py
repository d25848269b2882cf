"""Recalibration without a network: charts of calibrations, covariates.

The modules: :mod:`~reseau.service.runlength`, :mod:`~reseau.service.charts` and
:mod:`~reseau.service.covariates` are statistics of series, without an archive.
"""
