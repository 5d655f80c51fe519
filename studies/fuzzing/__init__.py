"""Changed files of every kind, given to every reader: the readers, how files are changed, and the
small corpus that the changes start from.
"""
