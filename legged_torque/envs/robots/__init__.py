"""The settings of each robot, one module each; they name no approach."""
