"""The ground: what rewards, resets, evaluation and viewers know of it."""
