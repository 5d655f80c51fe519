"""Types that all packages share: flights, anchors, geometry, radio, surveys, stamps, errors, files."""
