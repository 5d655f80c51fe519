"""Faults of numbers, drawn and put into measured flights: are they named?"""

from .drawing import FAULTS, Fault, as_they_are, cases, figures

__all__ = ["FAULTS", "Fault", "as_they_are", "cases", "figures"]
