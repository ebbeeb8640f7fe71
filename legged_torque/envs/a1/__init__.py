"""The Unitree A1 and one module per approach."""
