"""Run nodes as processes, replay recordings to them, and record their topics."""
