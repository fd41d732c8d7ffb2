"""Recordings made in code, with the truth beside them, so that nothing needs downloading."""
