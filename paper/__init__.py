"""The paper: gravity pre-training, its published values, and reports of experiments."""
