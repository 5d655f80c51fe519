"""Correction of TDOAs by effects and network, at poses that the filter reports."""
