"""Scene-graph inference (supplement K to O): which known objects stand where, on what, and how surely.

Call `scene.parsing.parse_scene`. Frames are segmented (observation) and searched (search, perhaps by masks;
initialisation; joint_search, of several). Particles are drawn round the poses found (refinement). Moves tell
from there which objects are in sight (presence), and where others may be out of it (hidden); chains sample
their poses and edges (mcmc). Samples become a result (common_errors, summary). One density judges images in
all of it (likelihood).

`scene.colour_parsing.parse_colour` is the same for one colour image without depth (colour). `diagnostics`
tells whether chains agree, `execution` how cores are used. pyproject.toml holds the order of imports.
"""
