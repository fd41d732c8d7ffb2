"""From stored pixels to depth in metres and to colour."""
