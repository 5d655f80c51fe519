"""Tools: read, convert, simulate, replay, record and evaluate flights, and a demo that runs it all."""
