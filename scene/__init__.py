"""Which learned objects stand where in a recording, what rests on what, and how sure we are."""
