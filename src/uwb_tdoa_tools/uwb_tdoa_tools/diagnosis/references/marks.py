"""Marks: places measured beforehand where the tag stood or passed."""

from .nothing import Nothing


class Marks(Nothing):
    """Residuals are the innovations of the filter, as with nothing; the marks are among its
    constraints and say where the tag was, so that positions and delays of anchors are observable
    with them.
    """

    words = "places measured beforehand where the tag stood or passed, and the flights themselves"
