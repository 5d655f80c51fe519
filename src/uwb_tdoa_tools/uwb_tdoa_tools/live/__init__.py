"""Running nodes as processes, playing to them, and listening to them."""
