"""What a driver may get wrong, found in a recording before anything else is done with it."""
