"""The range finder."""

from .aid import Aid


class Height(Aid):
    """Ranges along the body's -z, minus those to the ground at z = 0."""

    name = "height"
    unit = "m"
    needs = "a range finder that looks down, and ground truth of height and attitude"
    negligible = 0.005
