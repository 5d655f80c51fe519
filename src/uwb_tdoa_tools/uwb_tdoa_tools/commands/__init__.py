"""The executables, one file each: options, one call, what is printed. Nothing imports them."""
