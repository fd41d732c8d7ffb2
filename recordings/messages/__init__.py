"""What the messages of other programs say, decoded by schema into a few common values."""
