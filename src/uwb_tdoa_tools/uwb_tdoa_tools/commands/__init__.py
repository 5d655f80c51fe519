"""Executables, one thin file each: options, one call, the printed result. Nothing imports them."""
