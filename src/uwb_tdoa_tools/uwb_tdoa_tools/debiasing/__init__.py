"""What `debias` does: positions to fit a bias map to, and the map on flights."""
