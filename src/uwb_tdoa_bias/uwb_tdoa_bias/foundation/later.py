"""Parts of scipy that take long to import and that a node hardly ever needs: imported when something of them is used."""


class Later:
    """Stands for a module."""

    def __init__(self, load):
        """load() imports and returns it."""
        self._load = load

    def __getattr__(self, name):
        return getattr(self._load(), name)


@Later
def interpolate():
    """scipy.interpolate"""
    from scipy import interpolate as module

    return module


@Later
def rotations():
    """scipy.spatial.transform"""
    from scipy.spatial import transform as module

    return module
