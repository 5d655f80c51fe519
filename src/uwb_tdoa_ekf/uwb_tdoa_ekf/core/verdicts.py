"""What became of one measurement; the values of TdoaResidual.VERDICT_*."""

USED, REJECTED, LATE, INVALID, STARTUP, COMPENSATED, REPEATED = range(7)
