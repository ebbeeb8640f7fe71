"""Checks of speed, accuracy and CUDA graphs, run by benchmark.py, physics_accuracy.py and check_capture.py."""
