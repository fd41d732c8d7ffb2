"""The filter over camera trajectory and map: where the camera was, and how sure we are."""
