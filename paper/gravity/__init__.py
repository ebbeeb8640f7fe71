"""Gravity pre-training (paper, III-A): whole-body control to stand, and policies that learn from it."""
