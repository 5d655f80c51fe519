"""The workbench: read, convert, simulate, replay, record, evaluate, and the demo that runs it all."""
