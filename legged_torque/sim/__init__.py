"""Physics engines for batches of worlds, CUDA graphs and random parameters. Knows nothing of rewards or learning."""

import warp as wp

wp.config.log_level = wp.LOG_WARNING  # before anything initializes Warp: no banner, no line per loaded kernel
