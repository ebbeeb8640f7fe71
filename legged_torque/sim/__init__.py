"""The batched MuJoCo Warp simulator. It knows nothing of rewards or learning."""

import warp as wp

wp.config.log_level = wp.LOG_WARNING  # before anything initializes Warp: no banner, no line per loaded kernel
