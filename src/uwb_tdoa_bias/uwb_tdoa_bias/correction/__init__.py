"""From raw TDOAs to corrected ones: effects and network together, at the poses that the filter
reports.
"""
