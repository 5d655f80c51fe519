"""Modules that take long to import and that a node hardly ever needs: imported when something of them is used."""

from importlib import import_module


class Later:
    """Stands for a module."""

    def __init__(self, name):
        self._name = name

    def __getattr__(self, name):
        return getattr(import_module(self._name), name)


interpolate, linalg = Later("scipy.interpolate"), Later("scipy.linalg")
rotations = Later("scipy.spatial.transform")
