"""Better anchors from rough ones and flights."""
