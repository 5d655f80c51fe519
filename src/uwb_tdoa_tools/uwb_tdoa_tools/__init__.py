"""Tools: read, convert, simulate, replay, record and evaluate flights; a demo of all parts."""
