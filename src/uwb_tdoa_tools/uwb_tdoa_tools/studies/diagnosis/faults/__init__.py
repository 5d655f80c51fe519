"""Faults of numbers, drawn and put into measured flights: are they named?"""

from .drawing import FAULTS, Fault, cases, figures

__all__ = ["FAULTS", "Fault", "cases", "figures"]
