"""What the suite costs on this machine: figures of the compiled core, of whole recordings, and of
the live nodes.
"""
