"""Acting and learning as few kernels on a GPU, written in Triton; elsewhere rsl_rl's and torch's own operations.

networks (what is computed where) < products, losses, steps (Triton kernels) < learner (which launches them).
"""
