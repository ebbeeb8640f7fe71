"""The batched MuJoCo Warp simulator. It knows nothing of rewards or learning."""

import warp as wp

wp.config.quiet = True  # before anything initializes Warp: no banner, no line per loaded kernel
