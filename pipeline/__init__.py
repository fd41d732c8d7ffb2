"""Files, clocks, screens and the command line; everything with a side effect lives here.

Matrices are multiplied in full precision: by default JAX rounds their numbers to 10 bits on GPUs
(TensorFloat-32), which moves a point 2 m away by a millimetre. JAX reads the variable when it is first
imported; worker processes inherit it.
"""

import os

os.environ.setdefault("JAX_DEFAULT_MATMUL_PRECISION", "highest")
