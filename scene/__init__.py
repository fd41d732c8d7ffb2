"""Scene-graph inference (supplement K to O): which known objects stand where, on what, and how surely.

Call `scene.parsing.parse_scene`. A frame is segmented (observation), searched and verified (initialisation);
Gaussians are fitted round the poses found (search) and chains begin there (mcmc); samples become a result
(summary).

Imports run downward: parsing; summary, initialisation; mcmc; search; likelihood; observation,
diagnostics (agreement of chains); model, objects, result, config; execution (use of cores, for all of them).
"""
