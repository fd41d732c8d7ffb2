"""Pictures of results as PNG and SVG, drawn by matplotlib, which is imported when the first one is drawn."""
