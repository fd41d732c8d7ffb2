"""Files, clocks, screens and the command line; everything with a side effect lives here."""
