"""From recordings to a calibrated tag: check, diagnose or survey, judge, write."""
