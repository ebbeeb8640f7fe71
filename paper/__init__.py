"""The paper: gravity pre-training, its published values, and reports that compare experiments with them."""
