"""Compare this trainer with others on the machine at hand."""
