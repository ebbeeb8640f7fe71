"""PPO on a GPU in few kernels, written in Triton.

networks (what layers read and write) < memory (where that is) < products, samples, steps (Triton kernels) < triton_ppo
(launches them).
"""
