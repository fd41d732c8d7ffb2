"""Learned shapes and runs in the formats that other programs take."""
