"""Linear regression of residuals on effects: tables, robust fits, selection, held-out checks,
confounding.
"""
