"""Import of a published MJCF or URDF as a robot of this library: its MJCF and its settings."""
