"""What re-makes the figures of the documentation; users do not need it."""
