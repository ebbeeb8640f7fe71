"""From a published MJCF or URDF to a robot of this library: its MJCF and its settings."""
