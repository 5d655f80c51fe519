"""Regress residuals on effects: tables, robust fits, selection, hold-out checks, confounding."""
