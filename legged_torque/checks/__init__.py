"""Checks of speed, accuracy, CUDA graphs and bad numbers, of which each has a script of its own."""
