"""What became of one measurement; the values of TdoaResidual.VERDICT_*."""

USED, REJECTED, LATE, INVALID, STARTUP, COMPENSATED = range(6)
