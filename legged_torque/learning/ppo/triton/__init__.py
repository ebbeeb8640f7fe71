"""Acting and learning as few kernels on a GPU, written in Triton; elsewhere rsl_rl's and torch's own operations.

networks (what layers read and write) < memory (where that is) < products, samples, steps (Triton kernels) < learner
(which launches them).
"""
