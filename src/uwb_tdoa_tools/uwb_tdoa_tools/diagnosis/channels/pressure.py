"""The barometer."""

from .aid import Aid


class Pressure(Aid):
    """Altitude of the standard atmosphere, minus the true height; what is constant is the weather's."""

    name = "pressure"
    unit = "m"
    needs = "a barometer, and ground truth of the height"
    negligible = 0.05
    floating = True
    of_attitude = False
