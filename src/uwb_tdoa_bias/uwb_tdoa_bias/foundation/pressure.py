"""Pressure and altitude in the international standard atmosphere (ICAO Doc 7488, troposphere)."""

SEA_LEVEL = 101325.0  # Pa
SCALE = 44330.77  # m, temperature at sea level over its lapse rate: 288.15 K / 6.5 K/km
EXPONENT = 5.25588  # g M / (R lapse rate)


def pressure_at(altitude):
    """Pa at an altitude above the sea, m; numbers or arrays."""
    return SEA_LEVEL * (1.0 - altitude / SCALE) ** EXPONENT


def altitude_of(pressure):
    """m above the sea of a pressure, Pa; numbers or arrays."""
    return SCALE * (1.0 - (pressure / SEA_LEVEL) ** (1.0 / EXPONENT))
