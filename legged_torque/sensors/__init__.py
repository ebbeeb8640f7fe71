"""Sensors: measurements of each world at a rate of their own, late and with errors."""
