"""What `debias` does: positions to fit a bias map to, the map on flights, and the set-ups whose figures are in
docs/debiasing.md."""
