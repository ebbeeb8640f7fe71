"""Whether it is fast, right and the same with CUDA graphs: what the scripts benchmark.py, physics_accuracy.py and check_*.py run."""
