"""Geometry that all the mathematics shares, the sensor density, and the learning of shapes."""
